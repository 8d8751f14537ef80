"""A search gives what trying every image gives; near the cutoff, what fractions give, or a doubt."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from trajectories import brute_force
from trajectories.brute_force import as_dict, atoms, boxes, same

from mdnum.errors import InputError
from mdnum.trajectories import search as pairs
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.lattice import grid_for, image_square, lattice_of, own_images
from mdnum.trajectories.rules import CutoffRule
from mdnum.trajectories.tracker import HORIZON, Tracker

PERIODIC = np.ones(3, bool)


@settings(max_examples=40)
@given(st.data(), st.floats(0.5, 4.0))
def test_every_pair_and_every_image_in_any_box(data, radius):
    box = data.draw(boxes())
    positions = data.draw(atoms(box))
    tracker = Tracker(CutoffRule(radius), bound=0.05)
    tracker.step(Frame(0, 0.0, positions, box))
    everyone = range(len(positions))
    pairs = brute_force.everything(positions, box.matrix, box.pbc, everyone, everyone, 1.1 * radius)
    assume(brute_force.clear(pairs, lambda i, j: radius))
    same(as_dict(tracker.members()), brute_force.members(pairs, lambda i, j: radius))
    margins = np.array([abs(radius - np.sqrt(square)) for squares in pairs.values() for square in squares])
    if (abs(margins - 0.05) > 1e-9).all():
        assert tracker.near == (margins <= 0.05).sum()
    smallest = margins.min(initial=np.inf)
    if smallest < 0.999 * HORIZON * radius:
        assert tracker.min_margin == pytest.approx(smallest, abs=1e-9)
    elif smallest > 1.001 * HORIZON * radius:
        assert tracker.min_margin == np.inf


@settings(max_examples=25)
@given(boxes())
def test_reduced_vectors_span_the_same_lattice_and_are_short(box):
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


@settings(max_examples=25)
@given(st.data())
def test_images_by_rank(data):
    box = data.draw(boxes())
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    x, lattice = rng.uniform(-9, 9, (2, 3)), lattice_of(box)
    for i, j in ((0, 1), (0, 0)):
        right = brute_force.image_list(x, box.matrix, box.pbc, i, j, 9.0)
        for rank, square in enumerate(right[:6]):
            assert image_square(x, i, j, rank, lattice) == pytest.approx(square, rel=1e-9, abs=1e-9)
    assert own_images(lattice, 9.0) == pytest.approx(right, rel=1e-9)


def near_the_cutoff(rng, count: int, radius: float, matrix) -> np.ndarray:
    """Pairs far from one another, each a few ulps from the radius apart, at times through the boundary."""
    middles = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count] * 4.0
    along = rng.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1)[:, None]
    first = middles + rng.uniform(0, 0.5, (count, 3))
    second = first + along * radius * (1 + rng.integers(-6, 7, (count, 1)) * 2.0**-53)
    x = np.concatenate([first, second])
    return x + rng.integers(-1, 2, (2 * count, 3)) @ matrix


def test_near_the_cutoff_a_decision_is_that_of_exact_arithmetic_or_in_doubt():
    rng, radius = np.random.default_rng(3), 1.1
    matrix = np.array([[20.0, 0, 0], [1.0, 20.1, 0], [-2.0, 0.7, 19.9]])
    differ, doubts = 0, 0
    for _ in range(4):
        x = near_the_cutoff(rng, 100, radius, matrix)
        tracker = Tracker(CutoffRule(radius))
        apart = x + np.repeat([[0.0, 0, 0], [1.0, 1.0, 1.0]], 100, axis=0)
        tracker.step(Frame(0, 0.0, apart, Box(matrix, PERIODIC)))
        flips = tracker.step(Frame(1, 0.0, x, Box(matrix, PERIODIC)))
        mine = flips.j == flips.i + 100
        assert mine.sum() > 20 and flips.ambiguous[mine].all()
        members = as_dict(tracker.members())
        others = set(itertools.combinations(range(200), 2)) - {(k, 100 + k) for k in range(100)}
        assert not {(i, j) for i, j, _ in members} & others
        exact = [brute_force.exactly_inside(x, matrix, PERIODIC, k, k + 100, 0, radius) for k in range(100)]
        wrong = [k for k in range(100) if exact[k] != ((k, 100 + k, 0) in members)]
        # all 100 are in doubt by the tracker's own count, so none that fell otherwise was called sure
        assert tracker.near == 100
        differ, doubts = differ + len(wrong), doubts + tracker.near
    # the test can tell: some pairs do fall otherwise than real arithmetic has them
    assert 0 < differ < doubts


def test_a_pair_out_of_doubt_is_that_of_exact_arithmetic():
    rng, radius = np.random.default_rng(4), 1.1
    matrix = np.diag([20.0, 20.0, 20.0])
    x = near_the_cutoff(rng, 100, radius, matrix)
    bound = lattice_of(Box(matrix, PERIODIC)).rounding(float(abs(x).max()), radius)
    signs = rng.choice([-1.0, 1.0], 100)
    away = x[100:] - x[:100]
    away -= np.rint(away / 20.0) * 20.0
    x[100:] += away / radius * (1.5 * bound * signs)[:, None]
    tracker = Tracker(CutoffRule(radius))
    tracker.step(Frame(0, 0.0, x, Box(matrix, PERIODIC)))
    members = as_dict(tracker.members())
    for k in range(100):
        exact = brute_force.exactly_inside(x, matrix, PERIODIC, k, k + 100, 0, radius)
        assert exact == (signs[k] < 0) == ((k, 100 + k, 0) in members)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tiny_negative_coordinates_are_in_the_box(axis):
    x = np.full((3, 3), 5.0)
    x[0, axis], x[1, axis], x[2, axis] = -1e-52, 0.0, 10.0
    tracker = Tracker(CutoffRule(1.0))
    tracker.step(Frame(0, 0.0, x, Box(np.eye(3) * 10.0, PERIODIC)))
    assert set(as_dict(tracker.members())) == {(0, 1, 0), (0, 2, 0), (1, 2, 0)}


def test_one_atom_far_away_makes_no_large_grid():
    lattice = lattice_of(Box())
    bins, _, _ = grid_for(lattice, 2.0, 1000, np.array([1e12, 30.0, 30.0]))
    assert np.prod(bins) <= 2000 and bins.min() >= 3
    x = np.random.default_rng(0).uniform(0, 12, (300, 3))
    x[7] = 1e9, -1e9, 3.0
    tracker = Tracker(CutoffRule(2.0))
    tracker.step(Frame(0, 0.0, x, Box()))
    i, j = np.triu_indices(300, 1)
    inside = np.linalg.norm(x[i] - x[j], axis=1) < 2.0
    members = tracker.members()
    assert (members.i == i[inside]).all() and (members.j == j[inside]).all()


@pytest.mark.parametrize(
    ("box", "says"),
    [
        (Box(np.zeros((3, 3)), PERIODIC), "direction 0"),
        (Box(np.diag([5.0, np.nan, 5.0]), PERIODIC), "direction 1"),
        (Box(np.array([[5.0, 0, 0], [0, 5, 0], [5, 5, 0]]), PERIODIC), "one plane"),
    ],
)
def test_a_box_that_is_none(box, says):
    with pytest.raises(InputError, match=says):
        lattice_of(box)


def test_a_cutoff_that_makes_no_sense_in_its_box_is_refused():
    tracker = Tracker(CutoffRule(1000.0))
    with pytest.raises(InputError, match="widths"):
        tracker.step(Frame(0, 0.0, np.zeros((2, 3)), Box(np.eye(3), PERIODIC)))
    tracker = Tracker(CutoffRule(100.0))
    with pytest.raises(InputError, match="pairs within"):
        tracker.step(Frame(0, 0.0, np.zeros((2000, 3)), Box(np.eye(3) * 2.0, PERIODIC)))
    tracker = Tracker(CutoffRule(1.0))
    with pytest.raises(InputError, match="float64 cannot resolve"):
        tracker.step(Frame(0, 0.0, np.full((2, 3), 1e14), Box()))


def test_more_images_than_anybody_means_are_refused_before_they_are_looked_for():
    x = np.random.default_rng(0).uniform(0, 15.9, (108, 3))
    frame = Frame(0, 0.0, x, Box(15.9 * np.eye(3), PERIODIC))
    # of 4/3 π r³ / V images and half as many pairs as atoms squared
    with pytest.raises(
        InputError, match=r"about 759,\d{3},\d{3} pairs within 500: .* about 130,\d{3} images"
    ):
        Tracker(CutoffRule(500.0), None, None, None, 0.0).step(frame)
    # a small crystal may be asked for many images of its few atoms
    few = Tracker(CutoffRule(90.0), None, None, None, 0.0)
    few.step(Frame(0, 0.0, x[:4], frame.box))
    assert few.pairs == pytest.approx(8 * 4 / 3 * np.pi * (90 / 15.9) ** 3, rel=0.05)


@pytest.mark.parametrize("periodic", [True, False])
def test_pairs_that_do_not_fit_into_memory_are_refused(monkeypatch, periodic):
    x = np.random.default_rng(0).uniform(0, 15.9, (400, 3))
    frame = Frame(0, 0.0, x, Box(15.9 * np.eye(3), np.full(3, periodic)))
    tracker = Tracker(CutoffRule(30.0), None, None, None, 0.0)
    tracker.step(frame)
    monkeypatch.setattr(pairs, "_memory", lambda: 95.0 * (tracker.pairs - 10_000))
    with pytest.raises(InputError, match=r"pairs within 30, which would take .* GB of this machine's"):
        Tracker(CutoffRule(30.0), None, None, None, 0.0).step(frame)
