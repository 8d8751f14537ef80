"""Decisions and flips over frames are those of brute force, however they were found."""

from __future__ import annotations

import gc
import pickle
import tracemalloc

import numpy as np
import oracles
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from trajectories import brute_force
from trajectories.brute_force import PERIODIC, as_dict, atoms, boxes, cube, differences, rows, same
from trajectories.files import arrays_held

from mdnum.errors import InputError
from mdnum.md.ledger import FlipTable
from mdnum.trajectories import tiles
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.rules import NEVER, Capped, CutoffRule, Nearest, SpeciesCutoffs
from mdnum.trajectories.tracker import HORIZON, Tracker

BOUND = 0.05


@pytest.mark.parametrize("by_species", [False, True])
@settings(max_examples=60)
@given(data=st.data(), step=st.sampled_from([0.01, 0.3, 5.0]), radius=st.floats(0.5, 4.0))
def test_pairs_and_flips_of_a_radius(by_species, data, step, radius):
    """In any box, images and all; a radius for all, or for pairs of species between two sides."""
    box = data.draw(boxes())
    x = data.draw(atoms(box))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    sides, species, radii = (None, None), ["X"] * len(x), {("X", "X"): radius}
    if by_species:
        x = np.concatenate([x, rng.uniform(-3, 3, (2, 3))])
        species = [*rng.choice(["O", "H", "N"], len(x) - 2).tolist(), "O", "H"]
        radii = {("O", "H"): 2.5, ("O", "O"): 1.5}
        sides = tuple(rng.permutation(len(x))[: rng.integers(0, len(x) + 1)] for _ in range(2))
    chosen = [range(len(x)) if side is None else set(side.tolist()) for side in sides]
    reach = max(radii.values())

    def radius_of(i, j):
        return radii.get((species[i], species[j]), radii.get((species[j], species[i])))

    rule = SpeciesCutoffs(radii) if by_species else CutoffRule(radius)
    tracker, before, old = Tracker(rule, *sides, species, BOUND), None, x
    for frame in range(3):
        flips = tracker.step(Frame(frame, 0.0, x, box))
        pairs = brute_force.everything(x, box.matrix, box.pbc, *chosen, 1.1 * reach)
        assume(brute_force.clear(pairs, radius_of))
        now = brute_force.members(pairs, radius_of)
        same(as_dict(tracker.members()), now)
        assert rows(flips) == differences(before, now)
        for at, (i, j, rank, entered) in enumerate(rows(flips)):
            held, there, gone = (now, flips.distance, flips.before) if entered else (
                before, flips.before, flips.distance
            )  # fmt: skip
            assert there[at] == pytest.approx(held[i, j, rank], abs=1e-9)
            other = brute_force.image_list(old if entered else x, box.matrix, box.pbc, i, j, 8.0)
            if len(other) > rank:
                assert gone[at] == pytest.approx(np.sqrt(other[rank]), abs=1e-9)
        limits = np.array([radius_of(i, j) for i, j, *_ in rows(flips)])
        assert flips.margin == pytest.approx(limits - flips.distance)
        assert flips.margin_before == pytest.approx(limits - flips.before)
        close = np.minimum(abs(flips.margin), abs(flips.margin_before)) <= flips.bound
        assert (flips.ambiguous == close).all() and (flips.bound >= BOUND).all()
        assert tracker.pairs == len(now) and tracker.frames == frame + 1
        known = {pair: squares for pair, squares in pairs.items() if radius_of(*pair)}
        margins = np.array(
            [abs(radius_of(*p) - np.sqrt(one)) for p, squares in known.items() for one in squares]
        )
        if (abs(margins - BOUND) > 1e-9).all():
            assert tracker.near == (margins <= BOUND).sum()
        smallest = margins.min(initial=np.inf)
        if abs(smallest - HORIZON * reach) > 1e-3 * HORIZON * reach:
            smallest = smallest if smallest < HORIZON * reach else np.inf
            assert tracker.min_margin == pytest.approx(smallest, abs=1e-9)
        before, old = now, x
        # wrapped by the code that wrote it, or not
        x = x + rng.normal(size=x.shape) * step
        x = x + rng.integers(-1, 2, x.shape) @ np.where(box.pbc[:, None], box.matrix, 0.0)


@settings(max_examples=40)
@given(st.data(), st.integers(1, 6), st.booleans())
def test_pairs_and_flips_of_the_nearest_few(data, most, capped):
    box = data.draw(boxes())
    x = data.draw(atoms(box))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    sides = [np.sort(rng.permutation(len(x))[: rng.integers(0, len(x) + 1)]) for _ in range(2)]
    tracker, before, limits = Tracker(Capped(2.5, most) if capped else Nearest(most, 2.5), *sides), None, {}
    for frame in range(3):
        flips = tracker.step(Frame(frame, 0.0, x, box))
        now, new, clearly = brute_force.nearest(x, box.matrix, box.pbc, *sides, most, 2.5, 3.2)
        assume(clearly)
        same(as_dict(tracker.members()), now)
        assert rows(flips) == differences(before, now)
        for at, (i, _, _, entered) in enumerate(rows(flips)):
            last, after = new[i]
            assert flips.margin[at] == pytest.approx((after if entered else last) - flips.distance[at])
            last, after = limits[i]
            assert flips.margin_before[at] == pytest.approx((last if entered else after) - flips.before[at])
        before, limits = now, new
        x = x + rng.normal(size=x.shape) * 0.2


@pytest.mark.parametrize("periodic", [True, False])
def test_the_nearest_without_a_radius(periodic):
    rng, everyone = np.random.default_rng(1), range(40)
    x = rng.uniform(0, 12, (40, 3))
    # far from all others: the first radius tried holds nobody
    x[5] += 3.0 if periodic else 400.0
    box, reach = Box(np.eye(3) * 12.0, np.full(3, periodic)), 11.0 if periodic else 2000.0
    tracker = Tracker(Nearest(4))
    tracker.step(Frame(0, 0.0, x, box))
    right, limits, _ = brute_force.nearest(x, box.matrix, box.pbc, everyone, everyone, 4, np.inf, reach)
    same(as_dict(tracker.members()), right)
    assert tracker.min_margin == pytest.approx(min(after - last for last, after in limits.values()))
    # fewer others than asked for: all of them, and nothing that could replace one
    tracker = Tracker(Nearest(4), first=[0, 1, 2])
    tracker.step(Frame(0, 0.0, x, Box()))
    assert tracker.pairs == 6 and tracker.min_margin == np.inf


def test_a_neighbor_under_a_cap_stays_one_no_further_than_the_radius():
    # the next outside is beyond the radius, so the radius is what this one has to pass to leave
    x = np.array([[0.0, 0, 0], [2.5, 0, 0], [0, 2.01, 0]])
    tracker = Tracker(Capped(2.0, 1), first=[0], second=[1, 2])
    tracker.step(Frame(0, 0.0, x, Box()))
    x[1, 0] = 1.5
    flips = tracker.step(Frame(1, 0.0, x, Box()))
    assert rows(flips) == [(0, 1, 0, True)]
    assert (flips.margin, flips.margin_before) == (pytest.approx([0.5]), pytest.approx([-0.5]))


def test_a_tie_for_the_last_place_is_in_doubt():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 2, 0]])
    tracker = Tracker(Capped(5.0, 1), first=[0], second=[1, 2, 3])
    tracker.step(Frame(0, 0.0, x, Box()))
    assert set(as_dict(tracker.members())) == {(0, 1, 0)} and tracker.near == 2 and tracker.min_margin == 0.0
    # and its flip is called ambiguous, either way
    x[2] += [1e-17, 1e-9, 0]
    assert len(tracker.step(Frame(1, 1.0, x, Box()))) == 0
    x[1, 0] = 1.5
    flips = tracker.step(Frame(2, 2.0, x, Box()))
    assert rows(flips) == [(0, 1, 0, False), (0, 2, 0, True)]
    assert flips.ambiguous.all() and flips.margin == pytest.approx([-0.5, 0.5])


# ---- lists that are kept from frame to frame


def shifted(x, where, by):
    moved = x.copy()
    moved[where] += by
    return moved


STRAIN = np.eye(3) + np.array([[-0.004, 0.002, 0], [0, 0.003, -0.001], [0.001, 0, -0.004]])
#: The next positions and box from those of a frame k and displacements drawn at random.
MOVERS = {
    # two atoms run at one another at the same speed, all others rest
    "head on": lambda x, m, k, drawn, rng: (shifted(shifted(x, (0, 0), 0.03), (1, 0), -0.03), m),
    "drift": lambda x, m, k, drawn, rng: (x + np.array([0.03, -0.02, 0.01]), m),
    "one fast": lambda x, m, k, drawn, rng: (shifted(x, 3, 0.04 if k % 9 else 1.5), m),
    "jitter": lambda x, m, k, drawn, rng: (x + drawn, m),
    # fractional coordinates rest: nothing but the box moves
    "strained": lambda x, m, k, drawn, rng: (x @ STRAIN, m @ STRAIN),
    # nothing but the box moves, and atoms near its faces come nearer to one another through them
    "around resting atoms": lambda x, m, k, drawn, rng: (x, m @ STRAIN),
    "wrapping": lambda x, m, k, drawn, rng: (x + drawn + (k % 3 == 0) * rng.integers(-1, 2, x.shape) @ m, m),
    "resting": lambda x, m, k, drawn, rng: (x, m),
    # the same lattice with another vector from the middle on
    "reduced again": lambda x, m, k, drawn, rng: (x + drawn, shifted(m, 2, (k == 15) * 2.0 * m[0])),
}
MATRIX = np.array([[11.0, 0, 0], [2.0, 10.5, 0], [-1.0, 3.0, 10.0]])


@pytest.mark.parametrize("mover", MOVERS)
@pytest.mark.parametrize("bound", [0.0, 0.03])
def test_a_list_in_use_misses_nothing(mover, bound):
    rng = np.random.default_rng(7)
    x, matrix, radius, before = rng.uniform(0, 1, (150, 3)) @ MATRIX, MATRIX, 2.2, None
    x[1] = x[0] + [3.4, 0.01, 0.0]
    tracker, used, flipped = Tracker(CutoffRule(radius), bound=bound), 0, 0
    for k in range(30):
        held = tracker._list
        flips = tracker.step(Frame(k, 0.0, x, Box(matrix, PERIODIC)))
        i, j, d = oracles.all_pairs(x, matrix, PERIODIC)
        r = np.sqrt((d * d).sum(axis=1))
        now = {(*pair, 0): 0.0 for pair in np.transpose([i, j])[r < radius].tolist()}
        margins = abs(radius - r)
        assert rows(flips) == differences(before, now)
        assert tracker.pairs == len(now) and (bound == 0.0 or tracker.near == (margins <= bound).sum())
        smallest = margins.min()
        assert tracker.min_margin == pytest.approx(smallest if smallest <= HORIZON * radius else np.inf)
        used += held is not None and tracker._list is held
        flipped += len(flips)
        before = now
        x, matrix = MOVERS[mover](x, matrix, k, rng.normal(size=x.shape) * 0.01, rng)
    # it was the list that answered, most of the time
    assert used > 18 and (flipped > 0 or mover in ("drift", "resting"))


@pytest.mark.parametrize("forgets", [False, True])
def test_a_list_that_forgets_the_strain_of_its_box_misses_pairs(monkeypatch, forgets):
    """Two layers at rest meet through a face of a box that shrinks: no atom moves, and only strain counts."""
    right = tiles.Tiles.serve

    def serve(self, before, now, radius, clear):
        if forgets:
            self.vectors = now.lattice.vectors
        return right(self, before, now, radius, clear)

    monkeypatch.setattr(tiles.Tiles, "serve", serve)
    rng = np.random.default_rng(7)
    low, high = rng.uniform([0, 0, 1.6], [9, 8, 1.8], (2, 32, 3))
    x, tracker, before, used, missed = (
        np.concatenate([low, 20.0 - high]),
        Tracker(CutoffRule(2.2)),
        set(),
        0,
        0,
    )
    for k in range(30):
        matrix, held = np.diag([9.0, 8.0, 20.0 - 0.05 * k]), tracker._list
        flips = tracker.step(Frame(k, 0.0, x, Box(matrix, PERIODIC)))
        i, j, d = oracles.all_pairs(x, matrix, PERIODIC)
        now = {(*pair, 0, True) for pair in np.transpose([i, j])[(d * d).sum(axis=1) < 2.2**2].tolist()}
        missed += len(now - before - {row for row in rows(flips) if row[3]}) if k else 0
        used, before = used + (held is not None and tracker._list is held), now
    assert bool(missed) == forgets and used > 5 and len(now) > 100, (missed, used, len(now))


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
        assert rows(flips) == differences(before, now)
        used.append(tracker._list is not None)
        before, x = now, x + rng.normal(size=x.shape) * 0.005
    assert all(used[2:10]) and not any(used[10:]) and any(rank for _, _, rank in now)


def test_the_nearest_miss_is_found_though_only_another_pair_is_due():
    # two pairs rest at margins 0.05 and 0.03 while another atom, far away, turns the odometer
    x = np.array([[0.0, 0, 0], [1.95, 0, 0], [0, 8, 0], [1.97, 8, 0], [6, 5, 5]])
    tracker, used = Tracker(CutoffRule(2.0)), 0
    for k in range(40):
        tracker.step(Frame(k, 0.0, x, cube(20.0)))
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
            flips = [tracker.step(Frame(k, 0.0, x, cube(10.0))) for k, x in enumerate(frames)]
            made.append((FlipTable.concatenate(flips), tracker.members(), tracker.near, tracker.min_margin))
            lists.append(tracker._list is not None)
        return made

    lists: list[bool] = []
    listed = follow()
    monkeypatch.setattr(tiles, "FURTHEST", -1.0)
    fresh = follow()
    assert lists == [True] * 3 + [False] * 3
    for one, other in zip(listed, fresh, strict=True):
        assert len(one[0]) > 50 and one[2:] == other[2:]
        assert one[0].equals(other[0]) and one[1].equals(other[1])


def test_memory_does_not_grow_with_frames():
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 12, (200, 3))
    tracker, arrays, whole = Tracker(CutoffRule(2.0)), [], []
    tracemalloc.start()
    for k in range(80):
        tracker.step(Frame(k, 0.0, x, cube(12.0)))
        x = (x + rng.normal(size=x.shape) * (0.01 if k % 20 else 0.3)) % 12.0
        if k % 40 == 39:
            gc.collect()
            arrays.append(arrays_held())
            whole.append(len(pickle.dumps(tracker)))
    tracemalloc.stop()
    # far less than the 40 frames between
    for first, last in (arrays, whole):
        assert last < first + 10 * x.nbytes


@pytest.mark.parametrize("rule", [CutoffRule(2.0), Nearest(4), Capped(2.0, 5)], ids=lambda rule: rule.name)
def test_a_tracker_can_be_sent_to_another_process(rule):
    rng = np.random.default_rng(1)
    x, tracker, sent = rng.uniform(0, 9, (80, 3)), Tracker(rule), None
    for k in range(12):
        sent = pickle.loads(pickle.dumps(tracker)) if k == 6 else sent
        flips = tracker.step(Frame(k, 0.0, x, cube(9.0)))
        assert sent is None or sent.step(Frame(k, 0.0, x, cube(9.0))).equals(flips)
        x = x + rng.normal(size=x.shape) * 0.02
    assert sent is not None and sent.pairs == tracker.pairs


# ---- boxes, bounds and atoms that change, and what is refused


def test_a_box_may_come_and_go_and_a_bound_may_change():
    x = np.array([[0.5, 5, 5], [9.5, 5, 5], [3.0, 5, 5]])
    tracker = Tracker(CutoffRule(2.0))
    tracker.step(Frame(0, 0.0, x, cube(10.0)))
    flips = tracker.step(Frame(1, 1.0, x, Box()))
    assert rows(flips) == [(0, 1, 0, False)] and flips.distance[0] == 9.0 and flips.before[0] == 1.0
    flips = tracker.step(Frame(2, 2.0, x, cube(10.0)), bound=1.5)
    assert rows(flips) == [(0, 1, 0, True)] and flips.ambiguous.all() and flips.frame[0] == 2
    assert tracker.bound == 1.5 and tracker.near == 3


def test_images_of_an_atom_itself_come_and_go_with_the_box():
    tracker, own = Tracker(CutoffRule(3.0)), []
    for frame, edge in enumerate((3.1, 2.9, 1.4, 9.0)):
        box = Box(np.diag([edge, 7.0, 7.0]), PERIODIC)
        flips = tracker.step(Frame(frame, 0.0, np.array([[0.0, 0, 0], [1.0, 1.0, 1.0]]), box))
        own.append([row[1:] for row in rows(flips) if row[0] == row[1]])
    assert own == [
        [],
        [(0, 0, True), (1, 0, True)],
        [(0, 1, True), (1, 1, True)],
        [(0, 0, False), (0, 1, False), (1, 0, False), (1, 1, False)],
    ]


def test_positions_that_are_no_numbers():
    x, box = np.zeros((4, 3)), Box()
    tracker = Tracker(CutoffRule(2.0), first=[1, 3])
    tracker.step(Frame(0, 0.0, x, box))
    broken = shifted(x, (3, 1), np.nan)
    with pytest.raises(InputError, match=r"frame 17: atom 3 is at \[0.0, nan, 0.0\]"):
        tracker.step(Frame(17, 0.0, broken, box))
    # what was read before is still there, and an atom that takes no part may be anywhere
    assert tracker.frames == 1 and tracker.pairs == 1
    assert len(tracker.step(Frame(18, 0.0, shifted(x, (2, 0), np.inf), box))) == 0
    with pytest.raises(InputError, match=r"frame 19: .*5 atoms.* 4"):
        tracker.step(Frame(19, 0.0, np.zeros((5, 3)), box))


def test_species_cutoffs_are_the_same_in_both_directions():
    kinds, radii = SpeciesCutoffs({("O", "H"): 2.5, ("O", "O"): 3.5}).table(["O", "H", "H", "Na"])
    assert radii[kinds[0], kinds[1]] == radii[kinds[2], kinds[0]] == 2.5
    assert radii[kinds[1], kinds[2]] == radii[kinds[3], kinds[0]] == NEVER


def first_of_four(chosen, **options):
    return Tracker(CutoffRule(1.0), np.array(chosen, int), **options).step(
        Frame(0, 0.0, np.zeros((4, 3)), Box())
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *((lambda r=r: CutoffRule(r), "positive length") for r in (0.0, -1.0, np.nan, np.inf)),
        (lambda: Capped(-1.0, 3), "positive length"),
        (lambda: SpeciesCutoffs({("O", "H"): np.nan}), "positive length"),
        (lambda: Nearest(2, 0.0), "positive length"),
        *((lambda k=k: Nearest(k), "integer of at least 1") for k in (0, -1, True)),
        (lambda: Capped(1.0, 0), "integer of at least 1"),
        (lambda: SpeciesCutoffs({("O", "H"): 2.5, ("H", "O"): 2.6}), "two radii"),
        (lambda: SpeciesCutoffs({}), "no pair"),
        (lambda: SpeciesCutoffs({("Ow", "H"): 2.5}).table(["O", "H"]), "species 'Ow'; .* H, O"),
        (lambda: Tracker(SpeciesCutoffs({("O", "H"): 2.5})), "needs the species"),
        (lambda: first_of_four([0, 4]), "atom 4 is selected"),
        (lambda: first_of_four([-1, 2]), "integers"),
        (lambda: first_of_four([0], species=["O"] * 3), "3 species .* 4 atoms"),
    ],
)
def test_what_cannot_be_asked_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize("chosen", [[], [2]])
def test_nobody_and_one_atom_have_no_pairs(chosen):
    tracker = Tracker(CutoffRule(1.0), first=np.array(chosen, int))
    flips = [tracker.step(Frame(k, 0.0, np.full((4, 3), float(k)), Box())) for k in range(2)]
    assert [len(one) for one in flips] == [0, 0] and len(tracker.members()) == 0
