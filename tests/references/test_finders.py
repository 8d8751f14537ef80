"""Other libraries' neighbor searches, and where each stops counting."""

from __future__ import annotations

from collections import Counter

import numpy as np
import oracles
import pytest

from mdnum.references.effective import borderline_pairs, effective_cutoff
from mdnum.references.finders import PEERS, Finder, FinderError, half
from mdnum.references.oracle import all_pairs, exactly_inside
from mdnum.references.pairs import compare_pairs

BOXES = {
    "orthorhombic": (np.diag([13.0, 14.0, 15.0]), (True, True, True)),
    "tilted": (np.array([[13.0, 0, 0], [4, 14, 0], [-3, 2, 15.0]]), (True, True, True)),
    "rotated": (np.array([[13.0, 3, 1], [4, 14, 2], [-3, 2, 15.0]]), (True, True, True)),
    "slab": (np.diag([13.0, 14.0, 15.0]), (True, True, False)),
    "free": (np.zeros((3, 3)), (False, False, False)),
    "small": (np.diag([3.0, 4.0, 5.0]), (True, True, True)),
}


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("finder", PEERS, ids=lambda finder: finder.name)
def test_finds_the_pairs_of_the_oracle(finder: Finder, box: str):
    cell, pbc = BOXES[box][0], np.array(BOXES[box][1])
    r_cut = 4.0
    if (why := finder.refusal(cell, pbc, r_cut)) is not None:
        pytest.skip(why)
    rng = np.random.default_rng(1)
    positions = rng.uniform(-10, 20, (12 if box == "small" else 120, 3))
    i, j, distance = finder.pairs(positions, cell, pbc, r_cut)
    assert (i <= j).all()
    found = Counter(zip(i.tolist(), j.tolist(), strict=True))
    if box == "small":
        assert found == oracles.image_pairs(positions, cell, pbc, r_cut)
    else:
        assert found == Counter(oracles.minimum_image_pairs(positions, cell, pbc, r_cut))
    truth = all_pairs(positions, cell, pbc, r_cut)
    np.testing.assert_allclose(
        np.sort(distance), np.sort(truth.distance[truth.inside]), atol=1e3 * finder.unit_roundoff * r_cut
    )


@pytest.mark.parametrize(
    ("name", "ulps", "comparison"),
    [
        ("numpy r² <", -1, "<"),
        ("ASE neighbor_list", -1, "<"),
        ("ASE PrimitiveNeighborList", -1, "<"),
        ("vesin", -1, "<"),
        ("scipy cKDTree", 0, "<="),
        ("MDAnalysis nsgrid", None, "<= in float32"),
        ("MDAnalysis brute force", None, "<= in float32"),
    ],
)
def test_effective_cutoff(name: str, ulps: int | None, comparison: str):
    (finder,) = (one for one in PEERS if one.name == name)
    effective = effective_cutoff(finder, 2.5, oriented=20)
    assert effective.comparison == comparison
    if ulps is None:
        # half a float32 step beyond 2.5, which is where rounding to float32 sends a double elsewhere
        assert 2.3e-8 < effective.last_counted / 2.5 - 1 < 4.8e-8
    else:
        assert effective.ulps == ulps


def _shifted(delta: float) -> Finder:
    def search(positions, cell, pbc, r_cut):
        distance = np.linalg.norm(positions[1] - positions[0])
        hit = [0] if distance < r_cut + delta else []
        return np.array(hit, int), np.array(hit, int) + 1, np.full(len(hit), distance)

    return Finder("planted", "numpy", search)


@pytest.mark.parametrize("ulps", [-5, -1, 0, 7])
def test_effective_cutoff_of_a_planted_offset(ulps: int):
    effective = effective_cutoff(_shifted(ulps * np.spacing(2.5)), 2.5, periodic=False, oriented=0)
    assert effective.ulps == ulps - 1


def test_effective_cutoff_of_something_else():
    assert effective_cutoff(_shifted(1.0), 2.5, oriented=0).comparison == "not a cutoff"


def test_borderline_pairs_are_on_both_sides():
    pairs = borderline_pairs(2.5, 50, 0)
    inside = [exactly_inside(pair, np.zeros((3, 3)), 0, 1, (0, 0, 0), 2.5) for pair in pairs]
    assert 5 < sum(inside) < 45


def test_a_search_that_raises_says_so():
    def search(positions, cell, pbc, r_cut):
        raise IndexError("index 6 is out of bounds")

    with pytest.raises(FinderError, match=r"planted: IndexError: index 6 is out of bounds"):
        Finder("planted", "numpy", search).pairs(np.zeros((2, 3)), np.eye(3), np.ones(3, bool), 1.0)


def test_a_missing_library_is_said():
    finder = Finder("ghost", "no-such-distribution", lambda *_: None)
    assert finder.refusal(np.eye(3), np.ones(3, bool), 0.1) == "not installed"


def test_half_takes_every_pair_once():
    i, j = np.array([0, 1, 0, 0]), np.array([1, 0, 0, 0])
    shift = np.array([[0, 0, 0], [0, 0, 0], [1, -1, 0], [-1, 1, 0]])
    first, second, _ = half(i, j, np.ones(4), shift)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 1), (0, 0)]


def test_compare_counts_missing_extra_and_borderline():
    positions = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.5, 0, 0], [50.0, 0, 0]])
    truth = all_pairs(positions, np.zeros((3, 3)), np.zeros(3, bool), 1.5, reach=1.6)
    # 0-1 inside, 1-2 exactly at the cutoff, hence outside by "<"
    assert compare_pairs(np.array([0]), np.array([1]), truth, 1.5, 1e-12) == (0, 0, 0)
    assert compare_pairs(np.array([0, 1]), np.array([1, 2]), truth, 1.5, 1e-12) == (0, 0, 1)
    assert compare_pairs(np.array([], int), np.array([], int), truth, 1.5, 1e-12) == (1, 0, 0)
    assert compare_pairs(np.array([0, 0, 0]), np.array([1, 1, 3]), truth, 1.5, 1e-12) == (0, 2, 0)
