"""Many-body potentials against extended precision (ASE: references/test_energy), and where they broke."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.neighborlist import neighbor_list
from oracles_manybody import L, embedded_atom, energy_and_forces, stillinger_weber, tersoff
from programs import module_of

import mdnum
from mdnum.errors import InputError
from mdnum.md import jaxmd, tetrahedral
from mdnum.md.embedded_atom import embedded_atom as made_eam
from mdnum.md.embedded_atom import read_setfl

COPPER = Path(__file__).parents[2] / "systems" / "copper" / "cu.eam.alloy"
# relative energy, and forces relative to the largest one; measured 4e-16 and 8e-15
TOLERANCE = 1e-12


def crystal(kind: str, repeat: int, rattle: float, seed: int = 1) -> Atoms:
    cell = {"Cu": ("fcc", 3.615), "Si": ("diamond", 5.431)}[kind]
    atoms = bulk(kind, cell[0], a=cell[1], cubic=True) * (repeat, repeat, repeat)
    atoms.rattle(rattle, seed=seed)
    return atoms


def cluster(kind: str, points) -> Atoms:
    """Five atoms in a wide box, those not given far away: all clusters of a potential share a program."""
    far = [[15, 15, 15], [15, 22, 15], [22, 15, 15]][: 5 - len(points)]
    return Atoms(f"{kind}5", positions=[*points, *far], cell=np.eye(3) * 30, pbc=True)


def dense(atoms: Atoms, r_list: float, width: int = 16) -> np.ndarray:
    """A list from ASE's finder, padded to a multiple of width: lists that are alike share a program."""
    i, j = neighbor_list("ij", atoms, r_list)
    slots = np.bincount(i, minlength=len(atoms)).max()
    rows = np.full((len(atoms), -(-slots // width) * width), len(atoms), np.int32)
    for atom in range(len(atoms)):
        mine = np.sort(j[i == atom])
        rows[atom, : len(mine)] = mine
    return rows


def evaluate(potential, atoms: Atoms):
    return evaluate_over(potential, atoms.positions, dense(atoms, potential.r_cut + 0.5), atoms.cell.array)


def evaluate_over(potential, positions: np.ndarray, idx: np.ndarray, cell: np.ndarray):
    energy, forces, stress = _evaluate(potential, *map(jnp.asarray, (positions, idx, cell)))
    return float(energy), np.asarray(forces), np.asarray(stress)


@eqx.filter_jit
def _evaluate(potential, positions, idx, cell):
    return potential.evaluate(positions, jaxmd.as_neighbor_list(idx, positions, potential.format), cell)


TERSOFF, STILLINGER_WEBER = (partial(tetrahedral.named, kind) for kind in ("tersoff", "stillinger-weber"))
CASES = {
    "eam": (lambda: made_eam(COPPER), lambda a: embedded_atom(a, COPPER), "Cu", 4, 0.05),
    "tersoff": (TERSOFF, tersoff, "Si", 3, 0.05),
    # bonds inside the taper and beyond it
    "tersoff, hot": (TERSOFF, tersoff, "Si", 3, 0.15),
    "stillinger-weber": (STILLINGER_WEBER, stillinger_weber, "Si", 3, 0.05),
    "stillinger-weber, hot": (STILLINGER_WEBER, stillinger_weber, "Si", 3, 0.15),
}


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=getattr(pytest.mark, "nightly" if "hot" in case else "slow"))
        if "hot" in case or case == "eam"
        else case
        for case in CASES
    ],
)
def test_energy_forces_and_stress_agree_with_extended_precision(case):
    make, oracle, kind, repeat, rattle = CASES[case]
    atoms, potential = crystal(kind, repeat, rattle), make()
    energy, forces, stress = evaluate(potential, atoms)
    scale = np.abs(forces).max()
    some = [0, 7, len(atoms) - 1]
    exact, exact_forces = energy_and_forces(oracle(atoms), atoms.positions, some)
    assert abs(energy - exact) <= TOLERANCE * abs(exact)
    assert np.abs(forces[some] - exact_forces).max() <= TOLERANCE * scale
    assert np.abs(forces.sum(axis=0)).max() <= 1e-12 * scale * len(atoms)
    np.testing.assert_allclose(stress, strained(oracle, atoms), rtol=0, atol=1e-9)


def strained(oracle, atoms: Atoms) -> np.ndarray:
    """Stress of an oracle's energy by central differences in extended precision."""
    step, stress = L("1e-5"), np.zeros((3, 3))
    for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        ends = []
        for sign in (1, -1):
            deform = np.eye(3, dtype=L)
            deform[a, b] += sign * step / 2
            deform[b, a] += sign * step / 2
            bent = atoms.copy()
            bent.set_cell((atoms.cell.array @ deform).astype(float), scale_atoms=True)
            ends.append(oracle(bent)(bent.positions.astype(L)))
        stress[a, b] = stress[b, a] = float((ends[0] - ends[1]) / (2 * step)) / atoms.get_volume()
    return stress


@pytest.mark.parametrize("case", ["eam", "tersoff", "stillinger-weber"])
def test_skin_masked_entries_images_and_folding_do_not_matter(case):
    make, _, kind, repeat, _ = CASES[case]
    atoms, potential = crystal(kind, repeat, 0.12), make()
    energy, forces, _ = evaluate(potential, atoms)
    listed = dense(atoms, potential.r_cut + 0.5)
    far = atoms.get_all_distances(mic=True)
    n = len(atoms)
    reach = np.where(listed < n, far[np.arange(n)[:, None], np.minimum(listed, n - 1)], np.inf)
    masked = np.where(reach < potential.r_cut, listed, n).astype(np.int32)
    assert (masked == n).sum() > (listed == n).sum()
    moved = atoms.positions + np.random.default_rng(3).integers(-2, 3, (n, 3)) @ atoms.cell.array
    for idx, positions in ((masked, atoms.positions), (listed, moved)):
        other, other_forces, _ = evaluate_over(potential, positions, idx, atoms.cell.array)
        assert abs(other - energy) <= 1e-13 * abs(energy)
        np.testing.assert_allclose(other_forces, forces, rtol=0, atol=1e-11)


@pytest.mark.nightly
def test_triclinic_and_slab_agree_with_extended_precision():
    tilted = crystal("Si", 2, 0.1)
    tilted.set_cell(
        tilted.cell.array @ np.array([[1, 0, 0], [0.2, 1, 0], [-0.1, 0.15, 1]]), scale_atoms=False
    )
    slab = crystal("Si", 2, 0.1)
    # a tilted vector along the free axis must not choose images in the plane
    slab.set_cell(slab.cell.array + np.array([[0, 0, 0], [0, 0, 0], [9.0, 4.0, 0]]), scale_atoms=False)
    slab.pbc = (True, True, False)
    free = crystal("Si", 2, 0.1)
    free.set_cell(np.zeros((3, 3)))
    free.pbc = False
    for atoms in (tilted, slab, free):
        pbc = tuple(bool(flag) for flag in atoms.pbc)
        for make, oracle in (
            (TERSOFF, tersoff),
            (STILLINGER_WEBER, stillinger_weber),
        ):
            potential = make(pbc=pbc)
            idx = jaxmd.dense_pairs(atoms.positions, atoms.cell.array, pbc, potential.r_cut + 0.3)
            expected = dense(atoms, potential.r_cut + 0.3, 1)
            np.testing.assert_array_equal(np.sort(idx, axis=1)[:, : expected.shape[1]], expected)
            energy, forces, _ = evaluate_over(potential, atoms.positions, idx, atoms.cell.array)
            exact, exact_forces = energy_and_forces(oracle(atoms), atoms.positions, [0, 50])
            assert abs(energy - exact) <= TOLERANCE * abs(exact)
            assert np.abs(forces[[0, 50]] - exact_forces).max() <= TOLERANCE * np.abs(forces).max()


def test_tersoff_dimer_has_a_force_and_no_third_neighbor():
    # zeta = 0: jax-md's slope of the bond order is infinite there
    atoms = cluster("Si", [[0, 0, 0], [2.4, 0, 0]])
    for r in (2.4, 2.8, 2.999):
        atoms.positions[1, 0] = r
        energy, forces, _ = evaluate(tetrahedral.named("tersoff"), atoms)
        exact, exact_forces = energy_and_forces(tersoff(atoms), atoms.positions, [0, 1])
        assert abs(energy - exact) <= 1e-14
        np.testing.assert_allclose(forces[:2], exact_forces.astype(float), rtol=0, atol=1e-13)


@pytest.mark.parametrize("case", ["eam", "tersoff", "stillinger-weber"])
def test_smoothness_is_what_a_crossing_shows(case):
    potential = CASES[case][0]()
    element = CASES[case][2]

    def at(r):
        # a third atom, bonded to both, gives the crossing pair something to bend
        atoms = cluster(element, [[0, 0, 0], [r, 0, 0], [potential.r_cut / 2, 2.0, 0.3]])
        energy, forces, _ = evaluate(potential, atoms)
        return energy, forces

    def jumps(step):
        inner, outer = at(potential.r_cut - step), at(potential.r_cut + step)
        return abs(inner[0] - outer[0]), np.abs(inner[1] - outer[1]).max()

    (energy, force), (_, coarse) = jumps(1e-7), jumps(1e-5)
    assert energy <= potential.smoothness.energy_jump + 1e-6
    if case == "tersoff":
        # continuous with an infinite slope: the crossing atom is the only third neighbor of two bonds
        assert coarse / force == pytest.approx(100 ** (2 * potential.n - 1), rel=0.02)
    else:
        assert force <= potential.smoothness.force_jump + 1e-5
    assert potential.smoothness.order >= 1
    assert potential.smoothness.energy_jump <= 1e-10 and potential.smoothness.force_jump <= 1e-6
    assert (potential.smoothness.order == math.inf) == (case == "stillinger-weber")


def test_a_density_off_the_table_is_never_silent():
    squeezed = np.random.default_rng(0).uniform(0, 0.4, (5, 3))
    energy, forces, _ = evaluate(made_eam(COPPER), cluster("Cu", squeezed))
    assert math.isnan(energy) and np.isnan(forces).all(axis=1).any()


def test_the_table_is_the_published_form():
    form = module_of("scripts/makers/make_eam_table.py")
    found = form.properties(form.pair, form.density, form.embedding)
    digits = {"a (Å)": 5e-4, "E (eV/atom)": 5e-3, "C11 (GPa)": 0.05, "C12 (GPa)": 0.05, "C44 (GPa)": 0.05}
    for name, published in form.PAPER.items():
        assert abs(found[name] - published) <= digits[name], name
    table = read_setfl(COPPER)
    r = table.dr * np.arange(len(table.density))
    np.testing.assert_allclose(table.density, form.density(r), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(table.r_pair, r * form.pair(r), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(
        table.embedding, form.embedding(table.drho * np.arange(len(table.embedding))), rtol=1e-13, atol=1e-13
    )
    # what the spline loses against the form between its points
    potential = made_eam(COPPER)
    between = np.linspace(1.9, 5.4, 5_000)
    phi, charge = jax.jit(lambda r: (potential.phi(r), potential.charge(r)))(between)
    assert np.abs(np.asarray(phi) - form.pair(between)).max() < 1e-6
    assert np.abs(np.asarray(charge) - form.density(between)).max() < 1e-8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace("1 Cu\n", "2 Cu Al\n"), "contains 2 elements"),
        (lambda t: t.rsplit("\n", 2)[0], "3002 numbers"),
        (lambda t: t.replace("5.50679\n29", "6.5\n29"), "its cutoff 6.5"),
        (lambda t: "nothing\nof\nthe kind\n", "not a setfl table"),
        (lambda t: t.replace("29 63.546 3.615 fcc\n", "29 63.546 3.615 fcc\nnan "), "expected 3003"),
    ],
)
def test_a_broken_table_is_refused_in_one_line(tmp_path, change, message):
    path = tmp_path / "broken.alloy"
    path.write_text(change(COPPER.read_text()))
    with pytest.raises(InputError) as caught:
        made_eam(path)
    text = str(caught.value)
    assert str(path) in text and "\n" not in text and message in text


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: made_eam(COPPER, ["Cu", "Al"]), "is for Cu, .*contains Al"),
        (lambda: made_eam(COPPER.with_name("none.alloy")), "potential table not found"),
        (lambda: tetrahedral.named("tersoff", "Ge"), "available sets are Si and Si-1989"),
        (lambda: tetrahedral.named("stillinger-weber", "Ge"), "available set is Si"),
    ],
)
def test_another_element_and_a_missing_table_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_the_1989_constants_differ_from_those_of_1988():
    atoms = crystal("Si", 3, 0.0)
    newer, older = tetrahedral.named("tersoff", "Si-1989"), tetrahedral.named("tersoff", "Si")
    per_atom = [evaluate(p, atoms)[0] / len(atoms) for p in (newer, older)]
    # cohesive energy of diamond silicon in both papers: 4.63 eV
    np.testing.assert_allclose(per_atom, -4.63, atol=5e-3)
    assert newer.lambda3 == 0.0 and older.lambda3 > 0 and newer.sources != older.sources


@pytest.mark.jax_md
@pytest.mark.parametrize(
    "format",
    [*(pytest.param(one, marks=pytest.mark.nightly) for one in ("dense", "sparse")), "ordered-sparse"],
)
def test_any_jax_md_energy_function_runs_in_every_format(format):
    from ase.calculators.lj import LennardJones
    from jax_md import energy as jax_md_energy

    bent = 3 * 5.26 * np.array([[1, 0, 0], [0.1, 1, 0], [0.05, -0.1, 1]])
    atoms = bulk("Ar", "fcc", a=5.26, cubic=True) * (3, 3, 3)
    atoms.rattle(0.2, seed=5)
    atoms.set_cell(bent, scale_atoms=True)
    given = {"sigma": 3.405, "epsilon": 0.0103, "r_onset": 5.0 / 3.405, "r_cutoff": 6.5 / 3.405}
    _, energy_fn = jax_md_energy.lennard_jones_neighbor_list(
        jaxmd.displacement(jnp.asarray(bent)), 1.0, neighbor_list_fn=lambda *_, **__: None,
        **{name: jaxmd.scalar(value) for name, value in given.items()},
    )  # fmt: skip
    function = mdnum.energy_function(energy_fn, 6.5, format=format)
    simulation = mdnum.simulation(atoms, function, timestep=0.002, skin=0.3)
    potential = simulation.model
    assert potential.call.how.box == "cell" and potential.smoothness.order == 1 and not potential.notes
    energy, forces, stress = evaluate(potential, atoms)
    atoms.calc = LennardJones(sigma=3.405, epsilon=0.0103, rc=6.5, ro=5.0, smooth=True)
    assert abs(energy - atoms.get_potential_energy()) <= 1e-13 * abs(energy)
    np.testing.assert_allclose(forces, atoms.get_forces(), rtol=0, atol=1e-13)
    np.testing.assert_allclose(stress, atoms.get_stress(voigt=False), rtol=0, atol=1e-15)


def test_setfl_keeps_every_digit(tmp_path):
    table = read_setfl(COPPER)
    assert table.element == "Cu" and table.r_cut == 5.50679 and "Mishin" in table.comment[0]
    assert set(asdict(table)) >= {"embedding", "density", "r_pair"}
    words = COPPER.read_text().split("\n", 6)[6].split()
    np.testing.assert_array_equal(table.embedding, [float(word) for word in words[:1001]])
    # five numbers a line, as LAMMPS writes them, and no newline at the end
    head = COPPER.read_text().split("\n", 6)[:6]
    folded = [" ".join(words[k : k + 5]) for k in range(0, len(words), 5)]
    (tmp_path / "folded.alloy").write_text("\n".join(head + folded))
    np.testing.assert_array_equal(read_setfl(tmp_path / "folded.alloy").r_pair, table.r_pair)
