"""The pair oracle against a slower one that shares no line with it."""

from __future__ import annotations

from collections import Counter

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mdnum.errors import InputError
from mdnum.references.oracle import all_pairs, exactly_inside, rounding_bound, widths


def _count(pairs) -> Counter:
    inside = pairs.select(pairs.inside)
    return Counter(zip(inside.i.tolist(), inside.j.tolist(), strict=True))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    atoms=st.integers(1, 8),
    pbc=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    tilt=st.sampled_from([0.0, 0.4, 1.5]),
    r_cut=st.floats(0.3, 4.0),
)
def test_equals_the_explicit_images(seed, atoms, pbc, tilt, r_cut):
    rng = np.random.default_rng(seed)
    cell = np.diag(rng.uniform(1.5, 6.0, 3)) + tilt * np.tril(rng.normal(size=(3, 3)), -1)
    positions = rng.normal(scale=6.0, size=(atoms, 3))  # most of them outside the cell
    expected = oracles.image_pairs(positions, cell, pbc, r_cut)
    assert _count(all_pairs(positions, cell, np.array(pbc), r_cut)) == expected


@pytest.mark.parametrize(
    "cell", [np.diag([7.0, 8.0, 9.0]), np.array([[7.0, 0, 0], [2.5, 8, 0], [-3, 1, 9.0]])]
)
def test_large_box_needs_one_image(cell):
    rng = np.random.default_rng(3)
    positions = rng.uniform(-20, 20, (60, 3))
    r_cut = 0.49 * widths(cell).min()
    pairs = all_pairs(positions, cell, np.ones(3, bool), r_cut)
    assert _count(pairs) == oracles.image_pairs(positions, cell, (True, True, True), r_cut)
    displacement = positions[pairs.j] - positions[pairs.i] + pairs.shift @ cell
    np.testing.assert_allclose(np.linalg.norm(displacement, axis=1), pairs.distance, rtol=4e-16)


def test_a_pair_at_the_cutoff_follows_the_convention():
    positions, cell, free = np.array([[0.0, 0, 0], [2.5, 0, 0]]), np.zeros((3, 3)), np.zeros(3, bool)
    below = all_pairs(positions, cell, free, 2.5)
    assert below.exact.all() and not below.inside.any()
    assert all_pairs(positions, cell, free, 2.5, closed=True).inside.all()
    assert all_pairs(positions, cell, free, np.nextafter(2.5, 3)).inside.all()


def test_rational_decision_where_float64_is_wrong():
    """Among oriented pairs within an ulp of the cutoff, float64's d·d < r_cut² misjudges some."""
    rng = np.random.default_rng(11)
    r_cut, cell, wrong = 2.5, np.zeros((3, 3)), 0
    for _ in range(200):
        direction = rng.normal(size=3)
        positions = np.array([[0.0, 0.0, 0.0], r_cut * direction / np.linalg.norm(direction)])
        truth = oracles.exact_inside(positions, cell, 0, 1, (0, 0, 0), r_cut)
        assert exactly_inside(positions, cell, 0, 1, (0, 0, 0), r_cut) == truth
        assert all_pairs(positions, cell, np.zeros(3, bool), r_cut).inside.tolist() == [truth]
        wrong += (float(positions[1] @ positions[1]) < r_cut * r_cut) != truth
    assert wrong > 10


def test_rounding_bound_holds_for_wrapped_float64_distances():
    rng = np.random.default_rng(5)
    cell = np.array([[11.3, 0, 0], [3.1, 12.7, 0], [-2.2, 4.4, 13.9]])
    positions = rng.uniform(-40, 40, (50, 3))
    pairs = all_pairs(positions, cell, np.ones(3, bool), 4.0)
    bound = rounding_bound(positions, cell, 4.0)
    for row in range(0, len(pairs), 7):
        exact = oracles.exact_r2(positions, cell, pairs.i[row], pairs.j[row], pairs.shift[row])
        assert abs(float(exact) ** 0.5 - pairs.distance[row]) <= bound


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="no cell vector"):
        all_pairs(np.zeros((2, 3)), np.zeros((3, 3)), np.array([True, False, False]), 1.0)
    with pytest.raises(InputError, match="not finite"):
        all_pairs(np.full((2, 3), np.nan), np.eye(3), np.ones(3, bool), 1.0)
