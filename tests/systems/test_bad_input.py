"""Each mistake in a system file or structure becomes one line that says what, where and what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.constraints import FixAtoms
from ase.io import write

from mdnum.errors import InputError
from mdnum.systems import load
from mdnum.systems.structures import to_extxyz

GOOD = """\
about = "argon"
units = "metal"

[structure]
file = "argon.extxyz"

[potential]
kind = "lennard-jones"
sigma = 3.405
epsilon = 0.0103235

[cutoff]
kind = "hard"
radius = 8.0

[neighbors]
skin = 0.5

[dynamics]
kind = "nve"
timestep = 0.002
steps = 10
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "argon.extxyz").write_text(to_extxyz(bulk("Ar", a=5.4, cubic=True).repeat(4)))
    (tmp_path / "system.toml").write_text(GOOD)
    return tmp_path


def refusal(folder: Path, overrides: dict[str, str] | None = None) -> str:
    with pytest.raises(InputError) as caught:
        load(folder / "system.toml", overrides)
    line = str(caught.value)
    assert "\n" not in line
    assert caught.value.exit_code == 2
    return line


def edit(folder: Path, old: str, new: str) -> None:
    text = (folder / "system.toml").read_text()
    assert old in text
    (folder / "system.toml").write_text(text.replace(old, new))


def test_the_unedited_file_loads(folder: Path):
    assert len(load(folder / "system.toml").atoms) == 256


LJ = 'kind = "lennard-jones"\nsigma = 3.405\nepsilon = 0.0103235'
CUTOFF = '[cutoff]\nkind = "hard"\nradius = 8.0\n'
FILE = 'file = "argon.extxyz"'
OWN, PAIR = "epsilon = 0.0103235", "{ sigma = 1.0, epsilon = 1.0 }"


# ranges and words of single keys are in the JSON schema, whose shipped copy is compared
@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("radius = 8.0", "radius = 8.0.1", 14, "not valid TOML … radius = 8.0.1"),
        ("[cutoff]", "[cutoff", 12, "not valid TOML"),
        ("radius = 8.0", "radus = 8.0", 14, "key 'radus' … [cutoff] … mean radius?"),
        ("[neighbors]", "[neighbours]", 16, "unknown key 'neighbours' … mean neighbors?"),
        ("radius = 8.0", "radius = 8.0\nonset = 7.0", 12, "onset … hard … no switching"),
        ('units = "metal"', 'units = "real"', 2, 'units = "real" … "metal" or "lj"'),
        ('units = "metal"', "", None, "key 'units' missing … metal: Å"),
        ("sigma = 3.405", "sigma = -3.405", 9, "potential.sigma = -3.405 … above 0 … Å or σ"),
        ("skin = 0.5", "skin = -0.5", 17, "neighbors.skin = -0.5 … at least 0"),
        ("skin = 0.5", 'skin = "0.5"', 17, 'neighbors.skin = "0.5" … expected a number … quotes'),
        ("steps = 10", "steps = 10.5", 22, "dynamics.steps = 10.5 … a whole number"),
        ("skin = 0.5", "skin = nan", 17, "neighbors.skin = nan … finite"),
        (
            '"lennard-jones"',
            '"lenard-jones"',
            8,
            "unknown … mean lennard-jones? … eam",
        ),
        ('kind = "nve"', "", 19, "'kind' missing … [dynamics] … nve, langevin"),
        (
            '"nve"',
            '"langevin"',
            19,
            "'temperature' missing … [dynamics] … dynamics.friction",
        ),
        ("radius = 8.0", "radius = true", 14, "cutoff.radius = true … expected a number"),
        ('"hard"\nradius = 8.0', '"switched"\nradius = 8.0\nonset = 8.0', 12, "not below the cutoff"),
        ("radius = 8.0", "", 12, "[cutoff] … no cutoff radius … in_sigma"),
        ("radius = 8.0", "radius = 8.0\nin_sigma = 2.5", 12, "given twice"),
        ("epsilon = 0.0103235", "", 7, "no value of epsilon"),
        (CUTOFF, "", None, "[cutoff] is missing"),
        (LJ, 'kind = "tersoff"', 10, "[cutoff]"),
        (f"[structure]\n{FILE}", "", None, "table [structure] missing"),
        (FILE, 'file = "gone.extxyz"', None, "gone.extxyz: structure file not found"),
        ("[neighbors]", "[neighbors]\nrebuild = 5", 17, "neighbors.rebuild = 5 … a table"),
        (OWN, f"{OWN}\npairs.ArKr = {PAIR}", None, "'ArKr' … two species … hyphen"),
        (OWN, f"{OWN}\npairs.Ar-Kr = {PAIR}\npairs.Kr-Ar = {PAIR}", None, "is given twice"),
        (OWN, f"{OWN}\npairs.Kr-Kr = {{ sgima = 1.0 }}", None, "unknown key 'sgima' in [potential.pair"),
        (FILE, FILE + "\nmasses = { Kr = 80.0 }", None, "lists a mass for Kr"),
        (FILE, 'builder = "fcc"\nsymbol = "Argon"\nlattice_constant = 5.4', None, "not a chemical symbol"),
    ],
)
def test_a_mistake_in_the_file(folder: Path, old: str, new: str, line: int | None, words: str):
    edit(folder, old, new)
    said = refusal(folder)
    assert all(word in said for word in words.split(" … ")), said
    assert line is None or f"system.toml:{line}: " in said


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("cutoff.radus", "8", "--set cutoff.radus … Did you mean radius?"),
        ("cutof.radius", "8", "--set cutof.radius:  … Did you mean cutoff?"),
        ("cutoff.kind", "swiched", "--set cutoff.kind … Did you mean switched?"),
        ("neighbors.skin", "wide", '--set neighbors.skin … "wide" … expected a number'),
        ("about.me", "x", "--set about.me … about is a single"),
        ("cutoff..radius", "8", "--set … is not a key"),
        ("dynamics.kind", "langevin", "key 'temperature' missing"),
        ("potential.kind", "morse", "no value of depth"),
        ("precision.state", "float16", '--set precision.state … "float32" or "lattice" … move no atom'),
        ("neighbors.skin", "3.0", "8 + 3 = 11 Å … 10.8 Å … a skin up to 2.8 Å"),
        ("cutoff.radius", "12", "a cutoff below 10.8 Å"),
    ],
)
def test_a_mistake_on_the_command_line(folder: Path, key: str, value: str, words: str):
    said = refusal(folder, {key: value})
    assert all(word in said for word in words.split(" … ")), said


def test_a_name_or_a_file_that_is_no_system(tmp_path: Path):
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00units")
    near = r"Did you mean argon/liquid-864\?"
    for name, words in (
        (tmp_path / "gone.toml", r"gone\.toml: "),
        (tmp_path / "bytes.toml", "UTF-8"),
        ("argon/liquid-846", f"a file called 'argon/liquid-846'.*{near}"),
        ("liquid-864", near),
    ):
        with pytest.raises(InputError, match=words):
            load(name)


@pytest.mark.parametrize("text", ["three\nnot a structure\n", "", None])
def test_an_unreadable_structure(folder: Path, text: str | None):
    whole = (folder / "argon.extxyz").read_text()
    (folder / "argon.extxyz").write_text(whole[: len(whole) // 2] if text is None else text)
    said = refusal(folder)
    assert "argon.extxyz" in said and ("ASE" in said or not text)


def change(folder: Path, atoms: Atoms) -> None:
    (folder / "argon.extxyz").write_text(to_extxyz(atoms))


def place(atoms: Atoms, **positions: list[float]) -> None:
    for atom, position in positions.items():
        atoms.positions[int(atom[1:])] = position


def lean(atoms: Atoms) -> None:
    """As long as before along every vector's axis, but leaning so far that its faces are close."""
    cell = np.array(atoms.cell)
    cell[1, 0] = 0.9 * cell[0, 0]
    atoms.set_cell(cell)


def flatten(atoms: Atoms) -> None:
    atoms.set_cell([*atoms.cell[:2], atoms.cell[0] + atoms.cell[1]])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda atoms: place(atoms, _17=[0, np.nan, 0]), "atom 17 (Ar) has positions"),
        (lambda atoms: place(atoms, _17=[0, np.nan, 0], _40=[np.inf] * 3), "of 1 other atoms"),
        (lambda atoms: atoms.set_momenta([[np.nan] * 3] * len(atoms)), "atom 0 (Ar) has momenta"),
        (lambda atoms: place(atoms, _0=atoms.positions[7] + [0.25, 0, 0]), "0.25 Å; expected … 1.362"),
        (lambda atoms: place(atoms, _0=[0.05, 1, 1], _9=[21.55, 1, 1]), "0 (Ar) and 9 (Ar) overlap"),
        (lean, "at most 8.02 … (along a)"),
        (flatten, "vectors span no volume"),
    ],
)
def test_a_structure_that_cannot_be_simulated(folder: Path, damage, words: str):
    atoms = load(folder / "system.toml").atoms
    damage(atoms)
    change(folder, atoms)
    said = refusal(folder)
    assert all(word in said for word in words.split(" … ")), said


def test_vectors_in_a_plane_are_refused_where_nothing_repeats(folder: Path):
    atoms = load(folder / "system.toml").atoms
    flatten(atoms)
    change(folder, atoms)
    assert "lattice vectors" in refusal(folder, {"structure.pbc": "[false, false, false]"})
    # two that are parallel and none along the third axis have no perpendicular
    parallel = Atoms("Ar2", positions=[[0, 0, 0], [4, 0, 0]], cell=[[20, 0, 0], [40, 0, 0], [0, 0, 0]])
    for pbc in ([False] * 3, [True, True, False]):
        parallel.pbc = pbc
        change(folder, parallel)
        assert "lattice vectors" in refusal(folder)


def test_what_just_fits_and_free_boundaries_have_no_width(folder: Path):
    load(folder / "system.toml", {"neighbors.skin": "2.7999"})
    system = load(folder / "system.toml", {"structure.pbc": "[false, false, false]", "cutoff.radius": "50"})
    assert not system.atoms.pbc.any()


def test_periodic_without_a_cell(folder: Path):
    change(folder, Atoms("Ar2", positions=[[0, 0, 0], [4, 0, 0]]))
    assert not load(folder / "system.toml").atoms.pbc.any()
    said = refusal(folder, {"structure.pbc": "[true, false, false]"})
    assert "axis a " in said


def test_unknown_species(folder: Path):
    atoms = load(folder / "system.toml").atoms
    atoms.symbols[5] = "Kr"
    change(folder, atoms)
    said = refusal(folder)
    assert "the structure contains Ar, Kr" in said
    assert "no parameters for Ar-Ar, Ar-Kr, Kr-Kr" in said
    with_pairs = """kind = "lennard-jones"
pairs.Ar-Ar = { sigma = 3.4, epsilon = 0.01 }
pairs.Kr-Ar = { sigma = 3.5, epsilon = 0.01 }
"""
    edit(folder, LJ, with_pairs)
    assert "Kr-Kr (parameters given: Ar-Ar, Kr-Ar)" in refusal(folder)


def test_silicon_constants_for_argon(folder: Path):
    edit(folder, CUTOFF, "")
    edit(folder, LJ, 'kind = "stillinger-weber"')
    said = refusal(folder)
    assert " Si." in said and " Ar" in said


def test_constraints_are_not_silently_dropped(folder: Path):
    atoms = load(folder / "system.toml").atoms
    atoms.set_constraint(FixAtoms([0]))
    write(folder / "fixed.extxyz", atoms, columns=["symbols", "positions", "move_mask"])
    edit(folder, "argon.extxyz", "fixed.extxyz")
    assert "constraints" in refusal(folder)


def test_a_table_that_is_not_setfl(folder: Path):
    edit(folder, CUTOFF, "")
    edit(folder, LJ, 'kind = "eam"\nfile = "ar.eam.alloy"')
    assert "ar.eam.alloy: " in refusal(folder)
    (folder / "ar.eam.alloy").write_text("one\ntwo\n")
    said = refusal(folder)
    assert "ar.eam.alloy" in said and "setfl" in said
    (folder / "ar.eam.alloy").write_text("a\nb\nc\n1 Cu\n100 0.1 100 0.05 5.0\n")
    said = refusal(folder)
    assert " Cu," in said and " Ar" in said
