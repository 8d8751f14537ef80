"""Reverse mode by JAX against the reverse pass by hand, which shares no derivative code with it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from gradient_problems import everything
from small_systems import LENNARD_JONES, crystal, make

from mdnum.gradients import Problem, method
from mdnum.gradients.recorded import Symmetric
from mdnum.gradients.unrolled import Fingerprints, Unrolled, ahead
from mdnum.rollout.engine import Engine
from mdnum.systems import build

NAMES = ("sigma", "epsilon", "r_cut", "r_onset", "timestep", "temperature", "scale", "x0", "v0")


@pytest.fixture(scope="module")
def switched():
    simulation = build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}))
    return Problem(simulation, everything(simulation.atoms), 40)


@pytest.fixture(scope="module")
def by_hand(switched):
    return Symmetric()(switched, NAMES)


@pytest.mark.parametrize("snapshots", [None, 2, 0])
def test_whatever_is_kept_the_gradient_is_one(switched, by_hand, snapshots):
    found = Unrolled(snapshots)(switched, NAMES)
    assert found.value == by_hand.value
    for name, value in by_hand.gradient.items():
        assert np.max(np.abs(found.gradient[name] - value)) <= 1e-9 * np.max(np.abs(value)), name
    # what was linearized is the run, to the last bit
    primal = found.details["primal"]
    assert primal["first state"] is primal["first decision"] is None
    assert primal["steps compared"] == switched.steps and primal["value of the run"] == found.value
    # every chunk is run once ahead and once for its derivative; with fewer states others are run again
    chunks, run = found.details["chunks"], found.details["chunks run"]
    assert run == 2 * chunks if snapshots is None else run > 2 * chunks


def test_the_names_of_what_is_kept_are_one_method():
    assert {method(name).name for name in ("unrolled", "epochs", "recursive")} == {"unrolled"}


def test_a_departure_is_found_where_it_was_planted(switched):
    simulation = switched.simulation
    run, other = Fingerprints(switched.steps), Fingerprints(switched.steps)
    for segment in Engine(simulation, switched.steps).segments():
        tables = simulation.tables(segment.table)
        x, bits = np.array(segment.record.x), np.array(segment.record.bits)
        run.add(segment.first, segment.rows, x, segment.record.v, bits, tables)
        # one bit of one coordinate at step 17, one decision at step 23
        if segment.first <= 17 < segment.first + segment.rows:
            row = 17 - segment.first
            x[row, 1, 50] = np.nextafter(x[row, 1, 50], np.inf)
        if segment.first <= 23 < segment.first + segment.rows:
            bits[23 - segment.first, 0, 7] ^= 1
        other.add(segment.first, segment.rows, x, segment.record.v, bits, tables)
    assert list(run.departure(other).values()) == [40, 17, 23]
    assert list(run.departure(run).values()) == [40, None, None]


@cache
def fewest(length: int, room: int) -> int:
    """Chunks that must be run again for a reverse pass over this many, with room for some states beside the
    first; by trying every place for the next state."""
    if length <= 1 or room == 0:
        return length * (length - 1) // 2
    return min(k + fewest(length - k, room - 1) + fewest(k, room) for k in range(1, length))


def test_states_are_kept_where_the_fewest_chunks_are_run_again():
    def runs(length: int, room: int) -> int:
        total = 0
        while length > 1:
            hop = ahead(length, room)
            total += hop + runs(length - hop, room - 1)
            length = hop
        return total

    for length in range(1, 61):
        for room in range(5):
            assert runs(length, room) == fewest(length, room), (length, room)
    assert runs(1024, 10) < 4 * 1024
