"""Planted mistakes in how a structure may be written down are found by their code; what is right passes."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from audit import planted
from audit.planted import Good, but, chain, codes, crystal, subject

from mdnum.audit.checks import invariance
from mdnum.audit.checks.invariance import InvarianceCheck

WATER = Atoms("OH2", [(0, 0, 0), (0.96, 0, 0), (-0.24, 0.93, 0)], cell=[4.0] * 3, pbc=True)
LJ = lambda: LennardJones(sigma=3.4, epsilon=0.01, rc=8.5)  # noqa: E731


def found(make, atoms: Atoms | None = None) -> dict[str, str]:
    return codes(InvarianceCheck()(subject(make, atoms)))


@pytest.mark.parametrize("atoms", [crystal(), chain()], ids=["crystal", "chain"])
@pytest.mark.parametrize("make", [Good, planted.Single, planted.HalfSkin])
def test_what_is_right_passes(make, atoms: Atoms):
    result = InvarianceCheck()(subject(make, atoms))
    assert not result.findings and result.numbers["ways"] > 10 and not result.skipped
    assert result.says[0] == ["invariance_right"]


@pytest.mark.parametrize(
    ("make", "atoms"), [(LJ, bulk("Ar", "fcc", a=5.26)), (EMT, bulk("Cu"))], ids=["lj", "emt"]
)
def test_ases_own_pass(make, atoms: Atoms):
    """One atom in a cell needs images of images."""
    assert not found(make, atoms)


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (planted.OneImage, "IMAGES"),
        (planted.FaceDropped, "FACES"),
        (planted.FirstSix, "ORDER"),
        (planted.NearestImage, "EXTENSIVE"),
        (planted.ByLengths, "LATTICE"),
        (planted.Tilted, "ROTATION"),
    ],
)
def test_a_planted_mistake_is_found(make, code: str):
    check = InvarianceCheck()
    assert codes(check(subject(make))).get(code) == "error"
    assert {f"{code.lower()}-before", f"{code.lower()}-after"} <= set(check.structures)
    if make is planted.NearestImage:  # only what is wrong is named
        assert not {"TRANSLATION", "IMAGES", "FACES", "ORDER", "CELL_ULP"} & set(found(make))


@pytest.mark.parametrize(("make", "code"), [(planted.Handed, "MIRROR"), (planted.WrapsAlways, "DUMMY_CELL")])
def test_a_planted_mistake_of_clusters_is_found(make, code: str):
    assert found(make, chain()).get(code) == "error"


class Wide(Good):
    """Takes no cell in which a search for the nearest images would be wrong."""

    def answer(self, atoms):
        if atoms.pbc.any() and atoms.cell.lengths().min() < 2 * planted.R_CUT:
            raise ValueError("the cell is narrower than two cutoffs")
        return super().answer(atoms)


@pytest.mark.parametrize(
    ("make", "expected"),
    [(planted.NearestImage, {"NARROW_CELL": "warning"}), (Good, {}), (Wide, {"NARROW_CELL_REFUSED": "info"})],
)
def test_a_structure_with_room_does_not_hide_the_nearest_image(make, expected, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setattr(invariance, "all_of", lambda atoms, *_: invariance.narrow(atoms, rng))
    assert found(make, bulk("Ar", "fcc", a=3.9, cubic=True).repeat(2)) == expected


def test_a_shell_on_the_cutoff_is_shown_by_an_ulp_of_the_cell():
    """As given, a whole shell is at the cutoff to the last bit; moved a little it is not."""
    atoms = bulk("Ar", "sc", a=planted.R_CUT).repeat((2, 2, 2))
    assert set(found(planted.HardEdge, atoms)) == {"CELL_ULP"} and not found(Good, atoms)


def test_what_is_not_supported_is_left_out():
    result = InvarianceCheck()(subject(planted.OnlyRectangles))
    assert not result.findings and any("lattice" in what for what, _ in result.skipped)
    assert result.says[0] == ["invariance_right", "invariance_refused"]


@pytest.mark.parametrize(
    ("far", "code"), [(np.nan, "NOT_FINITE"), (IndexError("cell 17 of 16"), "FAILS")], ids=["nan", "raises"]
)
def test_failing_on_another_image_is_a_finding(far, code: str, tmp_path):
    def extra(self, atoms, energy, forces):
        if np.any(np.abs(atoms.positions) > 60):
            if isinstance(far, Exception):
                raise far
            return far, forces
        return energy, forces

    asked = subject(but(extra=extra))
    asked.folder = tmp_path
    assert codes(InvarianceCheck()(asked))[code] == "error"
    assert list(tmp_path.glob("failed-*.extxyz"))


def test_molecules_by_order_are_no_mistake():
    """Rigid water of ASE: molecules are groups of three, and must be whole."""
    from ase.calculators.tip3p import TIP3P, angleHOH, rOH

    half = np.radians(angleHOH) / 2
    arm = rOH * np.array([[0, 0, 0], [0, np.cos(half), np.sin(half)], [0, np.cos(half), -np.sin(half)]])
    water = Atoms("OH2", positions=arm + 1.0, cell=[3.1] * 3, pbc=True).repeat((3, 3, 3))
    told = found(lambda: TIP3P(rc=4.5), water)
    assert told == {"TOPOLOGY_BY_ORDER": "info", "WHOLE_MOLECULES": "warning"}


def test_a_topology_by_order_that_takes_any_order_is_warned_of():
    """Bonds between each third atom and the two after it, whatever they are and wherever."""

    class Bonds(Good):
        def answer(self, atoms):
            head = np.repeat(np.arange(0, len(atoms), 3), 2)
            tail = head + np.tile([1, 2], len(atoms) // 3)
            vectors = atoms.positions[tail] - atoms.positions[head]
            if atoms.pbc.any():
                inverse = np.linalg.inv(atoms.cell.array)
                vectors -= np.rint(vectors @ inverse) @ atoms.cell.array
            forces = np.zeros((len(atoms), 3))
            np.add.at(forces, head, vectors)
            np.add.at(forces, tail, -vectors)
            return 0.5 * float(np.sum(vectors**2)), forces

    told = found(Bonds, WATER.repeat(2))
    assert told["TOPOLOGY_BY_ORDER"] == "warning" and "ORDER" not in told


def test_parameters_by_order_of_appearance_are_no_molecules():
    """In an alternating crystal, a salt, and where one atom in many is of another species."""
    alternating, rare = crystal(), bulk("Ar", "fcc", a=3.9, cubic=True).repeat((2, 2, 1))
    alternating.numbers[:] = [18, 36] * 4
    rare.numbers[7] = 36
    for atoms in (alternating, bulk("NaCl", "rocksalt", a=4.4, cubic=True), rare):
        told = found(planted.ByAppearance, atoms)
        assert told["ORDER"] == "error" and "TOPOLOGY_BY_ORDER" not in told


def test_every_way_is_the_same_structure():
    """The transformations are right by themselves: all distances stay, found by ASE's own search."""
    from ase.neighborlist import neighbor_list

    rng = np.random.default_rng(5)
    atoms = crystal()
    atoms.positions += rng.uniform(-0.05, 0.05, (len(atoms), 3))
    for same in invariance.all_of(atoms, atoms, rng):
        base = atoms if same.before is None else same.before
        before, after = (np.sort(neighbor_list("d", one, 4.3)) for one in (base, same.atoms))
        expected = np.sort(np.tile(before, same.copies))
        np.testing.assert_allclose(after, expected, rtol=0, atol=1e-12, err_msg=same.what)
        np.testing.assert_array_equal(same.atoms.numbers, base.numbers[same.order])
