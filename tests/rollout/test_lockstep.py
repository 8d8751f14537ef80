"""Runs side by side are the runs they would be alone, and a counterfactual acts on imposed decisions."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from rollout.harness import CRYSTAL, furthest, history, moved
from small_systems import KOB_ANDERSEN, make, mixture

from mdnum.md.cell import Cell, HostCell
from mdnum.md.neighbors import PairTable, RebuildRule
from mdnum.rollout import lockstep as lockstep_module
from mdnum.rollout.compared import ReferenceFrame, differ, in_user_order, overridden, separations
from mdnum.rollout.counterfactual import Counterfactual
from mdnum.rollout.engine import Engine, Segment
from mdnum.rollout.epoch import Pin, Pins
from mdnum.rollout.flips import true_pairs
from mdnum.rollout.program import MdProgram, pair_margin
from mdnum.rollout.tracks import Rows
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation

FLOAT32 = {f"precision.{role}": "float32" for role in ("force", "decision", "accumulate")}
LANGEVIN = {"dynamics.kind": "langevin", "dynamics.friction": 1.0}
#: Of every run here: the rows of a record are part of the program.
STEPS = 120


def lockstep(a, b, last, forward=True, back=False):
    """Two simulations side by side."""
    return MdProgram(a).lockstep(MdProgram(b), last, forward=forward, back=back, guard=None)


@pytest.fixture(scope="module")
def crystal() -> Simulation:
    return build(CRYSTAL)


@pytest.fixture(scope="module")
def alone(crystal) -> list[tuple[np.ndarray, list[set[int]]]]:
    """The crystal, and one whose atoms are elsewhere, each by itself."""
    return [history(one, STEPS) for one in (crystal, moved(crystal, 1e-2))]


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        (CRYSTAL, {}),
        (CRYSTAL, {"neighbors.skin": 0.1}),
        # every night other systems and precisions, all at once and one by one
        pytest.param("binary/kob-andersen-1000", FLOAT32 | LANGEVIN, marks=pytest.mark.nightly),
        pytest.param("binary/kob-andersen-1000", {}, marks=pytest.mark.nightly),
        pytest.param(CRYSTAL, FLOAT32, marks=pytest.mark.nightly),
        pytest.param("argon/langevin-500", {}, marks=pytest.mark.nightly),
    ],
)
def test_under_its_own_decisions_a_run_is_bit_identical(name, overrides):
    simulation = build(name, overrides)
    imposed = Counterfactual(simulation, simulation)
    for segment in Engine(simulation, STEPS).segments():
        rows = imposed.follow(segment)
        for row in range(segment.rows):
            np.testing.assert_array_equal(rows.x[row].T, segment.unsorted("x", row))
            np.testing.assert_array_equal(rows.v[row].T, segment.unsorted("v", row))
        assert not rows.overridden.any()


def test_with_lists_of_its_own_it_acts_on_the_same_pairs(crystal, alone):
    imposed = Counterfactual(build(CRYSTAL, {"neighbors.skin": 0.5}), crystal)
    followed = [imposed.follow(segment) for segment in Engine(crystal, STEPS).segments()]
    x = np.concatenate([rows.x for rows in followed]).transpose(0, 2, 1)
    # another order of summation, and nothing else
    assert 0 < np.abs(x - alone[0][0]).max() < 1e-12
    assert not any(rows.overridden.any() for rows in followed)


def test_cross_flips_are_the_differences_of_the_pair_sets(crystal, alone):
    a, b = crystal, moved(crystal, 1e-2)
    (x_a, pairs_a), (x_b, pairs_b) = alone
    runs = {"A": (a, x_a, pairs_a), "B": (b, x_b, pairs_b)}
    differ = [one ^ other for one, other in zip(pairs_a, pairs_b, strict=True)]
    assert sum(map(len, differ)) > 50 and differ[0], "from the start on, too"
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
    a, b = crystal, moved(crystal, 1e-2)
    free = {"A": alone[0][0], "B": alone[1][0]}
    mixed = {}
    for name, own, leader in (("B|A", b, a), ("A|B", a, b)):
        imposed = Counterfactual(own, leader)
        rows = [imposed.follow(segment).x for segment in Engine(leader, STEPS).segments()]
        mixed[name] = np.concatenate(rows).transpose(0, 2, 1)
    stretches = list(lockstep(a, b, STEPS, back=True))
    for name, one, other in (
        ("B", free["B"], free["A"]), ("B|A", mixed["B|A"], free["A"]), ("A|B", mixed["A|B"], free["B"]),
        ("A|B from A", mixed["A|B"], free["A"]), ("B|A from B", mixed["B|A"], free["B"]),
    ):  # fmt: skip
        got = np.concatenate([stretch.separation[name] for stretch in stretches])
        np.testing.assert_allclose(got, furthest(a, one, other), rtol=1e-12)
    assert stretches[0].separation["A|B from A"][0] == 0, "the same start"


class Scripted(Counterfactual):
    """A run of two atoms that goes nowhere; how far imposed decisions are from its own is written."""

    def __init__(self, furthest: list[float], guard: float | None):
        self.failed, self.guard, self._ahead, self._over = "", guard, [], False
        self._left, self._step = furthest, 0

    def follow(self, segment: Segment) -> Rows:
        count, first = segment.rows, self._step
        note, self._left = np.array(self._left[:count]), self._left[count:]
        self._step += count
        x = np.zeros((count, 3, 2)) + np.arange(first, first + count)[:, None, None]
        noted = {"overridden": np.arange(first, first + count), "furthest": note}
        return Rows(first, x, x, x[:, 0, 0].copy(), Cell.create(np.eye(3)), **noted)


@pytest.mark.parametrize("guard", [0.5, None])
@pytest.mark.parametrize("asked", [[9], [0, 1, 2, 3, 4, 9], [2, 5, 9]])
def test_a_counterfactual_ends_before_the_first_decision_beyond_its_guard(crystal, guard, asked):
    """Beyond means more than: the guard itself is still a decision that rounding could have changed."""
    furthest = [0.0, 0.1, 0.2, 0.5, 0.1, 0.0, 0.51, 0.0, 9.0, 0.0]
    run = Scripted(furthest, guard)
    whole = next(iter(Engine(crystal, STEPS).segments()))
    for first, last in ((0, 3), (4, 8), (9, 9)):
        run(replace(whole, first=first, rows=last - first + 1))
    end = 10 if guard is None else 6
    seen = []
    for last in asked:
        rows = run.until(last)
        if rows is None:
            assert len(seen) == end
            continue
        steps = list(range(rows.first, rows.first + len(rows)))
        assert rows.energy.tolist() == rows.overridden.tolist() == steps
        assert rows.furthest.tolist() == furthest[rows.first : rows.first + len(rows)]
        seen += steps
        assert seen == list(range(min(last + 1, end)))
    assert len(seen) == end


@pytest.mark.parametrize("compare", ["r2 <", "r <"])
def test_the_nearest_decision_of_a_mixture_is_no_further_than_any_pair_from_its_cutoff(compare):
    """As a length, from a margin that does not say whose cutoff it was: the longest is the safe one."""
    cutoff = {"kind": "hard", "radius": 2.5, "pairs": {"Ni-P": 1.4, "P-P": 0.8}, "compare": compare}
    simulation = build(make(mixture(), KOB_ANDERSEN, cutoff))
    radii, away = np.array(simulation.decider.r_cut), np.array([-0.3, -1e-3, 1e-9, 0.02, 0.4])
    r = radii[:, None] + away
    margin = (radii[:, None] ** 2 - r**2 if compare == "r2 <" else radii[:, None] - r).ravel()
    x = np.zeros((margin.size, 3, 1))
    for smallest in (np.abs(margin), np.full(margin.size, np.inf)):
        rows = Rows(0, x, x, np.zeros(margin.size), simulation.cell, nearest=smallest)
        told = lockstep_module._nearest(simulation, rows, rows)
        true = np.where(np.isinf(smallest), np.inf, np.abs(np.tile(away, len(radii))))
        assert (told <= true * (1 + 1e-6)).all() and (told > 0).all()
    # of the longest cutoff it is that distance, of pairs outside
    nearest = np.abs(margin.reshape(3, 5)[np.argmax(radii), 2:])
    outside = Rows(0, x[:3], x[:3], np.zeros(3), simulation.cell, nearest=nearest)
    np.testing.assert_allclose(lockstep_module._nearest(simulation, outside, outside), away[2:], rtol=1e-5)


def test_one_wrong_decision_is_found():
    """A list that is not rebuilt loses pairs: the step and the pairs are those of a fresh search."""
    a = build(CRYSTAL, {"dynamics.temperature": 2.0})
    b = replace(a, rule=RebuildRule(0.3, 100, 0, False))
    lost = [set(true_pairs(b, x).tolist()) - acted for x, acted in zip(*history(b, STEPS), strict=True)]
    step = next(step for step, pairs in enumerate(lost) if pairs)
    first = next(
        flip for stretch in lockstep(a, b, STEPS, forward=False) for flip in stretch.flips if flip.differs
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


# --- compiled comparisons of rows have the bits of the numpy that says what they mean -------------------


BOXES = {
    "cube": (np.diag([5.0, 5.0, 5.0]), (True, True, True)),
    "brick, one face open": (np.diag([4.0, 5.0, 6.0]), (True, False, True)),
    "tilted": (np.array([[5.0, 0, 0], [0.7, 4.5, 0], [-0.3, 0.4, 4.8]]), (True, True, True)),
    "tilted, one face open": (np.array([[5.0, 0, 0], [0.7, 4.5, 0], [0, 0, 4.8]]), (True, True, False)),
    "open": (np.diag([5.0, 5.0, 5.0]), (False, False, False)),
}


def rows(seed: int, count: int = 9, atoms: int = 31) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 6.0, (count, 3, atoms))


@pytest.mark.parametrize("box", BOXES)
def test_distances_have_the_bits_of_nearest_images(box):
    matrix, pbc = BOXES[box]
    cell = Cell.create(matrix, np.array(pbc))
    a, b = rows(1), rows(2)
    b[4] = a[4]
    b[5, 1, 3] = np.nan
    d = HostCell(cell).displacement(a.transpose(0, 2, 1), b.transpose(0, 2, 1))
    with np.errstate(invalid="ignore"):
        wanted = np.sqrt((d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).max(axis=1))
    found = separations([cell], a, b)
    np.testing.assert_array_equal(found, wanted)
    assert found[4] == 0 and np.isnan(found[5])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_atoms_are_put_in_the_users_order(dtype):
    values, order = rows(3).astype(dtype), np.random.default_rng(4).permutation(31)
    found = in_user_order(values, order)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found[:, :, order], values)


def test_rows_differ_where_a_number_does():
    a = rows(5)
    b = a.copy()
    b[2, 1, 30] = np.nextafter(b[2, 1, 30], 9)
    a[3, 0, 0] = b[3, 0, 0] = np.nan
    # zeros of either sign are one number
    a[4, 0, 0], b[4, 0, 0] = 0.0, -0.0
    assert np.flatnonzero(differ(a, b)).tolist() == [2, 3]


def test_overridden_decisions_are_counted_once_with_their_distances():
    rng = np.random.default_rng(6)
    count, atoms, slots = 5, 31, 16
    matrix, pbc = BOXES["tilted"]
    cell, species = Cell.create(matrix, np.array(pbc)), rng.integers(0, 2, atoms)
    r_cut = np.array([[1.0, 1.2], [1.2, 1.5]])
    # a full list: every pair of sorted atoms within seven of one another, from both ends
    index = np.full((slots, atoms), atoms, np.int32)
    for k in range(atoms):
        others = [n for n in range(k - 7, k + 8) if n != k and 0 <= n < atoms]
        index[: len(others), k] = others
    table = PairTable(index, rng.permutation(atoms), 1.0, slots, 0.0)
    own = np.zeros((count, slots // 8, atoms), np.uint8)
    told, wanted = own.copy(), [[] for _ in range(count)]
    x = rows(7, count, atoms).astype(np.float32)
    for row in range(1, count):
        for _ in range(4 * row):
            k = int(rng.integers(0, atoms - 7))
            n = k + int(rng.integers(1, 8))
            for one, other in ((k, n), (n, k)):
                slot = int(np.flatnonzero(index[:, one] == other)[0])
                told[row, slot // 8, one] ^= np.uint8(1 << slot % 8)
            wanted[row] = sorted(set(wanted[row]) ^ {(k, n)})
    counts, furthest = overridden([cell], own, told, table, x, species, r_cut[None])
    assert counts.tolist() == [len(pairs) for pairs in wanted] and counts[4] > 6
    for row, pairs in enumerate(wanted):
        off = [0.0]
        for pair in pairs:
            k, n = sorted(pair, key=lambda one: table.order[one])
            d = HostCell(cell).displacement(x[row, :, [k]], x[row, :, [n]])
            distance = np.sqrt(sum(c[0] * c[0] for c in d))
            off.append(abs(distance - r_cut[species[table.order[k]], species[table.order[n]]]))
        assert furthest[row] == max(off)
