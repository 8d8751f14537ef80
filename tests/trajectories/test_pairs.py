"""Lattices and images; near the cutoff, what fractions give or a doubt; and searches that are refused."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trajectories import brute_force
from trajectories.brute_force import PERIODIC, as_dict, boxes, cube

from mdnum.errors import InputError
from mdnum.trajectories import search
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.lattice import grid_for, image_square, lattice_of, own_images
from mdnum.trajectories.rules import CutoffRule
from mdnum.trajectories.tracker import Tracker


def decided(x, box: Box, radius: float) -> Tracker:
    """A tracker that has seen one frame."""
    tracker = Tracker(CutoffRule(radius))
    tracker.step(Frame(0, 0.0, x, box))
    return tracker


@settings(max_examples=25)
@given(boxes(), st.integers(0, 1000))
def test_reduced_vectors_span_the_same_lattice_and_are_short(box, seed):
    lattice = lattice_of(box)
    rows = lattice.vectors[box.pbc]
    assert abs(np.linalg.det(lattice.combination)) == pytest.approx(1.0)
    assert np.where(box.pbc[:, None], lattice.combination @ box.matrix, 0.0) == pytest.approx(lattice.vectors)
    # the definition: no vector gets shorter by adding others, each at most once
    for k, row in enumerate(rows):
        others = np.delete(rows, k, axis=0)
        for signs in itertools.product((-1, 0, 1), repeat=len(others)):
            longer = row + np.array(signs) @ others if len(others) else row
            assert np.linalg.norm(longer) >= np.linalg.norm(row) * (1 - 1e-9)
    # and images by rank are those of brute force
    x = np.random.default_rng(seed).uniform(-9, 9, (2, 3))
    for i, j in ((0, 1), (0, 0)):
        right = brute_force.image_list(x, box.matrix, box.pbc, i, j, 9.0)
        for rank, square in enumerate(right[:6]):
            assert image_square(x, i, j, rank, lattice) == pytest.approx(square, rel=1e-9, abs=1e-9)
    assert own_images(lattice, 9.0) == pytest.approx(right, rel=1e-9)


def near_the_cutoff(rng, radius: float, matrix) -> np.ndarray:
    """100 pairs far from one another, each a few ulps from the radius apart, some through the boundary."""
    middles = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), -1).reshape(-1, 3)[:100] * 4.0
    along = rng.normal(size=(100, 3))
    along /= np.linalg.norm(along, axis=1)[:, None]
    first = middles + rng.uniform(0, 0.5, (100, 3))
    second = first + along * radius * (1 + rng.integers(-6, 7, (100, 1)) * 2.0**-53)
    x = np.concatenate([first, second])
    return x + rng.integers(-1, 2, (200, 3)) @ matrix


def exactly(x, matrix, radius: float) -> list[bool]:
    """Whether each of those pairs is inside, by fractions."""
    return [brute_force.exactly_inside(x, matrix, PERIODIC, k, k + 100, 0, radius) for k in range(100)]


def test_near_the_cutoff_a_decision_is_that_of_exact_arithmetic_or_in_doubt():
    rng, radius = np.random.default_rng(3), 1.1
    matrix = np.array([[20.0, 0, 0], [1.0, 20.1, 0], [-2.0, 0.7, 19.9]])
    differ, doubts = 0, 0
    for _ in range(4):
        x = near_the_cutoff(rng, radius, matrix)
        tracker = decided(
            x + np.repeat([[0.0, 0, 0], [1.0, 1.0, 1.0]], 100, axis=0), Box(matrix, PERIODIC), radius
        )
        flips = tracker.step(Frame(1, 0.0, x, Box(matrix, PERIODIC)))
        mine = flips.j == flips.i + 100
        assert mine.sum() > 20 and flips.ambiguous[mine].all()
        members = as_dict(tracker.members())
        assert all(j == i + 100 for i, j, _ in members)
        # all 100 are in doubt by the tracker's own count, so none that fell otherwise was called sure
        assert tracker.near == 100
        exact = exactly(x, matrix, radius)
        differ += sum(inside != ((k, 100 + k, 0) in members) for k, inside in enumerate(exact))
        doubts += tracker.near
    # the test can tell: some pairs do fall otherwise than real arithmetic has them
    assert 0 < differ < doubts


def test_a_pair_out_of_doubt_is_that_of_exact_arithmetic():
    rng, radius, box = np.random.default_rng(4), 1.1, cube(20.0)
    x = near_the_cutoff(rng, radius, box.matrix)
    bound = lattice_of(box).rounding(float(abs(x).max()), radius)
    signs = rng.choice([-1.0, 1.0], 100)
    away = x[100:] - x[:100]
    away -= np.rint(away / 20.0) * 20.0
    x[100:] += away / radius * (1.5 * bound * signs)[:, None]
    members = as_dict(decided(x, box, radius).members())
    inside = [(k, 100 + k, 0) in members for k in range(100)]
    assert exactly(x, box.matrix, radius) == inside == (signs < 0).tolist()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tiny_negative_coordinates_are_in_the_box(axis):
    x = np.full((3, 3), 5.0)
    x[0, axis], x[1, axis], x[2, axis] = -1e-52, 0.0, 10.0
    members = decided(x, cube(10.0), 1.0).members()
    assert set(as_dict(members)) == {(0, 1, 0), (0, 2, 0), (1, 2, 0)}


def test_one_atom_far_away_makes_no_large_grid():
    bins, _, _ = grid_for(lattice_of(Box()), 2.0, 1000, np.array([1e12, 30.0, 30.0]))
    assert np.prod(bins) <= 2000 and bins.min() >= 3
    x = np.random.default_rng(0).uniform(0, 12, (300, 3))
    x[7] = 1e9, -1e9, 3.0
    i, j = np.triu_indices(300, 1)
    inside = np.linalg.norm(x[i] - x[j], axis=1) < 2.0
    members = decided(x, Box(), 2.0).members()
    assert (members.i == i[inside]).all() and (members.j == j[inside]).all()


DRAWN = np.random.default_rng(0).uniform(0, 15.9, (400, 3))


@pytest.mark.parametrize(
    ("x", "box", "radius", "message"),
    [
        (DRAWN, Box(np.zeros((3, 3)), PERIODIC), 1.0, "axis 0"),
        (DRAWN, Box(np.diag([5.0, np.nan, 5.0]), PERIODIC), 1.0, "axis 1"),
        (DRAWN, Box(np.array([[5.0, 0, 0], [0, 5, 0], [5, 5, 0]]), PERIODIC), 1.0, "one plane"),
        (np.zeros((2, 3)), cube(1.0), 1000.0, "widths"),
        (np.zeros((2000, 3)), cube(2.0), 100.0, "closer than"),
        (np.full((2, 3), 1e14), Box(), 1.0, "float64 cannot resolve"),
        # of 4/3 π r³ / V images and half as many pairs as atoms squared
        (DRAWN[:108], cube(15.9), 500.0, r"759,\d{3},\d{3} pairs .* 500. .* about 130,\d{3} periodic images"),
    ],
)
def test_what_cannot_be_searched_is_refused(x, box, radius, message):
    with pytest.raises(InputError, match=message):
        decided(x, box, radius)


def test_a_small_crystal_may_be_asked_for_many_images():
    pairs = decided(DRAWN[:4], cube(15.9), 90.0).pairs
    assert pairs == pytest.approx(8 * 4 / 3 * np.pi * (90 / 15.9) ** 3, rel=0.05)


@pytest.mark.parametrize("periodic", [True, False])
def test_pairs_that_do_not_fit_into_memory_are_refused(monkeypatch, periodic):
    box = Box(15.9 * np.eye(3), np.full(3, periodic))
    pairs = decided(DRAWN, box, 30.0).pairs
    monkeypatch.setattr(search, "_memory", lambda: 95.0 * (pairs - 10_000))
    with pytest.raises(InputError, match=r"closer than 30 .* GB .*\d"):
        decided(DRAWN, box, 30.0)
