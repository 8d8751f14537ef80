"""Planted mistakes are found, by their code, and what is right passes."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from audit import planted
from audit.planted import chain, crystal, subject

from mdnum.audit import transformations
from mdnum.audit.base import Part
from mdnum.audit.invariance import Invariance


def codes(part: Part) -> dict[str, str]:
    """Severities by code."""
    return {one["code"]: one["severity"] for one in part.findings}


@pytest.mark.parametrize("atoms", [crystal(), chain()], ids=["crystal", "chain"])
@pytest.mark.parametrize("make", [planted.Good, planted.Single, planted.HalfSkin])
def test_what_is_right_passes(make, atoms: Atoms):
    part = Invariance()(subject(make, atoms))
    assert not part.findings
    assert part.numbers["ways"] > 10 and not part.skipped


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
    check = Invariance()
    assert codes(check(subject(make))).get(code) == "error"
    slug = code.lower()
    assert f"{slug}-before" in check.structures and f"{slug}-after" in check.structures


@pytest.mark.parametrize(("make", "code"), [(planted.Handed, "MIRROR"), (planted.WrapsAlways, "DUMMY_CELL")])
def test_a_planted_mistake_of_clusters_is_found(make, code: str):
    assert codes(Invariance()(subject(make, chain()))).get(code) == "error"


class Wide(planted.Good):
    """Refuses what a search for the nearest images would have wrong."""

    def answer(self, atoms):
        if atoms.pbc.any() and atoms.cell.lengths().min() < 2 * planted.R_CUT:
            raise ValueError("the cell is narrower than two cutoffs")
        return super().answer(atoms)


def narrow(make) -> dict[str, str]:
    """Findings about narrow cells, of a structure with room for two cutoffs."""
    roomy = bulk("Ar", "fcc", a=3.9, cubic=True).repeat(2)
    asked = subject(make, roomy)
    check = Invariance()
    rng = np.random.default_rng(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transformations, "all_of", lambda atoms, *_: transformations.narrow(atoms, rng))
        return codes(check(asked))


def test_a_structure_with_room_does_not_hide_the_nearest_image():
    assert narrow(planted.NearestImage) == {"NARROW_CELL": "warning"}
    assert narrow(planted.Good) == {}
    assert narrow(Wide) == {"NARROW_CELL_REFUSED": "info"}
    assert not list(transformations.narrow(chain(), np.random.default_rng(0)))


def test_only_what_is_wrong_is_named():
    """A cap on neighbors does not make faces, images or the dummy cell wrong."""
    found = codes(Invariance()(subject(planted.NearestImage)))
    assert not {"TRANSLATION", "IMAGES", "FACES", "ORDER", "CELL_ULP"} & set(found)


def test_a_shell_on_the_cutoff_is_told_by_an_ulp_of_the_cell():
    """As given, a whole shell is at the cutoff to the last bit; moved a little it is not."""
    atoms = bulk("Ar", "sc", a=planted.R_CUT).repeat((2, 2, 2))
    found = codes(Invariance()(subject(planted.HardEdge, atoms)))
    assert set(found) == {"CELL_ULP"}
    assert not Invariance()(subject(planted.Good, atoms)).findings


def test_what_a_calculator_refuses_is_left_out_and_said():
    part = Invariance()(subject(planted.OnlyRectangles))
    assert not part.findings
    assert any("lattice" in what for what, _ in part.skipped)


def test_failing_on_another_image_is_a_finding():
    class Fragile(planted.Good):
        def answer(self, atoms):
            if np.any(np.abs(atoms.positions) > 60):
                raise IndexError("cell 17 of 16")
            return super().answer(atoms)

    assert codes(Invariance()(subject(Fragile)))["FAILS"] == "error"


def test_nan_of_another_image_is_a_finding(tmp_path):
    class Fragile(planted.Good):
        def extra(self, atoms, energy, forces):
            return (np.nan if np.any(np.abs(atoms.positions) > 60) else energy), forces

    asked = subject(Fragile)
    asked.folder = tmp_path
    assert codes(Invariance()(asked))["NOT_FINITE"] == "error"
    assert list(tmp_path.glob("failed-*.extxyz"))


@pytest.mark.parametrize(
    ("make", "atoms"),
    [
        (lambda: LennardJones(sigma=3.4, epsilon=0.01, rc=8.5), bulk("Ar", "fcc", a=5.26)),
        (EMT, bulk("Cu")),
        (EMT, bulk("Cu", cubic=True).repeat((2, 1, 1))),
    ],
    ids=["lj", "emt-primitive", "emt"],
)
def test_ases_own_pass(make, atoms: Atoms):
    """One atom in a cell needs images of images."""
    assert not Invariance()(subject(make, atoms)).findings


def test_molecules_told_by_order_are_no_mistake():
    """Rigid water of ASE: molecules are groups of three, and must be whole."""
    from ase.calculators.tip3p import TIP3P, angleHOH, rOH

    half = np.radians(angleHOH) / 2
    arm = rOH * np.array([[0, 0, 0], [0, np.cos(half), np.sin(half)], [0, np.cos(half), -np.sin(half)]])
    water = Atoms("OH2", positions=arm + 1.0, cell=[3.1] * 3, pbc=True).repeat((3, 3, 3))
    found = codes(Invariance()(subject(lambda: TIP3P(rc=4.5), water)))
    assert found == {"TOPOLOGY_BY_ORDER": "info", "WHOLE_MOLECULES": "warning"}


def test_every_way_is_the_same_structure():
    """The transformations are right by themselves: all distances stay, found by ASE's own search."""
    from ase.neighborlist import neighbor_list

    rng = np.random.default_rng(5)
    atoms = crystal()
    atoms.positions += rng.uniform(-0.05, 0.05, (len(atoms), 3))

    def distances(structure: Atoms) -> np.ndarray:
        return np.sort(neighbor_list("d", structure, 4.3))

    for same in transformations.all_of(atoms, atoms, rng):
        before = distances(atoms if same.before is None else same.before)
        np.testing.assert_allclose(
            distances(same.atoms),
            np.sort(np.tile(before, same.copies)),
            rtol=0,
            atol=1e-12,
            err_msg=same.what,
        )
        expected = (atoms if same.before is None else same.before).numbers[same.order]
        np.testing.assert_array_equal(same.atoms.numbers, expected)
