"""Reverse mode by JAX against the reverse pass by hand, which shares no derivative code with it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from gradient_problems import everything
from mdnum.gradients.base import Problem
from mdnum.gradients.checkpoints import _split
from mdnum.gradients.primal import Fingerprints
from mdnum.gradients.steps import Steps
from mdnum.gradients.symmetric import Symmetric
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients import memory
from mdnum.gradients.unrolled import Epochs, Recursive, Unrolled
from mdnum.systems import build

NAMES = ("sigma", "epsilon", "r_cut", "r_onset", "timestep", "temperature", "scale", "x0", "v0")


@pytest.fixture(scope="module")
def switched():
    simulation = build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}))
    return Problem(simulation, everything(simulation.atoms), 40)


@pytest.fixture(scope="module")
def by_hand(switched):
    return Symmetric()(switched, NAMES)


@pytest.mark.parametrize("method", [Unrolled(), Epochs(), Recursive(), Recursive(snapshots=1)])
def test_all_ways_to_keep_a_tape_give_one_gradient(switched, by_hand, method):
    found = method(switched, NAMES)
    assert found.value == by_hand.value
    for name, value in by_hand.gradient.items():
        assert np.max(np.abs(found.gradient[name] - value)) <= 1e-9 * np.max(np.abs(value)), name
    # what was linearized is the run, to the last bit
    assert found.details["primal"]["first state"] is None
    assert found.details["primal"]["steps compared"] == switched.steps


def test_a_departure_is_found_where_it_was_planted(switched):
    from mdnum.rollout.engine import Engine

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
    found = run.departure(other)
    assert (found.steps, found.state, found.decision) == (40, 17, 23)
    assert "from step 23 on with other decisions" in str(found)
    assert run.departure(run).state is None


@cache
def fewest(length: int, room: int) -> int:
    """Chunks that must be run again for a reverse pass over so many, with room for so many states beside the
    first; by trying every place for the next state."""
    if length <= 1 or room == 0:
        return length * (length - 1) // 2
    return min(k + fewest(length - k, room - 1) + fewest(k, room) for k in range(1, length))


def test_states_are_kept_where_the_fewest_chunks_are_run_again():
    def runs(length: int, room: int) -> int:
        total = 0
        while length > 1:
            ahead = _split(length, room)
            total += ahead + runs(length - ahead, room - 1)
            length = ahead
        return total

    for length in range(1, 61):
        for room in range(5):
            assert runs(length, room) == fewest(length, room), (length, room)
    assert runs(1024, 10) < 4 * 1024


def test_a_horizon_that_does_not_fit_is_refused_with_amounts(switched):
    needed = memory.needs(Steps(switched))
    # states are few numbers for an atom, what reverse mode keeps is some for each slot of its list
    assert needed["unrolled"] > needed["epochs"] > needed["recursive"]
    room = needed["epochs"]
    with pytest.raises(InputError) as error:
        Unrolled(room=room)(switched, ("sigma",))
    assert memory.in_words(needed["unrolled"]) in str(error.value)
    assert memory.in_words(room) in str(error.value)
    assert "epochs needs about" in str(error.value) and "symmetric needs about" in str(error.value)
    assert Epochs(room=room).why_not(switched, ("sigma",)) is None
    assert "no other method" in str(memory.why_not(Steps(switched), "epochs", 0))


def test_what_was_foreseen_is_what_is_kept(switched):
    program = Steps(switched)
    _, _, _, back = program.keep(program.start)
    assert program.bytes_of(back) == memory.per_chunk(program)
    # half of the steps are done by chunks that are not full, which nothing could foresee
    chunks = -(-(switched.steps + 1) // program.chunk)
    with pytest.raises(InputError, match="of 40 steps take"):
        found = Unrolled(room=chunks * memory.per_chunk(program))
        found._differentiate(program, lambda *_: None, lambda *_: None)
