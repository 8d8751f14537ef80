"""The box: wrapping and minimum image, against a search over images and rational arithmetic."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase.geometry import complete_cell
from hypothesis import assume, given
from hypothesis import strategies as st

from mdnum.errors import InputError
from mdnum.md.cell import Cell, displacement, strain_loss, wrap_positions

FLAGS = st.tuples(st.booleans(), st.booleans(), st.booleans())
UNIT = st.floats(-1.0, 1.0)


@st.composite
def matrices(draw, tilt=0.9):
    """Lattice vectors as rows: bricks and skewed boxes, turned in space."""
    edges = np.array([draw(st.floats(1.0, 60.0)) for _ in range(3)])
    matrix = np.diag(edges)
    if draw(st.booleans()):
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = (tilt * draw(UNIT) * edges[k] for k in (0, 0, 1))
        if draw(st.booleans()):
            q, _ = np.linalg.qr(np.array([[draw(UNIT) for _ in range(3)] for _ in range(3)]) + 2 * np.eye(3))
            matrix = matrix @ q
    return matrix


def nearest_image(vector, matrix, pbc, reach=4):
    """Shortest of all images within reach lattice vectors: no rounding of fractional coordinates."""
    spans = [range(-reach, reach + 1) if p else (0,) for p in pbc]
    shifts = np.array(list(product(*spans)), float) @ matrix
    images = vector - shifts
    return images[np.argmin(np.einsum("ij,ij->i", images, images))]


def components(array):
    return tuple(np.ascontiguousarray(c) for c in np.asarray(array, float).T)


@given(matrix=matrices(), pbc=FLAGS, data=st.data())
def test_the_minimum_image_is_the_nearest_of_all_images(matrix, pbc, data):
    cell = Cell.create(matrix, pbc)
    half = float(np.min(cell.widths)) / 2
    reach = min(half, 50.0)
    direction = np.array([data.draw(UNIT) for _ in range(3)])
    assume(np.linalg.norm(direction) > 1e-3)
    near = direction / np.linalg.norm(direction) * reach * data.draw(st.floats(0, 0.999))
    shift = [data.draw(st.integers(-3, 3)) if p else 0 for p in pbc]
    found = np.array([c[0] for c in cell.minimum_image(*components([near + shift @ matrix]))])
    scale = np.abs(matrix).sum() * 4
    assert np.allclose(found, near, rtol=0, atol=1e-14 * scale)
    searched = nearest_image(near, matrix, pbc)
    assert np.linalg.norm(found) <= np.linalg.norm(searched) + 1e-14 * scale


def _box(matrix, pbc):
    """The lattice, with free axes perpendicular to the periodic ones whatever their rows say."""
    return complete_cell(np.where(np.array(pbc)[:, None], matrix, 0.0))


@given(matrix=matrices(), pbc=FLAGS, data=st.data())
def test_wrapping_takes_off_whole_lattice_vectors_and_ends_in_the_box(matrix, pbc, data):
    cell = Cell.create(matrix, pbc)
    places = st.one_of(
        st.floats(-1e7, 1e7), st.floats(-2, 2), st.sampled_from([0.0, 1.0, -1.0, -1e-17, 1 - 2**-53, 3.0])
    )
    fractional = np.array([[data.draw(places) for _ in range(3)] for _ in range(4)])
    positions = fractional @ matrix
    wrapped, images = wrap_positions(cell, positions)
    scale = np.abs(positions).max(initial=0) + np.abs(matrix).sum()
    assert np.allclose(wrapped + images @ matrix, positions, rtol=0, atol=1e-14 * scale)
    # the row of a free axis says nothing about where the box is
    box = _box(matrix, pbc)
    inside = wrapped @ np.linalg.inv(box)
    # a free axis may have left a coordinate large
    scale_left = np.abs(wrapped).max() + np.abs(matrix).sum()
    for axis in range(3):
        if pbc[axis]:
            # a coordinate may equal L after L was added to a tiny negative number
            edge = 1e-14 * scale_left * np.linalg.norm(np.linalg.inv(box))
            assert np.all(inside[:, axis] >= -edge) and np.all(inside[:, axis] <= 1 + edge)
        else:
            assert np.all(images[:, axis] == 0)
    if not any(pbc):
        assert np.array_equal(wrapped, positions)


def test_faces_of_the_box():
    cell = Cell.create([10.0, 10.0, 10.0])
    positions = np.array(
        [[0.0, 10.0, -1e-30], [20.0, -10.0, np.nextafter(10.0, 0)], [5e6 * 10 + 1.0, 9.5, -0.0]]
    )
    wrapped, images = wrap_positions(cell, positions)
    assert wrapped.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.0, np.nextafter(10.0, 0)], [1.0, 9.5, 0.0]]
    assert images.tolist() == [[0, 1, 0], [2, -1, 0], [5_000_000, 0, 0]]


@given(matrix=matrices(), pbc=FLAGS, seed=st.integers(0, 10**6))
def test_positions_in_the_box_stay_where_they_are(matrix, pbc, seed):
    cell = Cell.create(matrix, pbc)
    inside = np.random.default_rng(seed).uniform(0.01, 0.99, (5, 3)) @ _box(matrix, pbc)
    wrapped, images = wrap_positions(cell, inside)
    assert np.array_equal(wrapped, inside)
    assert not images.any()


@pytest.mark.parametrize("pbc", [(True, True, True), (True, False, True), (False, False, True)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(
    "matrix", [np.diag([9.3, 11.1, 13.7]), [[9.3, 0, 0], [2.1, 11.1, 0], [-3.3, 1.9, 13.7]]]
)
def test_jit_and_the_host_have_the_same_bits(matrix, pbc, dtype):
    matrix = np.asarray(matrix, dtype).astype(float)
    cell = Cell.create(matrix, pbc)
    rng = np.random.default_rng(3)
    wrapped, _ = wrap_positions(cell, rng.uniform(-20, 40, (4000, 3)))
    wrapped = wrapped.astype(dtype)
    start, end = wrapped[:2000], wrapped[2000:]
    host = np.stack(displacement(cell, start, end, dtype))

    @jax.jit
    def in_jit(cell, start, end):
        return jnp.stack(cell.minimum_image(*(e - s for s, e in zip(start, end, strict=True))))

    device = np.asarray(
        in_jit(cell.astype(dtype), tuple(map(jnp.asarray, start.T)), tuple(map(jnp.asarray, end.T)))
    )
    near = np.linalg.norm(host.astype(float), axis=0) < np.min(cell.widths) / 2 * 0.999
    assert near.sum() > 40
    assert device.dtype == host.dtype == dtype
    assert np.array_equal(device[:, near], host[:, near])


@given(matrix=matrices(), pbc=FLAGS)
def test_widths_are_distances_between_opposite_faces(matrix, pbc):
    cell = Cell.create(matrix, pbc)
    box = _box(matrix, pbc)
    for k in range(3):
        area = np.linalg.norm(np.cross(box[k - 2], box[k - 1]))
        width = abs(np.linalg.det(box)) / area
        assert cell.widths[k] == (pytest.approx(width, rel=1e-9) if pbc[k] else np.inf)
    assert cell.volume == pytest.approx(abs(np.linalg.det(matrix)), rel=1e-12)


def test_a_free_axis_needs_no_lattice_vector():
    slab = Cell.create([[8.0, 0, 0], [0, 9.0, 0], [0, 0, 0]], (True, True, False))
    wrapped, images = wrap_positions(slab, np.array([[8.5, -1.0, 1e6], [7.0, 3.0, -1e6]]))
    assert wrapped.tolist() == [[0.5, 8.0, 1e6], [7.0, 3.0, -1e6]]
    assert images.tolist() == [[1, -1, 0], [0, 0, 0]]
    assert np.isnan(slab.volume)
    cluster = Cell.create(np.zeros((3, 3)), False)
    d = cluster.minimum_image(*components([[1e5, -3.0, 2.0]]))
    assert [float(c[0]) for c in d] == [1e5, -3.0, 2.0]


@pytest.mark.parametrize(
    "matrix, pbc, words",
    [
        (np.zeros((3, 3)), True, "axis a of .* periodic"),
        (np.diag([5.0, 0.0, 5.0]), True, "axis b of .* periodic"),
        ([[1, 0, 0], [2, 0, 0], [0, 0, 1]], True, "span no volume"),
        (np.diag([5.0, np.nan, 5.0]), True, "not finite"),
    ],
)
def test_a_box_that_is_none_is_refused(matrix, pbc, words):
    with pytest.raises(InputError, match=words):
        Cell.create(matrix, pbc)


@given(matrix=matrices(tilt=0.5), data=st.data())
def test_no_pair_beyond_the_list_comes_closer_by_strain_than_the_loss_says(matrix, data):
    deform = np.eye(3) + np.array([[0.15 * data.draw(UNIT) for _ in range(3)] for _ in range(3)])
    before, after = Cell.create(matrix), Cell.create(matrix @ deform)
    r_list = 3.0
    loss = strain_loss(before, after, r_list)
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(500, 3))
    vectors = r_list * directions / np.linalg.norm(directions, axis=1)[:, None]
    shortest = np.linalg.norm(vectors @ deform, axis=1).min()
    assert shortest >= r_list - loss - 1e-9
    # and it is what the worst direction needs, but for what a change of shape and a rotation add
    worst, part = np.linalg.svd(deform, compute_uv=False)[-1], 0.5 * (deform + deform.T) - np.eye(3)
    shape = np.linalg.norm(part - np.trace(part) / 3 * np.eye(3))
    turned = np.linalg.norm(deform - deform.T) / 2
    assert r_list * (1 - worst) - 1e-9 <= loss <= r_list * max(0, 1 - worst + 0.42 * shape + turned**2) + 1e-9
    alike = Cell.create(0.97 * np.asarray(before.matrix))
    assert strain_loss(before, alike, r_list) == pytest.approx(0.03 * r_list, rel=1e-12)


def test_lattice_vectors_are_taken_off_without_rounding_when_one_is_enough():
    cell = Cell.create([10.1, 10.1, 10.1])
    a, b = np.array([[0.3, 0.2, 0.1]]), np.array([[9.9, 0.7, 5.3]])
    found = displacement(cell, a, b)
    difference = b[0, 0] - a[0, 0]
    assert Fraction(float(found[0][0])) == Fraction(difference) - Fraction(10.1)
