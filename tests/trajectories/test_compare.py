"""Two trajectories against sets compared anew at every frame, and separations worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trajectories.membership import ledger, random_membership

from mdnum.md.ledger import Members
from mdnum.trajectories.follow import SetDifference, distances
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.separation import displacements, growth, same_lattice, separation


@given(st.integers(0, 10**6), st.integers(1, 30))
@settings(max_examples=30)
def test_the_difference_carried_along_is_that_of_the_sets(seed: int, differing: int) -> None:
    a, names = random_membership(seed)
    b = a.copy()
    b[:differing, 3:] = random_membership(seed + 1)[0][:differing, 3:]
    (flips_a, first_a), (flips_b, first_b) = ledger(a, names), ledger(b, names)
    found = SetDifference.of(first_a, first_b)
    assert not len(found) and found.new == []
    before: set[tuple[int, int, int]] = set()
    for frame in range(1, a.shape[1]):
        found.step(*(flips[flips.frame == frame] for flips in (flips_a, flips_b)))
        in_a, in_b = ({names[p] for p in np.flatnonzero(one[:, frame])} for one in (a, b))
        assert found.only_a == in_a - in_b and found.only_b == in_b - in_a
        assert set(found.new) == (in_a ^ in_b) - before and found.new == sorted(found.new)
        before = in_a ^ in_b


def test_sets_that_differ_from_the_start() -> None:
    one, other = (
        Members(np.array(i), np.array(j), np.array(rank), np.ones(2))
        for i, j, rank in (([0, 0], [1, 2], [0, 0]), ([0, 1], [2, 1], [0, 3]))
    )
    found = SetDifference.of(one, other)
    assert found.only_a == {(0, 1, 0)} and found.only_b == {(1, 1, 3)} and len(found) == 2
    assert found.new == [(0, 1, 0), (1, 1, 3)]


def test_displacements_go_through_the_boundary_of_any_box() -> None:
    matrix = np.array([[10.0, 0, 0], [17.0, 9.0, 0], [-24.0, 31.0, 8.0]])
    rng = np.random.default_rng(1)
    start = rng.uniform(-30, 30, (200, 3))
    moved = rng.uniform(-1.5, 1.5, (200, 3))
    whole = rng.integers(-4, 5, (200, 3)).astype(float)
    whole[:, 2] = 0
    box = Box(matrix, np.array([True, True, False]))
    end = Frame(0, 0.0, start + moved + whole @ matrix, box)
    np.testing.assert_allclose(displacements(Frame(0, 0.0, start, box), end)[0], moved, atol=1e-12)
    free = Frame(0, 0.0, start + 100.0, Box())
    np.testing.assert_allclose(displacements(Frame(0, 0.0, start, Box()), free)[0], 100.0, atol=1e-12)
    found = separation(Frame(0, 0.0, start, box), end, np.array([3, 8]))
    sizes = np.linalg.norm(moved[[3, 8]], axis=1)
    assert found.furthest == pytest.approx(sizes.max()) and found.atom == (3, 8)[int(sizes.argmax())]
    assert found.typical == pytest.approx(np.sqrt((sizes**2).mean()))


def test_distances_through_the_image_that_a_rank_names() -> None:
    frame = Frame(
        0, 0.0, np.array([[0.5, 0, 0], [9.0, 0, 0]]), Box(np.diag([10.0, 40, 40]), np.ones(3, bool))
    )
    np.testing.assert_allclose(distances(frame, [(0, 1, 0), (0, 1, 1), (1, 1, 0)]), [1.5, 8.5, 10.0])
    assert distances(frame, []).shape == (0,)


def test_growth_is_the_rate_of_an_exponential() -> None:
    time = np.linspace(0, 10, 50)
    found = growth(time, 1e-9 * np.exp(1.7 * time), 1e-4, (-10.0, 0.0))
    assert found is not None and found.law == "exponential" and found.frames < 50
    assert found.rate == pytest.approx(1.7) and found.r2 == pytest.approx(1.0)
    began = (0.0, 0.0)
    assert growth(time[:4], time[:4], 1.0, began) is None and growth(time, np.zeros(50), 1.0, began) is None


def test_a_lattice_is_the_same_whichever_vectors_name_it() -> None:
    matrix = np.array([[10.0, 0, 0], [3.0, 9.0, 0], [-2.0, 1.0, 8.0]])
    whole = np.array([[1, 2, 0], [0, 1, 0], [-3, 1, 1]])
    every, slab = np.ones(3, bool), np.array([True, True, False])
    one = Box(matrix, every)
    assert same_lattice(one, one, 0.0) and same_lattice(one, Box(whole @ matrix, every), 1e-12)
    assert same_lattice(one, Box(matrix + 1e-4, every), 2e-4)
    assert not same_lattice(one, Box(matrix + 1e-4, every), 5e-5)
    # a cell of twice the volume holds the same vectors and more, or fewer
    assert not same_lattice(one, Box(np.diag([2, 1, 1]) @ matrix, every), 1e-9)
    assert not same_lattice(Box(np.diag([2, 1, 1]) @ matrix, every), one, 1e-9)
    assert not same_lattice(one, Box(matrix, slab), 1.0)
    # the vector of an axis that does not repeat is not looked at
    assert same_lattice(Box(matrix, slab), Box(np.vstack([matrix[:2], np.zeros(3)]), slab), 0.0)


def test_an_axis_that_repeats_in_one_frame_only_has_no_images() -> None:
    x = np.array([[1.0, 2.0, 3.0]])
    every, slab = (Box(np.diag([10.0, 10, 10]), np.array(pbc)) for pbc in ([True] * 3, [True, True, False]))
    for boxes in ((every, slab), (slab, every)):
        start, end = Frame(0, 0.0, x, boxes[0]), Frame(0, 0.0, x + np.array([10.0, -20.0, 10.0]), boxes[1])
        np.testing.assert_array_equal(displacements(start, end)[0], [[0, 0, 10.0]])
        found = separation(start, end)
        assert found.furthest == 10.0 and found.periods == 2
