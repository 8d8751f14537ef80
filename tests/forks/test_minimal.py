"""The pairs that are blamed: pinning them keeps the runs together, and leaving one out does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mdnum.forks.minimal import minimal_cause

from mdnum.errors import InputError
from mdnum.forks import Twin, fork
from mdnum.rollout.engine import Engine
from mdnum.rollout.pins import Pin, Pins
from mdnum.systems.build import build


def moved(simulation, size: float, seed: int = 0):
    noise = np.random.default_rng(seed).standard_normal(simulation.positions.shape)
    return replace(simulation, positions=simulation.positions + size * noise)


def last_positions(simulation, last, pins=None):
    *_, segment = Engine(simulation, last, pins=pins).segments()
    return segment.unsorted("x", segment.rows - 1)


def apart(simulation, one, other) -> float:
    box = np.diag(np.asarray(simulation.cell.matrix))
    d = one - other
    d -= box * np.round(d / box)
    return float(np.linalg.norm(d, axis=1).max())


def test_one_decision_of_four_thousand_did_it():
    a = build("argon/crystal-108")
    b = moved(a, 1e-7)
    found = fork(Twin(a, b, "start"), 2500, split=0.03, repeats=0)
    cause = minimal_cause(found)
    assert found.decision is not None and found.dates.split is not None
    assert cause.fork_alone and cause.proven and cause.tests == 1
    assert cause.pairs == ((found.decision.i, found.decision.j),)
    assert cause.candidates > 100
    # once more by hand: A's flips of this pair, from A's record alone
    (pair,) = cause.pairs
    inside = []
    for segment in Engine(a, cause.horizon).segments():
        for row in range(segment.rows):
            x = segment.unsorted("x", row)
            d = x[pair[1]] - x[pair[0]]
            box = np.diag(np.asarray(a.cell.matrix))
            d -= box * np.round(d / box)
            inside.append(bool(d @ d < a.r_cut**2))
    changes = tuple(np.flatnonzero(np.diff(np.array(inside, int))) + 1)
    pin = Pin(*pair, 0, cause.horizon, tuple(int(step) for step in changes), inside[0])
    end = last_positions(a, cause.horizon)
    assert apart(a, last_positions(b, cause.horizon), end) > 0.02
    assert apart(a, last_positions(b, cause.horizon, Pins([pin])), end) < 1e-5


def test_several_decisions_none_of_which_can_be_left_out():
    a = build("argon/crystal-108")
    found = fork(Twin(a, moved(a, 1e-6), "start"), 1500, split=0.03, repeats=0)
    cause = minimal_cause(found)
    assert cause.pairs is not None and cause.proven and not cause.fork_alone
    assert 1 < len(cause.pairs) < 20
    assert cause.tests <= 80


def test_within_few_runs_a_set_is_enough_but_not_proven_smallest():
    a = build("argon/crystal-108")
    found = fork(Twin(a, moved(a, 1e-6), "start"), 1500, split=0.03, repeats=0)
    cause = minimal_cause(found, tests=6)
    assert cause.tests == 6 and not cause.proven
    assert cause.pairs is not None and "did not show" in cause.reason


def test_what_did_not_split_has_no_cause():
    a = build("argon/crystal-108")
    found = fork(Twin(a, moved(a, 1e-6), "start"), 50, repeats=0)
    with pytest.raises(InputError, match="did not split"):
        minimal_cause(found)
