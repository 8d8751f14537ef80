"""Runs side by side are the runs they would be alone, and a handed run acts on what it is handed."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from rollout.harness import CRYSTAL, furthest, history, moved

from mdnum.md.neighbors import RebuildRule
from mdnum.rollout.compared import ReferenceFrame
from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import Pin, Pins
from mdnum.rollout.flips import true_pairs
from mdnum.rollout.lockstep import lockstep
from mdnum.rollout.program import pair_margin
from mdnum.rollout.tracks import Handed
from mdnum.systems.build import Simulation, build

FLOAT32 = {f"precision.{role}": "float32" for role in ("force", "decision", "accumulate")}
LANGEVIN = {"dynamics.kind": "langevin", "dynamics.friction": 1.0}
#: Of every run here: the rows of a record are part of the program.
STEPS = 120


@pytest.fixture(scope="module")
def crystal() -> Simulation:
    return build(CRYSTAL)


@pytest.fixture(scope="module")
def alone(crystal) -> list[tuple[np.ndarray, list[set[int]]]]:
    """The crystal, and one whose atoms are elsewhere, each by itself."""
    return [history(one, STEPS) for one in (crystal, moved(crystal, 1e-4))]


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        (CRYSTAL, {}),
        (CRYSTAL, {"neighbors.skin": 0.1}),
        # all at once, and every night one by one
        pytest.param("binary/kob-andersen-1000", FLOAT32 | LANGEVIN, marks=pytest.mark.slow),
        pytest.param("binary/kob-andersen-1000", {}, marks=pytest.mark.nightly),
        pytest.param(CRYSTAL, FLOAT32, marks=pytest.mark.nightly),
        pytest.param("argon/langevin-500", {}, marks=pytest.mark.nightly),
    ],
)
def test_handed_its_own_decisions_a_run_is_bit_identical(name, overrides):
    simulation = build(name, overrides)
    handed = Handed(simulation, simulation)
    for segment in Engine(simulation, STEPS).segments():
        rows, note = handed.follow(segment)
        for row in range(segment.rows):
            np.testing.assert_array_equal(rows.x[row].T, segment.unsorted("x", row))
            np.testing.assert_array_equal(rows.v[row].T, segment.unsorted("v", row))
        assert not note.count.any()


def test_with_lists_of_its_own_it_acts_on_the_same_pairs(crystal, alone):
    handed = Handed(build(CRYSTAL, {"neighbors.skin": 0.5}), crystal)
    followed = [handed.follow(segment) for segment in Engine(crystal, STEPS).segments()]
    x = np.concatenate([rows.x for rows, _ in followed]).transpose(0, 2, 1)
    # another order of summation, and nothing else
    assert 0 < np.abs(x - alone[0][0]).max() < 1e-12
    assert not any(note.count.any() for _, note in followed)


def test_cross_flips_are_the_differences_of_the_pair_sets(crystal, alone):
    a, b = crystal, moved(crystal, 1e-4)
    (x_a, pairs_a), (x_b, pairs_b) = alone
    runs = {"A": (a, x_a, pairs_a), "B": (b, x_b, pairs_b)}
    differ = [one ^ other for one, other in zip(pairs_a, pairs_b, strict=True)]
    assert sum(map(len, differ)) > 50
    known: set[int] = set()
    for stretch in lockstep(a, b, STEPS):
        assert list(stretch.flips[:3]) + list(stretch.flips[3:]) == list(stretch.flips)
        steps = [(flip.step, flip.i, flip.j, flip.run) for flip in stretch.flips]
        assert steps == sorted(steps)
        for row, step in enumerate(range(stretch.first, stretch.first + stretch.rows)):
            for flip in (flip for flip in stretch.flips if flip.step == step):
                key = flip.i * a.atoms + flip.j
                known ^= {key}
                assert flip.differs == (key in known)
                # it is a flip of the run that is named
                own, x, inside = runs[flip.run]
                if step:
                    assert flip.entered == (key in inside[step]) != (key in inside[step - 1])
                    assert flip.margin == pair_margin(own, x[step], flip.i, flip.j)
            assert known == differ[step] and stretch.cross[row] == len(known)
    assert step == STEPS


def test_every_run_is_compared_with_the_one_that_its_name_says(crystal, alone):
    a, b = crystal, moved(crystal, 1e-4)
    free = {"A": alone[0][0], "B": alone[1][0]}
    mixed = {}
    for name, own, leader in (("B|A", b, a), ("A|B", a, b)):
        told = Handed(own, leader)
        rows = [told.follow(segment)[0].x for segment in Engine(leader, STEPS).segments()]
        mixed[name] = np.concatenate(rows).transpose(0, 2, 1)
    stretches = list(lockstep(a, b, STEPS, back=True))
    for name, one, other in (
        ("B", free["B"], free["A"]), ("B|A", mixed["B|A"], free["A"]), ("A|B", mixed["A|B"], free["B"]),
        ("A|B from A", mixed["A|B"], free["A"]), ("B|A from B", mixed["B|A"], free["B"]),
    ):  # fmt: skip
        got = np.concatenate([stretch.separation[name] for stretch in stretches])
        np.testing.assert_allclose(got, furthest(a, one, other), rtol=1e-12)
    assert stretches[0].separation["A|B from A"][0] == 0, "the same start"


def test_one_wrong_decision_is_found():
    """A list that is not rebuilt loses pairs: the step and the pairs are those of a fresh search."""
    a = build(CRYSTAL, {"dynamics.temperature": 2.0})
    b = replace(a, rule=RebuildRule(0.3, 100, 0, False))
    lost = [set(true_pairs(b, x).tolist()) - acted for x, acted in zip(*history(b, STEPS), strict=True)]
    step = next(step for step, pairs in enumerate(lost) if pairs)
    first = next(
        flip for stretch in lockstep(a, b, STEPS, handed=False) for flip in stretch.flips if flip.differs
    )
    assert first.step == step and first.i * a.atoms + first.j in lost[step]


def test_a_frame_undoes_labels_axes_and_shifts():
    rng = np.random.default_rng(1)
    labels = rng.permutation(7)
    axes, signs, shift = np.array([2, 0, 1]), np.array([1.0, -1.0, 1.0]), np.array([0.5, 0.0, -2.0])
    frame = ReferenceFrame(labels, axes, signs, shift)
    x = rng.standard_normal((3, 3, 7))
    other = np.empty_like(x)
    # what the other run holds, made from the definition atom by atom
    for b in range(7):
        for axis in range(3):
            other[:, axis, labels[b]] = signs[axis] * (x[:, axes[axis], b] - shift[axes[axis]])
    np.testing.assert_array_equal(frame.positions(x), other)
    keys = frame.keys(np.array([0 * 7 + 3, 2 * 7 + 5]))
    wanted = sorted(min(labels[i], labels[j]) * 7 + max(labels[i], labels[j]) for i, j in ((0, 3), (2, 5)))
    np.testing.assert_array_equal(keys, wanted)


# --- single decisions imposed on a run that makes all others itself ---------------------------------------


@pytest.mark.parametrize(
    "name", [CRYSTAL, pytest.param("binary/kob-andersen-1000", marks=pytest.mark.nightly)]
)
def test_pinned_to_its_own_decisions_a_run_is_bit_identical(name):
    simulation = build(name)
    x, inside = history(simulation, STEPS)
    flipped = [before ^ after for before, after in pairwise(inside)]
    chosen = sorted(set().union(*flipped))[:200:4]
    assert len(chosen) > 10
    pins = []
    for key in chosen:
        changes = tuple(step for step, keys in enumerate(flipped, 1) if key in keys)
        pins.append(Pin(*divmod(key, simulation.atoms), 0, STEPS, changes, key in inside[0]))
    np.testing.assert_array_equal(x, history(simulation, STEPS, pins=Pins(pins))[0])


def test_one_inverted_decision_is_the_only_thing_that_differs_and_is_found(crystal, alone):
    """The planted fault: a pair inside is told to be outside for one step."""
    plain, inside = alone[0]
    i, j = divmod(sorted(inside[40])[17], crystal.atoms)
    planted, _ = history(crystal, STEPS, pins=Pins([Pin(i, j, 40, 40, (), False)]))
    # forces of step 40 make the positions of step 41
    np.testing.assert_array_equal(planted[:41], plain[:41])
    differ = np.flatnonzero(np.any(planted[41] != plain[41], axis=1))
    np.testing.assert_array_equal(differ, [i, j])
