"""Damage, repeats, shifts, ids and boxes in systems and formats that the code was not written with."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import ase.build
import ase.io
import MDAnalysis
import numpy as np
import pytest
from ase import Atoms
from ase.geometry import cellpar_to_cell, get_distances

import mdnum
from mdnum.verbs.frame import Outcome

SIDE, CUTOFF = 11.2, 4.0


def crystal(
    frames: int = 8, names: Sequence[str] = ("Ar",), amplitude: float = 0.25, **more: Any
) -> list[Atoms]:
    """Thirty-two atoms that walk at random about the sites of a lattice."""
    rng = np.random.default_rng(1)
    sites = np.indices((4, 4, 4)).reshape(3, -1).T[:32] * SIDE / 4
    x, found = sites + rng.normal(0, 0.1, (32, 3)), []
    for _ in range(frames):
        x = sites + 0.9 * (x - sites) + rng.normal(0, amplitude, x.shape)
        symbols = [names[n % len(names)] for n in range(32)]
        found.append(Atoms(symbols, x.copy(), cell=[SIDE] * 3, **{"pbc": True, **more}))
    return found


def flips(frames: list[Atoms]) -> int:
    """Flips between frames, by brute force over the nearest images."""
    inside = [
        np.triu(get_distances(one.positions, cell=one.cell, pbc=one.pbc)[1] < CUTOFF, 1) for one in frames
    ]
    return sum(int((a ^ b).sum()) for a, b in pairwise(inside))


def written(path: Path, frames: list[Atoms]) -> Path:
    """A file of these frames, by ASE or by MDAnalysis."""
    if path.suffix in (".extxyz", ".traj"):
        ase.io.write(path, frames)
        return path
    universe = MDAnalysis.Universe.empty(len(frames[0]), trajectory=True)
    with MDAnalysis.Writer(str(path), len(frames[0])) as writer:
        for number, atoms in enumerate(frames):
            universe.atoms.positions = atoms.positions
            universe.dimensions = atoms.cell.cellpar() if atoms.pbc.any() else None
            universe.trajectory.ts.time = float(number)
            writer.write(universe.atoms)
    return path


@pytest.fixture
def examined(tmp_path: Path) -> Callable[..., Outcome]:
    """What `mdnum flips` finds in files of these names and frames, or that are there."""

    def examine(*files: tuple[str, list[Atoms]] | Path, **options: Any) -> Outcome:
        paths = [one if isinstance(one, Path) else written(tmp_path / one[0], one[1]) for one in files]
        asked = {"cutoffs": [CUTOFF], "report": False, "out": tmp_path / f"found-{paths[0].stem}"}
        return mdnum.flips(*paths, **{**asked, **options})

    return examine


def codes(found: Outcome) -> set[str]:
    return {one.code for one in found.verdict.findings}


# ---- what is no frame


def one_value(x: np.ndarray) -> None:
    x[:, 1] = -(2.0**31) / 1000


def a_coordinate_of_zeros(x: np.ndarray) -> None:
    x[:, 0] = 0


def a_line(x: np.ndarray) -> None:
    x[:, :2] = x[0, :2]


def a_point(x: np.ndarray) -> None:
    x[:] = x[0]


def squeezed(x: np.ndarray) -> None:
    x[:, 2] *= 1e-9


def shifted(x: np.ndarray) -> None:
    x += 3e7


def places_of_zeros(x: np.ndarray) -> None:
    x[10:] = 0


@pytest.mark.parametrize("kind", ["extxyz", "dcd", "trr", "traj"])
@pytest.mark.parametrize(
    "damage",
    [one_value, a_coordinate_of_zeros, a_line, a_point, squeezed, shifted, places_of_zeros],
    ids=lambda one: one.__name__,
)
@pytest.mark.parametrize("pbc", [True, False], ids=["box", "free"])
def test_reading_stops_where_finite_numbers_are_damaged(examined, damage, kind: str, pbc: bool):
    frames = crystal(pbc=pbc)
    damage(frames[5].positions)
    found = examined((f"run.{kind}", frames))
    assert found.summary["frames"] == 5 and "STOPPED" in codes(found)
    assert found.summary["rules"][0]["flips"] == flips(frames[:5])


def drifting() -> list[Atoms]:
    frames = crystal(20)
    for number, atoms in enumerate(frames):
        atoms.positions += 40.0 * number
    return frames


def centered_elsewhere() -> list[Atoms]:
    frames = crystal()
    for atoms in frames[4:]:
        atoms.positions += [SIDE, SIDE / 2, 0]
    return frames


def quenched_to_a_lattice() -> list[Atoms]:
    frames = crystal()
    frames[-1].positions = np.round(frames[-1].positions / 2.8) * 2.8
    return frames


def graphene(planar: int) -> list[Atoms]:
    """A sheet that is planar in the first or the last frames alone."""
    frames, rng = [ase.build.graphene(size=(4, 4, 1), vacuum=8.0) for _ in range(8)], np.random.default_rng(2)
    for number, atoms in enumerate(frames):
        ripple = 0.0 if (number < planar or number - 8 >= planar) else 0.02
        atoms.positions += rng.normal(size=(len(atoms), 3)) * [0.05, 0.05, ripple]
    return frames


@pytest.mark.parametrize(
    "frames",
    [
        drifting, centered_elsewhere, quenched_to_a_lattice, lambda: graphene(8), lambda: graphene(1),
        lambda: graphene(-1), lambda: [Atoms("Ar2", [[0, 0, 0], [3 + 0.3 * n, 0, 0]]) for n in range(8)],
    ],
    ids=["drift", "other center", "quench", "sheet", "sheet at first", "sheet at last", "two on a line"],
)  # fmt: skip
def test_what_a_simulation_does_write_is_read_to_its_end(examined, frames):
    made = frames()
    found = examined(("run.extxyz", made))
    assert found.summary["frames"] == len(made) and found.summary["stopped"] is None
    assert not codes(found) & {"STOPPED", "REPEATED_FRAMES", "LEAP"}


# ---- frames that come again


@pytest.mark.parametrize("kind", ["extxyz", "dcd", "xtc", "trr"])
@pytest.mark.parametrize("timed", [True, False], ids=["times", "no times"])
def test_an_overlap_is_named_and_can_be_left_out(examined, kind: str, timed: bool):
    frames = crystal(20)
    for number, atoms in enumerate(frames):
        if timed:
            atoms.info["time"] = 0.5 * number
        if kind == "xtc":
            # to its digits
            atoms.positions = np.round(atoms.positions, 2)
    joined = frames[:12] + frames[8:]
    found = examined((f"joined.{kind}", joined))
    assert "REPEATED_FRAMES" in codes(found) and found.summary["frames"] == 24
    left = examined((f"left.{kind}", joined), drop_repeats=True)
    if kind != "xtc":
        assert found.summary["rules"][0]["flips"] == flips(joined)
        assert left.summary["rules"][0]["flips"] == flips(frames)
    assert left.summary["rules"][0]["flips"] < found.summary["rules"][0]["flips"]


def test_a_way_back_over_the_same_frames_is_named(examined):
    frames = crystal(12)
    assert "REPEATED_FRAMES" in codes(examined(("back.extxyz", frames + frames[-2::-1])))
    assert "REPEATED_FRAMES" not in codes(examined(("run.extxyz", frames)))


# ---- two files of one run


@pytest.mark.parametrize("how", ["moving", "centered", "wrapped"])
def test_a_common_shift_is_no_difference(examined, how: str):
    a, b = crystal(10, ("Cu", "Zr")), crystal(10, ("Cu", "Zr"))
    for number, atoms in enumerate(b):
        if how == "centered":
            atoms.positions -= atoms.get_center_of_mass()
            continue
        atoms.positions += [1.3 + 0.2 * number * (how == "moving"), -0.7, 2.0]
        if how == "wrapped":
            atoms.wrap()
    found = examined(("a.extxyz", a), ("b.extxyz", b))
    assert "SHIFT" in codes(found) and not [one for one in found.verdict.findings if one.severity != "info"]


@pytest.mark.parametrize("law", ["t", "t²", "exponential"])
def test_only_exponential_growth_has_an_e_folding_time(examined, law: str):
    a, b = crystal(60, amplitude=0.02), crystal(60, amplitude=0.02)
    way = np.random.default_rng(4).normal(size=(32, 3))
    way -= way.mean(axis=0)
    for number, atoms in enumerate(b):
        grown = {"t": 1e-5 * number, "t²": 1e-5 * number**2, "exponential": 1e-8 * np.exp(number / 5)}[law]
        atoms.positions += grown * way
    (rule,) = examined(("a.traj", a), ("b.traj", b)).summary["rules"]
    found = rule["growth"]["before"]
    assert found["law"] == ("exponential" if law == "exponential" else "power")
    if law == "exponential":
        assert 1 / found["rate"] == pytest.approx(5, rel=0.05)
    else:
        assert found["exponent"] == pytest.approx({"t": 1, "t²": 2}[law], abs=0.1)


# ---- ids and boxes


def dump(path: Path, frames: list[Atoms], types: list[list[Any]], column: str) -> Path:
    """A LAMMPS dump with the rows of every frame in an order of its own."""
    rng, text = np.random.default_rng(0), ""
    for number, atoms in enumerate(frames):
        text += f"ITEM: TIMESTEP\n{10 * number}\nITEM: NUMBER OF ATOMS\n32\nITEM: BOX BOUNDS pp pp pp\n"
        text += 3 * f"0 {SIDE}\n" + f"ITEM: ATOMS id {column} x y z\n"
        for atom in rng.permutation(32):
            x, y, z = atoms.positions[atom]
            text += f"{atom + 1} {types[number][atom]} {x:.9f} {y:.9f} {z:.9f}\n"
    path.write_text(text)
    return path


@pytest.mark.parametrize(("column", "kinds"), [("type", (1, 2)), ("element", ("Cu", "Au"))])
def test_ids_tell_who_is_who_where_types_change(examined, tmp_path, column: str, kinds: tuple):
    frames = crystal()
    types = [[kinds[atom >= 16] for atom in range(32)] for _ in frames]
    for row in types[3:]:
        row[2], row[20] = kinds[1], kinds[0]
    path = dump(tmp_path / "swap.lammpstrj", frames, types, column)
    found = examined(path)
    assert found.summary["frames"] == 8 and found.summary["rules"][0]["flips"] == flips(frames)
    assert examined(path, cutoffs=[], nearest=[6], out=tmp_path / "nearest").summary["frames"] == 8
    pair = "-".join(map(str, kinds))
    stopped = examined(path, cutoffs=[], pairs=[f"{pair}=4"], out=tmp_path / "pairs")
    assert stopped.summary["frames"] == 3 and "frame 3: atom 2" in stopped.summary["stopped"]
    assert "one order" not in stopped.summary["stopped"]


def charmm(path: Path, frames: list[np.ndarray], six: Sequence[float], version: int) -> Path:
    """A DCD whose boxes are these six numbers."""

    def record(content: bytes) -> bytes:
        return struct.pack("<i", len(content)) + content + struct.pack("<i", len(content))

    head = bytearray(84)
    head[:4] = b"CORD"
    struct.pack_into("<4i", head, 4, len(frames), 0, 1, len(frames))
    struct.pack_into("<f", head, 40, 0.05)
    struct.pack_into("<i", head, 44, 1)
    struct.pack_into("<i", head, 80, version)
    content = record(bytes(head)) + record(struct.pack("<i", 1) + b"REMARK".ljust(80))
    content += record(struct.pack("<i", len(frames[0])))
    for x in frames:
        content += record(struct.pack("<6d", *six))
        content += b"".join(record(x[:, k].astype("<f4").tobytes()) for k in range(3))
    path.write_bytes(content)
    return path


def packed(cell: np.ndarray, atoms: int, apart: float) -> list[np.ndarray]:
    """Atoms in a cell that come no closer to one another, and shake."""
    rng, found = np.random.default_rng(3), np.zeros((0, 3))
    while len(found) < atoms:
        new = rng.random(3) @ cell
        if not len(found) or get_distances(new[None], found, cell=cell, pbc=True)[1].min() > apart:
            found = np.vstack([found, new])
    return [found + 0.02 * n * rng.normal(size=found.shape) for n in range(5)]


def shape_matrix(lengths_angles: Sequence[float]) -> np.ndarray:
    """The symmetric matrix of a box, the square root of its metric tensor."""
    cell = cellpar_to_cell(lengths_angles)
    values, vectors = np.linalg.eigh(cell @ cell.T)
    return (vectors * np.sqrt(values)) @ vectors.T


@pytest.mark.parametrize(
    ("box", "atoms"),
    [
        ((12.0, 12.5, 13.0, 93, 87, 92), 70),
        ((20.0, 21.0, 22.0, 90.5, 89.5, 91), 200),
        ((9.0, 9.5, 14.0, 90, 93, 90), 40),
    ],
)
@pytest.mark.parametrize(
    ("convention", "version"),
    # who writes cosines writes version 24
    [("matrix", 24), ("matrix", 35), ("cosines", 24), ("degrees", 24), ("degrees", 35)],
)
def test_a_box_is_what_its_atoms_fit_into_or_undecided(
    examined, tmp_path, box, atoms: int, convention: str, version: int
):
    a, b, c, alpha, beta, gamma = box
    if convention == "matrix":
        cell = shape_matrix(box)
        six = cell[np.tril_indices(3)].tolist()
        assert np.abs(cell[np.tril_indices(3, -1)]).max() < 1
    else:
        cell = cellpar_to_cell(box)
        of = np.asarray if convention == "degrees" else lambda angle: np.cos(np.radians(angle))
        six = [a, of(gamma), b, of(beta), of(alpha), c]
    frames = packed(cell, atoms, 2.3)
    found = examined(charmm(tmp_path / "run.dcd", frames, six, version))
    x = np.float32(frames[0]).astype(float)
    distances = get_distances(x, cell=cell, pbc=True)[1]
    right = int((np.triu(distances < CUTOFF, 1)).sum())
    counted = found.summary["rules"][0]["pairs_first"]
    assert counted == right or "BOX_UNDECIDED" in codes(found), (counted, right)
    if convention == "degrees":
        assert counted == right and "BOX_UNDECIDED" not in codes(found)
