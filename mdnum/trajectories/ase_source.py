"""Trajectories that ASE reads, every digit of them, and the runs of mdnum."""

from __future__ import annotations

import tomllib
import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from ase.io.formats import UnknownFileTypeError, filetype, iread
from ase.io.trajectory import TrajectoryReader

from mdnum.errors import InputError
from mdnum.trajectories.frame import Box, Frame, UnreadableFrame
from mdnum.trajectories.topology import AtomTable
from mdnum.trajectories.trajectory import Trajectory
from mdnum.units import METAL, Units
from mdnum.units import get as units_named

# what the end of the file looks like to its reader of traj
_ENDS = "buffer is smaller than requested size"


class AseFrames(Trajectory):
    """Frames that are ASE's Atoms once they are read."""

    reader = "ASE"
    # ASE's reader of each format raises what it likes on files that end early or hold something else
    _fails = (Exception,)
    _timed, _per_time = False, 1.0

    def _atoms_of(self, raw: Any) -> Any:
        return raw

    def _of_atoms(self, first: Any) -> AtomTable:
        """What the first frame says of its atoms, and of the units."""
        self._timed = "time" in first.info
        units = _units(self.path)
        self.length, self.time = units.length, units.time if self._timed else "frame"
        self._per_time = units.time_factor
        return AtomTable.plain(first.get_chemical_symbols())

    def _frame(self, number: int, raw: Any) -> Frame:
        atoms = self._atoms_of(raw)
        momenta, velocities = atoms.arrays.get("momenta"), None
        if momenta is not None and np.any(momenta):
            velocities = np.asarray(momenta, np.float64) / atoms.get_masses()[:, None] * self._per_time
        timed = self._timed and "time" in atoms.info
        return Frame(
            index=number,
            time=float(atoms.info["time"]) if timed else float(number),
            positions=np.array(atoms.positions, np.float64),
            box=Box(np.array(atoms.cell.array, np.float64), np.array(atoms.pbc, bool)),
            velocities=velocities,
            labels=np.array(atoms.get_chemical_symbols()),
        )


class AseTrajectory(AseFrames):
    """A file that `ase.io` reads, frame by frame where its format allows that."""

    def __init__(self, path: Path, topology: str | Path | None, frames: slice, format: str):
        super().__init__(path, topology, frames)
        self.format = format
        if format == "traj":
            try:
                with TrajectoryReader(str(path)) as reader:
                    self._count = len(reader)
            except Exception as error:
                raise InputError(
                    f"ASE cannot open it ({error})",
                    remedy="Check that it was written to its end",
                    where=str(path),
                ) from error
        _, first = self._first()
        self._has(len(first), self._of_atoms(first))

    def _raw(self, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
        return self._of_traj(numbers) if self.format == "traj" else self._of_any(numbers)

    def _of_traj(self, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
        with TrajectoryReader(str(self.path)) as reader:
            for number in numbers:
                if number >= len(reader):
                    return
                try:
                    atoms = reader[number]
                except Exception as error:
                    raise self._unreadable(number, error) from error
                yield number, atoms

    def _of_any(self, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
        images = iread(str(self.path), index=slice(None), format=self.format, do_not_split_by_at_sign=True)
        number = 0
        for wanted in numbers:
            try:
                atoms = next(islice(images, wanted - number, None), None)
            except Exception as error:
                raise self._unreadable(wanted, error) from error
            if atoms is None:
                return
            number = wanted + 1
            yield wanted, atoms

    def _unreadable(self, number: int, error: BaseException | str) -> UnreadableFrame:
        if isinstance(error, UnknownFileTypeError) and self.format == str(error):
            raise InputError(
                f"--format {self.format!r} is known to neither MDAnalysis nor ASE",
                remedy="Write it as one of them does: XTC, DCD, lammpstrj, extxyz, ...",
                where=str(self.path),
            ) from error
        return super()._unreadable(number, "the file ends in it" if _ENDS in str(error) else error)


def format_of(path: Path) -> str:
    """The format of a file in ASE's word.

    Raises:
        InputError: it knows none for it, or the file cannot be read.
    """
    # by its name, where ASE would look into it first and give up where it is cut
    plain = path.with_suffix("") if path.suffix in (".gz", ".bz2") else path
    if plain.suffix == ".extxyz":
        return "extxyz"
    try:
        return filetype(str(path))
    except UnknownFileTypeError as error:
        raise InputError(
            "neither MDAnalysis nor ASE knows this format",
            remedy="Name the file by its format (.xtc, .dcd, .extxyz, ...), or convert it",
            where=str(path),
        ) from error
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise InputError(
            f"it cannot be read ({str(error).rstrip('.')})",
            remedy="Check that the file is whole and of the kind its name says",
            where=str(path),
        ) from error


def _units(path: Path) -> Units:
    """Units of the mdnum run that a file belongs to; else ASE's Å, and ps for times and velocities."""
    system = path.parent / "system.toml"
    if path.name != "trajectory.traj" or not system.exists():
        return METAL
    return units_named(str(tomllib.loads(system.read_text()).get("units", "metal")))
