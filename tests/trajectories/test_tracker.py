"""Flips between frames are the differences of what brute force finds at each, however they were found."""

from __future__ import annotations

import gc
import pickle
import tracemalloc

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from trajectories import brute_force
from trajectories.brute_force import atoms, boxes
from trajectories.files import arrays_held

from mdnum.errors import InputError
from mdnum.trajectories import superset
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.ledger import FlipTable
from mdnum.trajectories.rules import Capped, CutoffRule, Nearest, SpeciesCutoffs
from mdnum.trajectories.tracker import HORIZON, Tracker

PERIODIC = np.ones(3, bool)


def rows(flips: FlipTable) -> list:
    columns = (flips.i, flips.j, flips.rank, flips.entered)
    return list(zip(*(column.tolist() for column in columns), strict=True))


def differences(before: dict, now: dict) -> list:
    entered = [(*key, True) for key in now.keys() - before.keys()]
    left = [(*key, False) for key in before.keys() - now.keys()]
    return sorted(entered + left)


@settings(max_examples=25)
@given(st.data(), st.sampled_from([0.01, 0.3, 5.0]))
def test_flips_are_differences_of_brute_force(data, step):
    box = data.draw(boxes())
    x = data.draw(atoms(box))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    radius, everyone = 2.0, range(len(x))
    tracker, before, old = Tracker(CutoffRule(radius), bound=0.01), None, x
    for frame in range(3):
        flips = tracker.step(Frame(frame, 0.0, x, box))
        pairs = brute_force.everything(x, box.matrix, box.pbc, everyone, everyone, 1.1 * radius)
        assume(brute_force.clear(pairs, lambda i, j: radius))
        now = brute_force.members(pairs, lambda i, j: radius)
        assert rows(flips) == (differences(before, now) if before is not None else [])
        for at, (i, j, rank, entered) in enumerate(rows(flips)):
            held, distance = (now, flips.distance) if entered else (before, flips.before)
            assert distance[at] == pytest.approx(held[i, j, rank], abs=1e-9)
            other = brute_force.image_list(old if entered else x, box.matrix, box.pbc, i, j, 8.0)
            if len(other) > rank:
                beyond = flips.before[at] if entered else flips.distance[at]
                assert beyond == pytest.approx(np.sqrt(other[rank]), abs=1e-9)
        assert flips.margin == pytest.approx(radius - flips.distance)
        assert flips.margin_before == pytest.approx(radius - flips.before)
        close = np.minimum(abs(flips.margin), abs(flips.margin_before)) <= flips.bound
        assert (flips.ambiguous == close).all() and (flips.bound >= 0.01).all()
        assert tracker.pairs == len(now) and tracker.frames == frame + 1
        before, old = now, x
        # wrapped by the code that wrote it, or not
        x = x + rng.normal(size=x.shape) * step
        x = x + rng.integers(-1, 2, x.shape) @ np.where(box.pbc[:, None], box.matrix, 0.0)


@settings(max_examples=20)
@given(st.data(), st.booleans())
def test_flips_of_the_nearest_few(data, capped):
    box = data.draw(boxes())
    x = data.draw(atoms(box, 8))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    everyone, before, limits = range(len(x)), None, {}
    tracker = Tracker(Capped(2.5, 3) if capped else Nearest(3, 2.5))
    for frame in range(3):
        flips = tracker.step(Frame(frame, 0.0, x, box))
        now, new, clearly = brute_force.nearest(x, box.matrix, box.pbc, everyone, everyone, 3, 2.5, 3.2)
        assume(clearly)
        assert rows(flips) == (differences(before, now) if before is not None else [])
        for at, (i, _, _, entered) in enumerate(rows(flips)):
            last, after = new[i]
            assert flips.margin[at] == pytest.approx((after if entered else last) - flips.distance[at])
            last, after = limits[i]
            assert flips.margin_before[at] == pytest.approx((last if entered else after) - flips.before[at])
        before, limits = now, new
        x = x + rng.normal(size=x.shape) * 0.2


class Oracle:
    """Minimum-image distances of all pairs in a wide box, in plain numpy."""

    def __init__(self, radius):
        self.radius, self.before = radius, None

    def look(self, x, matrix, bound):
        """(flips, pairs inside, pairs in doubt, smallest |margin|)."""
        i, j = np.triu_indices(len(x), 1)
        d = x[j] - x[i]
        d = d - np.rint(d @ np.linalg.inv(matrix)) @ matrix
        r = np.sqrt((d * d).sum(axis=1))
        inside = r < self.radius
        flips = []
        if self.before is not None:
            k = np.flatnonzero(inside != self.before)
            flips = list(zip(i[k].tolist(), j[k].tolist(), [0] * len(k), inside[k].tolist(), strict=True))
        self.before = inside
        margins = abs(self.radius - r)
        return flips, int(inside.sum()), int((margins <= bound).sum()), float(margins.min())


def wrapped(x, matrix, rng):
    return x + rng.integers(-1, 2, x.shape) @ matrix


def head_on(x, matrix, k, rng):
    # two atoms run at one another at the same speed, all others rest
    moved = x.copy()
    moved[0, 0] += 0.03
    moved[1, 0] -= 0.03
    return moved, matrix


def drift(x, matrix, k, rng):
    return x + np.array([0.03, -0.02, 0.01]), matrix


def one_fast(x, matrix, k, rng):
    moved = x.copy()
    moved[3] += 0.04 if k % 9 else 1.5
    return moved, matrix


def jitter(x, matrix, k, rng):
    return x + rng.normal(size=x.shape) * 0.01, matrix


def strained(x, matrix, k, rng):
    # fractional coordinates rest: nothing but the box moves
    strain = np.eye(3) + np.array([[-0.004, 0.002, 0], [0, 0.003, -0.001], [0.001, 0, -0.004]])
    return x @ strain, matrix @ strain


def wrapping(x, matrix, k, rng):
    moved = x + rng.normal(size=x.shape) * 0.01
    return (wrapped(moved, matrix, rng) if k % 3 == 0 else moved), matrix


def resting(x, matrix, k, rng):
    return x, matrix


def reduced_anew(x, matrix, k, rng):
    # the same lattice with another vector from the middle on
    moved = x + rng.normal(size=x.shape) * 0.01
    if k == 15:
        matrix = matrix + np.array([[0, 0, 0], [0, 0, 0], [2.0, 0, 0]]) @ matrix
    return moved, matrix


MOVERS = [head_on, drift, one_fast, jitter, strained, wrapping, resting, reduced_anew]
MATRIX = np.array([[11.0, 0, 0], [2.0, 10.5, 0], [-1.0, 3.0, 10.0]])


@pytest.mark.parametrize("mover", MOVERS, ids=lambda mover: mover.__name__)
@pytest.mark.parametrize("bound", [0.0, 0.03])
def test_a_list_in_use_misses_nothing(mover, bound):
    rng = np.random.default_rng(7)
    x, matrix, radius = rng.uniform(0, 1, (150, 3)) @ MATRIX, MATRIX, 2.2
    x[1] = x[0] + [3.4, 0.01, 0.0]
    tracker, oracle, used, flipped = Tracker(CutoffRule(radius), bound=bound), Oracle(radius), 0, 0
    for k in range(30):
        held = tracker._list
        flips = tracker.step(Frame(k, 0.0, x, Box(matrix, PERIODIC)))
        right, inside, doubts, smallest = oracle.look(x, matrix, bound)
        assert rows(flips) == right
        assert tracker.pairs == inside and (bound == 0.0 or tracker.near == doubts)
        assert tracker.min_margin == pytest.approx(smallest if smallest <= HORIZON * radius else np.inf)
        used += held is not None and (tracker._list is held or held.gone > 0)
        flipped += len(flips)
        x, matrix = mover(x, matrix, k, rng)
    # it was the list that answered, most of the time
    assert used > 18 and (flipped > 0 or mover is drift or mover is resting)


def test_a_box_that_becomes_too_narrow_for_a_list():
    rng, radius, before, used = np.random.default_rng(5), 2.2, None, []
    x, everyone = rng.uniform(0, 5, (12, 3)), range(12)
    x[1] = x[0] + [2.1, 0.1, 0.1]
    tracker = Tracker(CutoffRule(radius))
    for k in range(16):
        matrix = np.diag([5.2 if k < 10 else 4.2, 6.0, 7.0])
        flips = tracker.step(Frame(k, 0.0, x, Box(matrix, PERIODIC)))
        pairs = brute_force.everything(x, matrix, PERIODIC, everyone, everyone, 1.05 * radius)
        now = brute_force.members(pairs, lambda i, j: radius)
        assert rows(flips) == (differences(before, now) if before is not None else [])
        used.append(tracker._list is not None)
        before, x = now, x + rng.normal(size=x.shape) * 0.005
    assert all(used[2:10]) and not any(used[10:]) and any(rank for _, _, rank in now)


def test_the_nearest_miss_is_found_though_only_another_pair_is_due():
    # two pairs rest at margins 0.05 and 0.03 while another atom, far away, turns the odometer
    x = np.array([[0.0, 0, 0], [1.95, 0, 0], [0, 8, 0], [1.97, 8, 0], [6, 5, 5]])
    tracker, used = Tracker(CutoffRule(2.0)), 0
    for k in range(40):
        tracker.step(Frame(k, 0.0, x, Box(np.eye(3) * 20.0, PERIODIC)))
        used += tracker._list is not None
        assert tracker.min_margin == pytest.approx(0.03)
        x[4, 2] += 0.01
    assert used > 30


def test_a_list_and_a_fresh_search_tell_the_same_to_the_last_bit(monkeypatch):
    rng = np.random.default_rng(2)
    frames = [rng.uniform(0, 10, (200, 3))]
    for _ in range(30):
        frames.append(frames[-1] + rng.normal(size=(200, 3)) * 0.015)
    species = rng.choice(["O", "H"], 200)
    rules = [
        (CutoffRule(2.0), None, None),
        (CutoffRule(2.0), np.arange(70), np.arange(50, 160)),
        (SpeciesCutoffs({("O", "H"): 2.0, ("O", "O"): 1.5}), None, None),
    ]

    def follow():
        made = []
        for rule, first, second in rules:
            tracker = Tracker(rule, first, second, species, 0.01)
            parts = [
                tracker.step(Frame(k, 0.0, x, Box(np.eye(3) * 10, PERIODIC))) for k, x in enumerate(frames)
            ]
            made.append((FlipTable.concatenate(parts), tracker.near, tracker.min_margin, tracker.members()))
            lists.append(tracker._list is not None)
        return made

    lists: list[bool] = []
    listed = follow()
    monkeypatch.setattr(superset, "LARGEST", 0.0)
    fresh = follow()
    assert lists == [True] * 3 + [False] * 3
    for one, other in zip(listed, fresh, strict=True):
        assert len(one[0]) > 50 and one[1:3] == other[1:3]
        for a, b in ((one[0], other[0]), (one[3], other[3])):
            for name in vars(a):
                assert np.array_equal(getattr(a, name), getattr(b, name)), name


@pytest.mark.parametrize("rule", [CutoffRule(2.0), Nearest(4), Capped(2.0, 5)], ids=lambda rule: rule.name)
def test_a_tracker_can_be_sent_to_another_process(rule):
    rng = np.random.default_rng(1)
    x, box = rng.uniform(0, 9, (80, 3)), Box(np.eye(3) * 9.0, PERIODIC)
    tracker = Tracker(rule)
    for k in range(12):
        if k == 6:
            copy = pickle.loads(pickle.dumps(tracker))
        flips = tracker.step(Frame(k, 0.0, x, box))
        if k >= 6:
            assert rows(copy.step(Frame(k, 0.0, x, box))) == rows(flips)
        x = x + rng.normal(size=x.shape) * 0.02
    assert copy.pairs == tracker.pairs


def test_memory_does_not_grow_with_frames():
    rng = np.random.default_rng(1)
    x, box = rng.uniform(0, 12, (200, 3)), Box(np.eye(3) * 12.0, PERIODIC)
    tracker, arrays, whole = Tracker(CutoffRule(2.0)), [], []
    tracemalloc.start()
    for k in range(80):
        tracker.step(Frame(k, 0.0, x, box))
        x = (x + rng.normal(size=x.shape) * (0.01 if k % 20 else 0.3)) % 12.0
        if k % 40 == 39:
            gc.collect()
            arrays.append(arrays_held())
            whole.append(len(pickle.dumps(tracker)))
    tracemalloc.stop()
    # far less than the 40 frames between
    for first, last in (arrays, whole):
        assert last < first + 10 * x.nbytes


def test_a_box_may_come_and_go_and_a_bound_may_change():
    x = np.array([[0.5, 5, 5], [9.5, 5, 5], [3.0, 5, 5]])
    tracker = Tracker(CutoffRule(2.0))
    box = Box(np.eye(3) * 10.0, PERIODIC)
    tracker.step(Frame(0, 0.0, x, box))
    flips = tracker.step(Frame(1, 1.0, x, Box()))
    assert rows(flips) == [(0, 1, 0, False)] and flips.distance[0] == 9.0 and flips.before[0] == 1.0
    flips = tracker.step(Frame(2, 2.0, x, box), bound=1.5)
    assert rows(flips) == [(0, 1, 0, True)] and flips.ambiguous.all() and flips.frame[0] == 2
    assert tracker.bound == 1.5 and tracker.near == 3


def test_images_of_an_atom_itself_come_and_go_with_the_box():
    x = np.array([[0.0, 0, 0], [1.0, 1.0, 1.0]])
    tracker = Tracker(CutoffRule(3.0))
    tracker.step(Frame(0, 0.0, x, Box(np.diag([3.1, 7.0, 7.0]), PERIODIC)))
    flips = tracker.step(Frame(1, 0.0, x, Box(np.diag([2.9, 7.0, 7.0]), PERIODIC)))
    assert [row for row in rows(flips) if row[0] == row[1]] == [(0, 0, 0, True), (1, 1, 0, True)]
    flips = tracker.step(Frame(2, 0.0, x, Box(np.diag([1.4, 7.0, 7.0]), PERIODIC)))
    assert [row[2] for row in rows(flips) if row[0] == row[1] == 0] == [1]
    flips = tracker.step(Frame(3, 0.0, x, Box(np.diag([9.0, 7.0, 7.0]), PERIODIC)))
    assert [row[2:] for row in rows(flips) if row[:2] == (1, 1)] == [(0, False), (1, False)]


def test_positions_that_are_no_numbers():
    x, box = np.zeros((4, 3)), Box()
    tracker = Tracker(CutoffRule(2.0), first=[1, 3])
    tracker.step(Frame(0, 0.0, x, box))
    broken = x.copy()
    broken[3, 1] = np.nan
    with pytest.raises(InputError, match=r"frame 17: atom 3 is at \[0.0, nan, 0.0\]"):
        tracker.step(Frame(17, 0.0, broken, box))
    # what was read before is still there, and an atom that takes no part may be anywhere
    assert tracker.frames == 1 and tracker.pairs == 1
    broken[3, 1], broken[2, 0] = 0.0, np.inf
    assert len(tracker.step(Frame(18, 0.0, broken, box))) == 0
    with pytest.raises(InputError, match="5 atoms, 4 in the frames before"):
        tracker.step(Frame(19, 0.0, np.zeros((5, 3)), box))


def test_selections_that_are_none():
    for chosen, says in (([0, 4], "atom 4 is selected"), ([-1, 2], "whole numbers")):
        with pytest.raises(InputError, match=says):
            Tracker(CutoffRule(1.0), first=np.array(chosen)).step(Frame(0, 0.0, np.zeros((4, 3)), Box()))
    with pytest.raises(InputError, match="3 species for frames of 4 atoms"):
        Tracker(CutoffRule(1.0), species=["O"] * 3).step(Frame(0, 0.0, np.zeros((4, 3)), Box()))
    for chosen in ([], [2]):
        tracker = Tracker(CutoffRule(1.0), first=np.array(chosen, int))
        assert len(tracker.step(Frame(0, 0.0, np.zeros((4, 3)), Box()))) == 0
        assert len(tracker.step(Frame(1, 0.0, np.ones((4, 3)), Box()))) == 0 == len(tracker.members())
