"""Trajectories of any code as frames in float64: the contract, and which reader a file gets.

Positions are those of the file: nothing is wrapped, made whole or centered. Readers differ in what they keep:
ASE's and mdnum's own (gro, LAMMPS's text dumps) keep every digit, MDAnalysis's narrow every coordinate to
float32 (`Trajectory.bits`).
"""

from __future__ import annotations

import json
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from mdnum.errors import InputError
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.slices import parse_slice, split_path


class UnreadableFrame(InputError):
    """A frame in the middle of a file cannot be read; those before it were given out.

    Args:
        frame: its number in the file, from 0.
    """

    def __init__(self, message: str, *, frame: int, where: str, remedy: str | None = None):
        otherwise = (
            f"The frames before it were read; to stop there add @:{frame} to the path"
            if frame
            else "Check that the file is whole and of the kind its name says"
        )
        super().__init__(message, remedy=remedy or otherwise, where=where)
        self.frame = frame


@dataclass(frozen=True)
class AtomTable:
    """What a topology says of every atom, one entry an atom.

    Attributes:
        names: as in the file ("OW"); the species where it has no names.
        species: chemical element where it is known or can be guessed, else the file's atom type.
        residue_names: "" where there are none.
        residue_ids: number of the residue as the file has it; 0 where there are none.
        residues: index of the atom's residue from 0, different for two residues of one number.
        named: False where the file says nothing of its atoms but how many they are.
        guessed: whether the species were guessed from names.
    """

    names: np.ndarray
    species: np.ndarray
    residue_names: np.ndarray
    residue_ids: Int[np.ndarray, "atoms"]
    residues: Int[np.ndarray, "atoms"]
    named: bool = True
    guessed: bool = False

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def plain(cls, species: list[str], named: bool = True) -> AtomTable:
        """Atoms that have a species and belong to no residue."""
        words, none = np.array(species, dtype=object), np.zeros(len(species), np.int64)
        return cls(words, words, np.full(len(species), "", dtype=object), none, none, named)


class Trajectory(ABC):
    """Frames of one file, read lazily and in order, as often as wanted.

    Attributes:
        path: the file.
        format: the file's format in the reader's word ("XTC", "extxyz").
        reader: who reads it ("MDAnalysis", "ASE", "mdnum").
        bits: width of a coordinate as it comes from the reader, 32 or 64; frames are float64 either way.
        length: unit of length in words; "" where the file does not say.
        time: unit of time in words; "frame" where the file has no times, whose numbers then stand for them
            (velocities are per ps there, if the file has any).
        table: what is known of the atoms.
        notes: what a reader of the results should know about the reading, each a sentence.
        slice: the frames asked for.
        topology: the file that says what the atoms are, where it is another one.
    """

    path: Path
    topology: Path | None = None
    format: str
    reader: str
    bits: int = 64
    length: str = "Å"
    time: str = "frame"
    table: AtomTable
    notes: tuple[str, ...] = ()
    slice: slice

    @property
    def atoms(self) -> int:
        """Atoms in every frame."""
        return len(self.table)

    @property
    def species(self) -> np.ndarray:
        """Species of every atom, words, shape (atoms,)."""
        return self.table.species

    @property
    def name(self) -> str:
        """The file's name, with what was asked for of its frames."""
        return self.path.name

    @property
    @abstractmethod
    def in_file(self) -> int | None:
        """Frames in the file; None where they are not known without reading it."""

    @property
    def count(self) -> int | None:
        """Frames that `frames` gives; None where they are not known without reading the file."""
        if self.in_file is None:
            return None
        return len(range(*self.slice.indices(self.in_file)))

    @property
    def universe(self) -> Any:
        """The MDAnalysis Universe behind it, or None: another reader has none."""
        return None

    @abstractmethod
    def frames(self) -> Iterator[Frame]:
        """The frames asked for, in order, one in memory at a time. Each call starts at the first again.

        Raises:
            UnreadableFrame: one cannot be read. Those before it have been given.
            InputError: a frame has another number of atoms.
        """


def open_trajectory(
    path: str | Path, topology: str | Path | None = None, slice: str = "", format: str | None = None
) -> Trajectory:
    """Opens a file that MDAnalysis or ASE reads, or the folder of an mdnum run.

    Args:
        path: the file; may end in @START:STOP:STEP.
        topology: a file that says what the atoms are, where the trajectory does not (xtc, trr, dcd, ...):
            anything that MDAnalysis takes for one.
        slice: frames to read, as behind the @.
        format: the format in MDAnalysis's or ASE's word, where the name of the file does not tell it.

    Raises:
        InputError: no such file, nobody reads it, or it does not belong to the topology.
    """
    file, words = split_path(str(path))
    if words and slice:
        raise InputError(f"frames are named twice, by @{words} and by {slice!r}", remedy="Name them once")
    frames = parse_slice(slice or words, where=str(path))
    if file.is_dir() and (file / "trajectory.traj").exists():
        from mdnum.store import RunFolder

        RunFolder.open(file).check("trajectory.traj")
        file = file / "trajectory.traj"
    if file.is_dir():
        if (file / "summary.json").exists():
            _refuse_folder(file)
        if file.suffix != ".bundle":
            raise InputError("it is a folder", remedy="Give the trajectory itself", where=str(file))
    for one in (file, None if topology is None else Path(topology).expanduser()):
        if one is not None and not one.exists():
            raise InputError("no such file", remedy="Check the path", where=str(one))
        if one is not None and one.is_file() and not one.stat().st_size:
            raise InputError("the file is empty", remedy="Check how it was written", where=str(one))
    opened = _opened(file, topology, frames, format)
    if not opened.atoms:
        raise InputError("its frames have no atoms", remedy="Check how the file was written", where=str(file))
    return opened


def _refuse_folder(folder: Path) -> None:
    """Says why a folder that mdnum wrote holds no trajectory."""
    try:
        world = json.loads((folder / "summary.json").read_text()).get("world", "md")
    except (ValueError, AttributeError, OSError):
        world = "md"
    if world != "md":
        raise InputError(
            "this folder holds results, and no trajectory",
            remedy=f"Give the trajectory itself; `mdnum report {folder}` shows what the folder holds",
            where=str(folder),
        )
    raise InputError(
        "this run folder has no trajectory",
        remedy="Run again with --save-every 1 (or another number of steps)",
        where=str(folder),
    )


def _opened(file: Path, topology: str | Path | None, frames: slice, format: str | None) -> Trajectory:
    reader = _reader_of(file, format)
    if reader == "ase":
        from mdnum.trajectories.ase_source import AseTrajectory

        return AseTrajectory(file, topology, frames, format)
    if reader == "lammps":
        from mdnum.trajectories.lammps_dump import LammpsDump

        return LammpsDump(file, topology, frames)
    if reader == "xtc":
        from mdnum.trajectories.xtc_source import XtcTrajectory

        return XtcTrajectory(file, topology, frames)
    if reader == "netcdf":
        from mdnum.trajectories.netcdf_source import NetcdfTrajectory

        return NetcdfTrajectory(file, topology, frames)
    if reader == "gro":
        from mdnum.trajectories.gro import GroTrajectory

        return GroTrajectory(file, topology, frames)
    from mdnum.trajectories.mdanalysis_source import MDAnalysisTrajectory

    return MDAnalysisTrajectory(file, topology, frames, format)


def table_of_topology(topology: str | Path) -> AtomTable:
    """The atoms of a topology file: any that MDAnalysis takes for one, or any structure that ASE reads.

    Raises:
        InputError: neither reads it.
    """
    from mdnum.trajectories.mdanalysis_source import table_of, topology_universe

    try:
        return table_of(topology_universe(topology).atoms)
    except InputError:
        from ase import Atoms
        from ase.io import read

        try:
            atoms = read(str(topology))
        except Exception as error:
            raise InputError("neither MDAnalysis nor ASE reads this topology", where=str(topology)) from error
        assert isinstance(atoms, Atoms)
        return AtomTable.plain(atoms.get_chemical_symbols())


# MDAnalysis reads XYZ too, but neither boxes nor more than float32 of it; the others it does not know
_ASE_SUFFIXES = frozenset({".traj", ".extxyz", ".json", ".db", ".bundle", ".castep", ".xsf", ".con"})


_OWN = {"lammpsdump": "lammps", "lammpstrj": "lammps", "lammps-dump-text": "lammps"}
_OWN |= {"gro": "gro", "xtc": "xtc"}
# Amber's, of which MDAnalysis reads those that are whole
_NETCDF = frozenset({"nc", "ncdf", "netcdf"})


def _reader_of(file: Path, format: str | None) -> str:
    """Which reader a file gets: "ase", "mdanalysis", or one of mdnum's: "lammps", "gro", "xtc", "netcdf"."""
    suffix = (file.with_suffix("") if file.suffix in (".gz", ".bz2") else file).suffix.lower()
    if format is not None and format.lower() in _OWN:
        return _OWN[format.lower()]
    if (format or suffix[1:]).lower() in _NETCDF and _is_cut_netcdf(file):
        return "netcdf"
    if format is not None:
        return "mdanalysis" if format.upper() in _mdanalysis_formats() else "ase"
    if suffix in _ASE_SUFFIXES or (suffix == ".cif" and find_spec("gemmi") is None):
        return "ase"
    if suffix in (".gro", ".xtc"):
        return suffix[1:]
    if suffix[1:].upper() not in _mdanalysis_formats() and _first_lines(file)[0].startswith("item:"):
        return "lammps"
    if suffix == ".xyz" and _is_extended(file):
        return "ase"
    if suffix[1:].upper() in _mdanalysis_formats():
        return "mdanalysis"
    return "ase"


def _is_cut_netcdf(file: Path) -> bool:
    from mdnum.trajectories.netcdf import head_of

    head = head_of(file)
    return head is not None and head.cut


def _mdanalysis_formats() -> set[str]:
    import MDAnalysis

    return set(MDAnalysis._READERS)


def _is_extended(file: Path) -> bool:
    """Whether the comment line of an XYZ file says what its columns are, or its box."""
    comment = _first_lines(file)[1]
    return "lattice=" in comment or "properties=" in comment


def _first_lines(file: Path) -> tuple[str, str]:
    """The first two lines in small letters; empty for a file that is no text."""
    from ase.io.formats import open_with_compression

    try:
        with open_with_compression(str(file), "r") as lines:
            return lines.readline(1000).lower(), lines.readline(10_000).lower()
    except (OSError, EOFError, zlib.error, UnicodeDecodeError):
        return "", ""
