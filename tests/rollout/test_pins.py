"""Pinned pairs are told; everything else a run still decides itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import Pin, Pins
from mdnum.rollout.flips import PairRecorder, decided_pairs
from mdnum.rollout.lockstep import lockstep
from mdnum.systems.build import build

#: Of every run here: the rows of a record are part of the program.
STEPS = 120


def positions(simulation, last, pins=None):
    rows = []
    for segment in Engine(simulation, last, pins=pins).segments():
        rows += [segment.unsorted("x", row) for row in range(segment.rows)]
    return np.array(rows)


def test_no_pin_changes_no_bit():
    simulation = build("argon/crystal-108")
    np.testing.assert_array_equal(positions(simulation, STEPS), positions(simulation, STEPS, Pins([])))


def test_what_it_is_told_turns_at_its_changes():
    pin = Pin(0, 1, 0, 100, (10, 20, 21), False)
    inside = pin.at(np.arange(30))
    assert list(np.flatnonzero(inside)) == [*range(10, 20), *range(21, 30)]
    assert list(Pin(0, 1, 0, 9, (), True).at(np.arange(3))) == [True] * 3


@pytest.mark.parametrize(
    "name",
    ["argon/crystal-108", pytest.param("binary/kob-andersen-1000", marks=pytest.mark.nightly)],
)
def test_pinned_to_its_own_decisions_a_run_is_bit_identical(name):
    simulation = build(name)
    recorder, ledgers, first = PairRecorder(simulation), [], None
    for segment in Engine(simulation, STEPS).segments():
        first = set(decided_pairs(simulation, segment, 0).tolist()) if first is None else first
        ledgers.append(recorder.flips(segment))
    subject = np.concatenate([ledger.subject for ledger in ledgers])
    step = np.concatenate([ledger.step for ledger in ledgers])
    keys = subject[:, 0] * simulation.atoms + subject[:, 1]
    chosen = np.unique(keys)[:200:4]
    pins = [
        Pin(
            int(key // simulation.atoms),
            int(key % simulation.atoms),
            0,
            120,
            tuple(np.sort(step[keys == key]).tolist()),
            int(key) in first,
        )
        for key in chosen
    ]
    assert len(pins) > 10
    np.testing.assert_array_equal(positions(simulation, STEPS), positions(simulation, STEPS, Pins(pins)))


def test_one_inverted_decision_is_the_only_thing_that_differs_and_is_found():
    """The planted fault: a pair inside is told to be outside for one step."""
    simulation = build("argon/crystal-108")
    segment = next(Engine(simulation, STEPS).segments())
    i, j = divmod(int(decided_pairs(simulation, segment, 40)[17]), simulation.atoms)
    planted = positions(simulation, STEPS, Pins([Pin(i, j, 40, 40, (), False)]))
    plain = positions(simulation, STEPS)
    # forces of step 40 make the positions of step 41
    np.testing.assert_array_equal(planted[:41], plain[:41])
    moved = np.flatnonzero(np.any(planted[41] != plain[41], axis=1))
    np.testing.assert_array_equal(moved, [i, j])


def test_pinning_the_pair_at_the_fork_takes_the_fork_away():
    a = build("argon/crystal-108")
    noise = np.random.default_rng(0).standard_normal(a.positions.shape)
    b = replace(a, positions=a.positions + 1e-6 * noise)
    first = next(flip for stretch in lockstep(a, b, STEPS, handed=False) for flip in stretch.flips)
    around = range(max(0, first.step - 3), first.step + 6)
    inside = not first.entered if first.run == "B" else first.entered
    # A's own decisions of this pair around the fork, from A's run
    told = []
    for segment in Engine(a, STEPS).segments():
        for row in range(segment.rows):
            if segment.first + row in around:
                told.append(first.i * a.atoms + first.j in decided_pairs(a, segment, row))
    changes = tuple(around[k] for k in range(1, len(told)) if told[k] != told[k - 1])
    pin = Pin(first.i, first.j, around[0], around[-1], changes, told[0])
    until = slice(around[-1] + 1)
    alone = positions(a, STEPS)[until]
    free = np.abs(positions(b, STEPS)[until] - alone).max()
    pinned = np.abs(positions(b, STEPS, Pins([pin]))[until] - alone).max()
    assert told[around.index(first.step)] == inside
    assert free > 10 * pinned
    assert pinned < 1e-5
