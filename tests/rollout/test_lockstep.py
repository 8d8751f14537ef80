"""Runs side by side are the runs they would be alone, and a handed run acts on what it is handed."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.md.neighbors import RebuildRule
from mdnum.rollout.compared import ReferenceFrame
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import decided_pairs, true_pairs
from mdnum.rollout.lockstep import lockstep
from mdnum.rollout.tracks import Handed
from mdnum.systems.build import Simulation, build

FLOAT32 = {f"precision.{role}": "float32" for role in ("force", "decision", "accumulate")}
LANGEVIN = {"dynamics.kind": "langevin", "dynamics.friction": 1.0}


def shifted(simulation: Simulation, size: float) -> Simulation:
    noise = np.random.default_rng(0).standard_normal(simulation.positions.shape)
    return replace(simulation, positions=simulation.positions + size * noise)


def alone(simulation: Simulation, last: int):
    """Positions in the user's order and keys of the pairs inside, of every step."""
    x, pairs = [], []
    for segment in Engine(simulation, last).segments():
        for row in range(segment.rows):
            x.append(segment.unsorted("x", row))
            pairs.append(set(decided_pairs(simulation, segment, row).tolist()))
    return np.array(x, np.float64), pairs


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("argon/crystal-108", {}),
        ("argon/crystal-108", {"neighbors.skin": 0.1}),
        # all at once, and every night one by one
        pytest.param("binary/kob-andersen-1000", FLOAT32 | LANGEVIN, marks=pytest.mark.slow),
        pytest.param("binary/kob-andersen-1000", {}, marks=pytest.mark.nightly),
        pytest.param("argon/crystal-108", FLOAT32, marks=pytest.mark.nightly),
        pytest.param("argon/langevin-500", {}, marks=pytest.mark.nightly),
    ],
)
def test_handed_its_own_decisions_a_run_is_bit_identical(name, overrides):
    simulation = build(name, overrides)
    handed = Handed(simulation, simulation)
    for segment in Engine(simulation, 120).segments():
        rows, note = handed.follow(segment)
        for row in range(segment.rows):
            np.testing.assert_array_equal(rows.x[row].T, segment.unsorted("x", row))
            np.testing.assert_array_equal(rows.v[row].T, segment.unsorted("v", row))
        assert not note.count.any()


def test_with_lists_of_its_own_it_acts_on_the_same_pairs():
    leader = build("argon/crystal-108")
    other = build("argon/crystal-108", {"neighbors.skin": 0.5})
    handed = Handed(other, leader)
    apart, overridden = 0.0, 0
    for segment in Engine(leader, 120).segments():
        rows, note = handed.follow(segment)
        for row in range(segment.rows):
            apart = max(apart, np.abs(rows.x[row].T - segment.unsorted("x", row)).max())
        overridden += int(note.count.sum())
    # another order of summation, and nothing else
    assert 0 < apart < 1e-12
    assert overridden == 0


def test_cross_flips_are_the_differences_of_the_pair_sets():
    a = build("argon/crystal-108")
    b = shifted(a, 1e-4)
    last = 120
    x_a, pairs_a = alone(a, last)
    x_b, pairs_b = alone(b, last)
    differ = [one ^ other for one, other in zip(pairs_a, pairs_b, strict=True)]
    assert sum(map(len, differ)) > 50

    known: set[int] = set()
    step = 0
    for stretch in lockstep(a, b, last):
        flips = {}
        for flip in stretch.flips:
            flips.setdefault(flip.step, []).append(flip)
        for row in range(stretch.rows):
            for flip in flips.get(stretch.first + row, ()):
                key = flip.i * a.atoms + flip.j
                known ^= {key}
                assert flip.differs == (key in known)
            assert known == differ[step]
            assert stretch.cross[row] == len(known)
            d = x_a[step] - x_b[step]
            box = np.diag(np.asarray(a.cell.matrix))
            d -= box * np.round(d / box)
            assert stretch.separation["B"][row] == pytest.approx(np.linalg.norm(d, axis=1).max(), rel=1e-12)
            step += 1
    assert step == last + 1


def test_every_run_is_compared_with_the_one_that_its_name_says():
    a = build("argon/crystal-108")
    b = shifted(a, 1e-4)
    last = 120
    free = {"A": alone(a, last)[0], "B": alone(b, last)[0]}
    mixed = {}
    for name, own, leader in (("B|A", b, a), ("A|B", a, b)):
        told = Handed(own, leader)
        rows = [told.follow(segment)[0].x for segment in Engine(leader, last).segments()]
        mixed[name] = np.concatenate(rows).transpose(0, 2, 1)
    stretches = list(lockstep(a, b, last, back=True))
    for name, one, other in (
        ("B", free["B"], free["A"]), ("B|A", mixed["B|A"], free["A"]), ("A|B", mixed["A|B"], free["B"]),
        ("A|B from A", mixed["A|B"], free["A"]), ("B|A from B", mixed["B|A"], free["B"]),
    ):  # fmt: skip
        d = one - other
        box = np.diag(np.asarray(a.cell.matrix))
        d -= box * np.round(d / box)
        got = np.concatenate([stretch.separation[name] for stretch in stretches])
        np.testing.assert_allclose(got, np.linalg.norm(d, axis=2).max(axis=1), rtol=1e-12)
    assert stretches[0].separation["A|B from A"][0] == 0, "the same start"


@pytest.mark.slow
def test_the_flips_of_a_cold_crystal_cause_what_they_are_blamed_for():
    a = build("argon/crystal-108")
    b = shifted(a, 1e-6)
    free, handed = [], []
    for stretch in lockstep(a, b, 1500):
        free.append(stretch.separation["B"])
        handed.append(stretch.separation["B|A"])
    assert np.concatenate(free)[-1] > 1e-2
    assert np.concatenate(handed).max() < 1e-5
    # with the cutoff between two shells there is nothing to flip
    between = build("argon/crystal-108", {"cutoff.radius": 1.35, "neighbors.skin": 4 ** (1 / 3) + 0.3 - 1.35})
    stretches = list(lockstep(between, shifted(between, 1e-6), 1500))
    assert not any(stretch.flips for stretch in stretches)
    assert max(stretch.separation["B"].max() for stretch in stretches) < 1e-5


def test_the_same_run_twice_never_parts():
    a = build("argon/crystal-108")
    for stretch in lockstep(a, build("argon/crystal-108"), 120):
        assert not stretch.bits.any() and not stretch.flips and not stretch.cross.any()
        assert (stretch.separation["B"] == 0).all() and (stretch.separation["B|A"] == 0).all()


def test_one_wrong_decision_is_found():
    """A list that is not rebuilt loses pairs: the step and the pairs are those of a fresh search."""
    a = build("argon/crystal-108", {"dynamics.temperature": 2.0})
    b = replace(a, rule=RebuildRule(0.3, 100, 0, False))
    missed = None
    for segment in Engine(b, 120).segments():
        for row in range(segment.rows):
            acted = decided_pairs(b, segment, row)
            lost = np.setdiff1d(true_pairs(b, segment.unsorted("x", row)), acted)
            if missed is None and len(lost):
                missed = segment.first + row, set(lost.tolist())
    assert missed is not None
    first = next(
        flip for stretch in lockstep(a, b, 120, handed=False) for flip in stretch.flips if flip.differs
    )
    assert first.step == missed[0]
    assert first.i * a.atoms + first.j in missed[1]


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


def test_a_run_that_fails_on_one_side_ends_the_comparison():
    a = build("argon/crystal-108")
    b = replace(a, integrator=replace(a.integrator, timestep=jnp.asarray(1e6)))
    stretches = list(lockstep(a, b, 120, handed=False))
    assert stretches[-1].failed["B"] in ("blow-up", "runaway")
    assert stretches[-1].failed["A"] == ""
