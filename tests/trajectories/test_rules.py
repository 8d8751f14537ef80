"""Membership rules: what they take, and directed ones against a plain sort."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from trajectories import brute_force
from trajectories.brute_force import as_dict, atoms, boxes, same

from mdnum.errors import InputError
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.rules import NEVER, Capped, CutoffRule, Nearest, SpeciesCutoffs
from mdnum.trajectories.tracker import Tracker


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, np.inf])
def test_a_radius_is_a_positive_length(radius):
    for make in (
        CutoffRule,
        lambda r: Capped(r, 3),
        lambda r: SpeciesCutoffs({("O", "H"): r}),
        lambda r: Nearest(2, r),
    ):
        with pytest.raises(InputError, match="positive length"):
            make(radius)


@pytest.mark.parametrize("count", [0, -1, True])
def test_a_number_of_neighbors_is_whole(count):
    for make in (Nearest, lambda k: Capped(1.0, k)):
        with pytest.raises(InputError, match="whole number"):
            make(count)


def test_species_cutoffs_are_the_same_in_both_directions():
    kinds, radii = SpeciesCutoffs({("O", "H"): 2.5, ("O", "O"): 3.5}).table(["O", "H", "H", "Na"])
    assert radii[kinds[0], kinds[1]] == radii[kinds[2], kinds[0]] == 2.5
    assert radii[kinds[1], kinds[2]] == radii[kinds[3], kinds[0]] == NEVER
    with pytest.raises(InputError, match="two radii"):
        SpeciesCutoffs({("O", "H"): 2.5, ("H", "O"): 2.6})
    with pytest.raises(InputError, match="no pair"):
        SpeciesCutoffs({})
    with pytest.raises(InputError, match="no atom is of species 'Ow'"):
        SpeciesCutoffs({("Ow", "H"): 2.5}).table(["O", "H"])
    with pytest.raises(InputError, match="which species"):
        Tracker(SpeciesCutoffs({("O", "H"): 2.5}))


@settings(max_examples=40)
@given(st.data())
def test_species_and_sides(data):
    box = data.draw(boxes())
    positions = data.draw(atoms(box))
    count, rng = len(positions), np.random.default_rng(data.draw(st.integers(0, 1000)))
    species = rng.choice(["O", "H", "N"], count + 2)
    species[-2:] = "O", "H"
    positions = np.concatenate([positions, rng.uniform(-3, 3, (2, 3))])
    first, second = (rng.permutation(count + 2)[: rng.integers(0, count + 3)] for _ in range(2))
    radii = {("O", "H"): 2.5, ("O", "O"): 1.5}
    tracker = Tracker(SpeciesCutoffs(radii), first, second, species)
    tracker.step(Frame(0, 0.0, positions, box))
    pairs = brute_force.everything(positions, box.matrix, box.pbc, set(first), set(second), 2.6)

    def radius(i, j):
        return radii.get((species[i], species[j]), radii.get((species[j], species[i])))

    assume(brute_force.clear(pairs, radius))
    same(as_dict(tracker.members()), brute_force.members(pairs, radius))
    assert tracker.pairs == len(tracker.members())


@settings(max_examples=40)
@given(st.data(), st.integers(1, 6), st.booleans())
def test_the_nearest_few(data, most, capped):
    box = data.draw(boxes())
    positions = data.draw(atoms(box))
    count, rng = len(positions), np.random.default_rng(data.draw(st.integers(0, 1000)))
    sides = [rng.permutation(count)[: rng.integers(0, count + 1)] for _ in range(2)]
    tracker = Tracker(Capped(2.5, most) if capped else Nearest(most, 2.5), *sides)
    tracker.step(Frame(0, 0.0, positions, box))
    right, _, clearly = brute_force.nearest(
        positions, box.matrix, box.pbc, sorted(sides[0]), sorted(sides[1]), most, 2.5, 3.0
    )
    assume(clearly)
    same(as_dict(tracker.members()), right)


@pytest.mark.parametrize("periodic", [True, False])
def test_the_nearest_without_a_radius(periodic):
    rng = np.random.default_rng(1)
    positions = rng.uniform(0, 12, (40, 3))
    # far from all others: the first radius tried holds nobody
    positions[5] += 3.0 if periodic else 400.0
    box = Box(np.eye(3) * 12.0, np.full(3, periodic))
    tracker = Tracker(Nearest(4))
    tracker.step(Frame(0, 0.0, positions, box))
    everyone = range(40)
    reach = 11.0 if periodic else 2000.0
    right, limits, _ = brute_force.nearest(
        positions, box.matrix, box.pbc, everyone, everyone, 4, np.inf, reach
    )
    same(as_dict(tracker.members()), right)
    gaps = [after - last for last, after in limits.values()]
    assert tracker.min_margin == pytest.approx(min(gaps))
    # fewer others than asked for: all of them, and nothing that could replace one
    tracker = Tracker(Nearest(4), first=[0, 1, 2])
    tracker.step(Frame(0, 0.0, positions, Box()))
    assert tracker.pairs == 6 and tracker.min_margin == np.inf


def test_a_neighbor_under_a_cap_stays_one_no_further_than_the_radius():
    # the next outside is beyond the radius, so the radius is what this one has to pass to leave
    x = np.array([[0.0, 0, 0], [2.5, 0, 0], [0, 2.01, 0]])
    tracker = Tracker(Capped(2.0, 1), first=[0], second=[1, 2])
    tracker.step(Frame(0, 0.0, x, Box()))
    x[1, 0] = 1.5
    flips = tracker.step(Frame(1, 0.0, x, Box()))
    assert flips.j.tolist() == [1] and flips.margin == pytest.approx([0.5])
    assert flips.margin_before == pytest.approx([-0.5])


def test_a_tie_for_the_last_place_is_in_doubt():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 2, 0]])
    tracker = Tracker(Capped(5.0, 1), first=[0], second=[1, 2, 3])
    tracker.step(Frame(0, 0.0, x, Box()))
    assert set(as_dict(tracker.members())) == {(0, 1, 0)} and tracker.near == 2 and tracker.min_margin == 0.0
    # and its flip is called ambiguous, either way
    x[2] += [1e-17, 1e-9, 0]
    flips = tracker.step(Frame(1, 1.0, x, Box()))
    assert len(flips) == 0
    x[1, 0] = 1.5
    flips = tracker.step(Frame(2, 2.0, x, Box()))
    assert (
        flips.i.tolist() == [0, 0] and flips.j.tolist() == [1, 2] and flips.entered.tolist() == [False, True]
    )
    assert flips.ambiguous.all() and flips.margin == pytest.approx([-0.5, 0.5])
