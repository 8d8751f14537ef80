"""jax-md's defects, each asserted to be still there, beside the work-around that mdnum has for it.

A test here turns red the day upstream mends the defect; its message says what may then be dropped. What
mdnum does about each is asserted in the same test, so that a work-around cannot be lost either.
"""

from __future__ import annotations

import io
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.neighborlist import neighbor_list

from mdnum.errors import InputError, NumericalError
from mdnum.md import jaxmd, tetrahedral

pytestmark = pytest.mark.jax_md
ALWAYS = (True, True, True)


@pytest.fixture(scope="module")
def md():
    return jaxmd.upstream()


def mended(defect: str, drop: str) -> str:
    return f"jax-md no longer {defect}; {drop}"


def nothing(*_, **__):
    """In place of a list builder, where only the energy function is wanted."""


def list_of(md, side: float, r_list: float, **options):
    """jax-md's own list functions for a cube."""
    displacement, _ = md.space.periodic(jaxmd.scalar(side), wrapped=False)
    return md.partition.neighbor_list(displacement, jaxmd.scalar(side), jaxmd.scalar(r_list), **options)


def random_points(atoms: int, cell: np.ndarray, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((atoms, 3)) @ cell


def ase_rows(positions, cell, pbc, r_list) -> list[set[int]]:
    atoms = Atoms(f"H{len(positions)}", positions=positions, cell=cell, pbc=pbc)
    i, j = neighbor_list("ij", atoms, r_list)
    return [set(j[i == atom]) for atom in range(len(positions))]


def rows_of(idx: np.ndarray) -> list[set[int]]:
    return [set(row[row < len(idx)]) for row in idx]


def silicon(rattle: float) -> Atoms:
    atoms = bulk("Si", "diamond", a=5.431, cubic=True) * (2, 2, 2)
    atoms.rattle(rattle, seed=3)
    return atoms


def dense_list(atoms: Atoms, r_list: float):
    idx = jaxmd.dense_pairs(atoms.positions, atoms.cell.array, ALWAYS, r_list)
    padded = np.pad(idx, ((0, 0), (0, 2)), constant_values=len(atoms))
    return jaxmd.as_neighbor_list(padded, atoms.positions)


TERSOFF = {
    "mTf": 3.0, "gamma": 1.0, "lam3": 1.7322, "cTf": 1.0039e5, "dTf": 16.218, "hTf": -0.59826, "nTf": 0.78734,
    "beta": 1.0999e-6, "lam2": 1.7322, "B": 471.18, "R": 2.85, "D": 0.15, "lam1": 2.4799, "A": 1830.8,
}  # fmt: skip


@pytest.mark.parametrize("value", [3.405, np.float64(3.405), np.array(3.405)])
def test_constants_are_rounded_to_float32_under_x64(md, value):
    rounded = md.util.maybe_downcast(value)
    assert rounded.dtype == jnp.float32, mended(
        "rounds constants to float32 (util.maybe_downcast)", "mdnum.md.jaxmd.scalar may go"
    )
    kept = md.util.maybe_downcast(jaxmd.scalar(value))
    assert kept.dtype == jnp.float64 and float(kept) == 3.405


@pytest.mark.nightly
def test_malformed_box_is_inverted(md):
    good = jnp.asarray([[9.0, 1.0, 0.5], [0, 9.0, 1.0], [0, 0, 9.0]])
    flags = {}
    for name, box in {"good": good, "bad": good.T}.items():
        displacement, _ = md.space.periodic_general(box)
        functions = md.partition.neighbor_list(
            displacement, box, jaxmd.scalar(2.0), jaxmd.scalar(0.0), fractional_coordinates=True
        )
        flags[name] = bool(functions.allocate(jnp.asarray(random_points(60, np.eye(3)))).malformed_box)
    assert flags == {"good": True, "bad": False}, mended(
        "inverts malformed_box", "PairSearch may hand it boxes instead of widths"
    )
    # mdnum looks at its own cells
    with pytest.raises(InputError, match="span no volume"):
        jaxmd.dense_pairs(np.zeros((3, 3)), np.ones((3, 3)), ALWAYS, 1.0)


@pytest.mark.nightly
def test_cell_list_drops_pairs_outside_the_box(md):
    side, r_list = 12.0, 2.5
    inside = random_points(400, np.eye(3) * side)
    outside = inside + side * np.random.default_rng(1).integers(-2, 3, inside.shape)
    functions = list_of(md, side, r_list)

    def count(points):
        found = functions.allocate(jnp.asarray(points))
        assert int(found.error.code) == 0
        return int((found.idx < 400).sum())

    assert count(outside) < count(inside), mended(
        "drops pairs of unwrapped positions", "PairSearch need not fold positions"
    )
    expected = ase_rows(inside, np.eye(3) * side, ALWAYS, r_list)
    search = jaxmd.PairSearch(np.eye(3) * side, ALWAYS, r_list)
    for points in (inside, outside, inside - 1e-17):
        assert rows_of(search(points)) == expected


@pytest.mark.nightly
def test_a_shrinking_box_triggers_no_rebuild(md):
    displacement, _ = md.space.periodic_general(jaxmd.scalar(12.0))
    functions = md.partition.neighbor_list(
        displacement, jaxmd.scalar(12.0), jaxmd.scalar(2.0), jaxmd.scalar(0.4),
        fractional_coordinates=True, capacity_multiplier=4.0,
    )  # fmt: skip
    points = jnp.asarray(random_points(300, np.eye(3)))
    before = functions.allocate(points)
    smaller = jaxmd.scalar(9.0)
    after = before.update(points, box=smaller)
    fresh = functions.allocate(points, box=smaller)
    listed, there = (int((found.idx < 300).sum()) for found in (after, fresh))
    assert listed < there, mended(
        "keeps a list while its box shrinks", "the strain criterion of the rebuild rule may go"
    )
    # mdnum's lists cannot update themselves: a new cell is a new search
    own = dense_list(silicon(0.0), 3.0)
    with pytest.raises(InputError, match="does not work"):
        own.update(own.reference_position)


def test_a_cutoff_over_half_the_box_has_no_flag(md):
    side, r_list = 4.0, 2.6
    points = random_points(8, np.eye(3) * side)
    found = list_of(md, side, r_list).allocate(jnp.asarray(points))
    atoms = Atoms("H8", positions=points, cell=np.eye(3) * side, pbc=True)
    assert int((found.idx < 8).sum()) < len(neighbor_list("i", atoms, r_list)), mended(
        "misses further images", "the refusal in PairSearch may be relaxed"
    )
    assert int(found.error.code) == 0
    with pytest.raises(InputError, match=r"is 2\.6; .* at most 2, .*\(4\)"):
        jaxmd.PairSearch(np.eye(3) * side, ALWAYS, r_list)
    tilted = np.array([[6.0, 0, 0], [5.0, 6.0, 0], [0, 0, 6.0]])
    with pytest.raises(InputError, match=r"the cell \(4\.60"):
        jaxmd.PairSearch(tilted, ALWAYS, 2.5)


def test_the_cutoff_has_no_derivative(md):
    points = jnp.asarray([[0.0, 0, 0], [2.4, 0, 0]])
    neighbor = jaxmd.as_neighbor_list(np.array([[1], [0]]), np.asarray(points))

    def energy(r_cut):
        _, fn = md.energy.lennard_jones_neighbor_list(
            jaxmd.displacement(np.eye(3) * 20), 1.0, sigma=jaxmd.scalar(1.0), epsilon=jaxmd.scalar(1.0),
            r_onset=jaxmd.scalar(2.4999), r_cutoff=r_cut, neighbor_list_fn=nothing,
        )  # fmt: skip
        return fn(points, neighbor)

    # the energy jumps from 0 to u(r) as r_cut passes the pair, and no derivative says so
    value, slope = jax.jit(jax.value_and_grad(energy))(jaxmd.scalar(2.5))
    assert float(value) < -0.01
    assert float(slope) == 0.0, mended(
        "gives 0 for the derivative with respect to r_cut", "the event term may double count"
    )


@pytest.mark.nightly
def test_tersoff_forces_are_nan_beside_padding(md):
    atoms = silicon(0.15)
    neighbor = dense_list(atoms, 3.0)
    _, energy_fn = md.energy.tersoff_neighbor_list(
        jaxmd.displacement(atoms.cell.array), 1.0, [TERSOFF], neighbor_list_fn=nothing
    )
    positions = jnp.asarray(atoms.positions)
    assert np.isfinite(float(energy_fn(positions, neighbor)))
    gradient = np.asarray(jax.grad(energy_fn)(positions, neighbor))
    assert np.isnan(gradient).any(), mended(
        "masks the bond order after its power (NaN forces)",
        "mdnum.md.tetrahedral may wrap jax-md's energy function, if its cosines are mended too",
    )
    cell = jnp.asarray(atoms.cell.array)
    assert np.isfinite(np.asarray(tetrahedral.named("tersoff").forces(positions, neighbor, cell))).all()


def test_eam_loader_wants_a_word_and_no_newline_and_rounds_to_float32(md):
    n = 12
    numbers = [f"{0.1 + k / 7:.17g}" for k in range(3 * n)]
    table = ["Cu", "", "", "1 Cu", f"{n} 0.1 {n} 0.3 3.3", "29 63.546 3.615 fcc", *numbers]
    with pytest.raises(ValueError, match="setfl"):
        md.energy.load_lammps_eam_parameters(io.StringIO("\n".join(table)))
    table[0] = "Cu setfl"
    charge, embedding, _, _ = md.energy.load_lammps_eam_parameters(io.StringIO("\n".join([*table, ""])))
    value = float(embedding(jnp.asarray(0.5)))
    assert value != float(numbers[5]) and value == pytest.approx(float(numbers[5]), rel=1e-6), mended(
        "rounds EAM tables to float32", "embedded_atom.read_setfl may go"
    )
    assert float(charge(jnp.asarray(100.0))) == 0.0, mended(
        "returns 0 off its splines", "the NaN of EmbeddedAtom.embed may be reconsidered"
    )
    # the last number is dropped where no newline ends the file
    with pytest.raises(Exception):  # noqa: B017  (whatever comes of a table that is one short)
        md.energy.load_lammps_eam_parameters(io.StringIO("\n".join(table)))


@pytest.mark.nightly
def test_eam_counts_the_density_of_the_atom_itself(md):
    side = 6.0
    points = jnp.asarray(random_points(10, np.eye(3) * side, seed=4))
    displacement, _ = md.space.periodic(jaxmd.scalar(side))

    def charge(r):
        return jnp.exp(-r)

    neighbor_fn, energy_fn = md.energy.eam_neighbor_list(
        displacement, jaxmd.scalar(side), charge, lambda rho: rho, lambda r: 0 * r, jaxmd.scalar(2.9),
        dr_threshold=jaxmd.scalar(0.0), format=md.partition.Dense,
    )  # fmt: skip
    theirs = float(energy_fn(points, neighbor_fn.allocate(points)))
    idx = jaxmd.dense_pairs(np.asarray(points), np.eye(3) * side, ALWAYS, 2.9)
    ours = float(energy_fn(points, jaxmd.as_neighbor_list(idx, np.asarray(points))))
    # exp(0) = 1 for each of ten atoms
    assert theirs - ours == pytest.approx(10.0, abs=1e-12), mended(
        "counts the density at r = 0", "as_neighbor_list and EmbeddedAtom.charge need not exclude the atom"
    )
    # a list that names the atom itself is cleaned on the way in
    with_self = np.concatenate([idx, np.arange(10, dtype=np.int32)[:, None]], axis=1)
    assert float(energy_fn(points, jaxmd.as_neighbor_list(with_self, np.asarray(points)))) == ours


def test_cosines_are_bent_by_a_length_of_1e_minus_7(md):
    a, b = jnp.asarray([2.35, 0.0, 0.0]), jnp.asarray([0.0, 0.0, 2.35]) + jnp.asarray([2.35, 0.0, 0.0])
    cosine = float(md.quantity.cosine_angle_between_two_vectors(a, b))
    offset = np.sqrt(0.5) - cosine
    assert offset == pytest.approx(np.sqrt(0.5) * (1e-7 / 2.35 + 1e-7 / (2.35 * np.sqrt(2))), rel=1e-3), (
        mended("adds 1e-7 to lengths in cosines", "the unit of length in tetrahedral may go")
    )
    scaled = float(md.quantity.cosine_angle_between_two_vectors(a * 2.0**24, b * 2.0**24))
    assert abs(scaled - np.sqrt(0.5)) < 1e-14


@pytest.mark.nightly
def test_jax_md_cannot_be_imported_under_strict_promotion():
    script = """
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
try:
    import jax_md
except Exception as error:
    print("refused", type(error).__name__)
    for name in [name for name in __import__("sys").modules if name.startswith("jax_md")]:
        del __import__("sys").modules[name]
from mdnum.md import jaxmd
print(jaxmd.upstream().__name__, jax.config.jax_numpy_dtype_promotion)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "refused TypePromotionError" in done.stdout, mended(
        "mixes dtypes while it is imported", "upstream() may be a plain import"
    )
    assert "jax_md strict" in done.stdout


@pytest.mark.parametrize(
    "pbc, tilt",
    [((True, False, True), 0.35), pytest.param((False, True, False), 0.0, marks=pytest.mark.nightly)],
)
def test_pair_search_equals_ase_in_any_cell(pbc, tilt):
    cell = np.array([[11.0, 0, 0], [tilt * 11, 12.0, 0], [tilt * 5, -tilt * 7, 13.0]])
    search = jaxmd.PairSearch(cell, pbc, 3.1)
    for seed in range(3):
        points = random_points(250, cell, seed)
        assert rows_of(search(points)) == ase_rows(points, cell, pbc, 3.1)
        # atoms drift out of the frame along free axes
        drifted = points + np.random.default_rng(seed).normal(0, 2.0, points.shape)
        assert rows_of(search(drifted)) == ase_rows(drifted, cell, pbc, 3.1)
    drifted[7, 1] = np.nan
    with pytest.raises(NumericalError, match="position of atom 7"):
        search(drifted)


@pytest.mark.nightly
def test_pair_search_grows_when_atoms_crowd():
    cell = np.eye(3) * 15.0
    search = jaxmd.PairSearch(cell, ALWAYS, 3.0)
    sparse = random_points(200, cell)
    crowded = sparse.copy()
    crowded[:60] = 7.0 + np.random.default_rng(5).random((60, 3))
    assert search(sparse).shape[1] < 60
    assert rows_of(search(crowded)) == ase_rows(crowded, cell, ALWAYS, 3.0)


@pytest.mark.parametrize(
    "format", ["dense", pytest.param("sparse", marks=pytest.mark.nightly), "ordered-sparse"]
)
def test_a_list_from_outside_equals_jax_mds_own(md, format):
    side = 9.0
    points = random_points(80, np.eye(3) * side)
    name = {"dense": "Dense", "sparse": "Sparse", "ordered-sparse": "OrderedSparse"}[format]
    theirs = list_of(md, side, 2.8, format=getattr(md.partition, name)).allocate(jnp.asarray(points))
    idx = jaxmd.dense_pairs(points, np.eye(3) * side, ALWAYS, 2.8)
    ours = jaxmd.as_neighbor_list(idx, points, format)
    traced = jax.jit(lambda rows: jaxmd.as_neighbor_list(rows, points, format).idx)(idx)
    for found in (ours.idx, traced):
        if format == "dense":
            assert rows_of(np.asarray(found)) == rows_of(np.asarray(theirs.idx))
        else:
            pairs = [
                {tuple(column) for column in np.asarray(a).T if column[0] < 80} for a in (found, theirs.idx)
            ]
            assert pairs[0] == pairs[1] and len(pairs[0]) > 50
    assert ours.format is theirs.format
    assert jax.tree.structure(jax.jit(lambda held: held)(ours)) == jax.tree.structure(ours)


@pytest.mark.parametrize("pbc", [ALWAYS, (True, True, False), (False, False, True), (False, False, False)])
def test_displacement_is_ases_and_follows_a_cell_given_later(pbc):
    from ase.geometry import find_mic

    cell = np.array([[9.0, 0, 0], [2.0, 8.0, 0], [-1.0, 1.5, 10.0]])
    points = random_points(40, cell, 2)
    vectors = (points[:, None] - points[None]).reshape(-1, 3)
    shortest, length = find_mic(vectors, cell, pbc)
    near = length < 3.9

    @jax.jit
    def displaced(points, other, cell):
        given_later = jaxmd.displacement(np.eye(3), pbc)
        table = jax.vmap(jax.vmap(given_later, (None, 0, None)), (0, None, None))(points, points, cell)
        toward = jaxmd.displacement(cell, pbc)
        return table, toward(points[0], other), toward(points[0], other, perturbation=2 * jnp.eye(3))

    table, same, bent = map(np.asarray, displaced(points, points[0] + 0.125, cell))
    np.testing.assert_allclose(table.reshape(-1, 3)[near], shortest[near], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(same, points[0] - (points[0] + 0.125))
    np.testing.assert_array_equal(bent, 2 * same)


def test_importing_the_adaptor_does_not_import_jax_md():
    importing = "import sys, mdnum.md.jaxmd, mdnum.md.tetrahedral, mdnum.md.embedded_atom"
    script = f"{importing}; print('jax_md' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
