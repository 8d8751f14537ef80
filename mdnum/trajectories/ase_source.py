"""Trajectories that ASE reads, every digit of them, and the runs of mdnum."""

from __future__ import annotations

import io
import tomllib
import zlib
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from ase.io.formats import UnknownFileTypeError

from mdnum.errors import InputError
from mdnum.trajectories.checked import FrameError
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.slices import chosen, counts_from_end
from mdnum.trajectories.source import AtomTable, Trajectory, UnreadableFrame, table_of_topology
from mdnum.trajectories.tails import refuse_cut_line
from mdnum.units import METAL, Units
from mdnum.units import get as units_named

# ASE's reader of each format raises what it likes on files that end early or hold something else
_UNREADABLE = Exception
# what the end of the file looks like to its reader of traj
_ENDS = frozenset({"buffer is smaller than requested size"})


class AseTrajectory(Trajectory):
    """A file that `ase.io` reads, frame by frame where its format allows that."""

    reader = "ASE"
    bits = 64

    def __init__(self, path: Path, topology: str | Path | None, frames: slice, format: str | None = None):
        from ase.io.formats import UnknownFileTypeError, filetype

        self.path, self.slice = path, frames
        self.topology = None if topology is None else Path(topology)
        try:
            # by its name, where ASE would look into it first and give up where it is cut
            plain = path.with_suffix("") if path.suffix in (".gz", ".bz2") else path
            self.format = format or ("extxyz" if plain.suffix == ".extxyz" else filetype(str(path)))
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
        self._images: Callable[[Iterator[int]], Iterator[tuple[int, Any]]]
        self._count: int | None = None
        if self.format == "traj":
            self._images, self._count = self._of_traj, _frames_of_traj(path)
        elif self.format == "extxyz":
            self._images = self._of_extxyz
        else:
            self._images = self._of_any
        first = self._first()
        self.table = (
            AtomTable.plain(first.get_chemical_symbols()) if topology is None else table_of_topology(topology)
        )
        if len(self.table) != len(first):
            raise InputError(
                f"the topology {Path(str(topology)).name} has {len(self.table):,} atoms "
                f"and the trajectory {len(first):,}",
                remedy="Give the topology that the trajectory was written with, or a selection of it",
                where=str(path),
            )
        self._timed = "time" in first.info
        units = _units(path)
        self.length, self.time = units.length, units.time if self._timed else "frame"
        self._per_time = units.time_factor

    @property
    def in_file(self) -> int | None:
        if self._count is None and counts_from_end(self.slice):
            self._count = sum(1 for _ in self._images(chosen(slice(None), None)))
        return self._count

    def frames(self) -> Iterator[Frame]:
        for number, atoms in self._images(chosen(self.slice, self.in_file)):
            if len(atoms) != self.atoms:
                raise FrameError(
                    f"frame {number} has {len(atoms):,} atoms and the first {self.atoms:,}",
                    remedy="Leave out the frames with another number of atoms: a flip needs the pair before",
                    where=str(self.path),
                    frame=number,
                )
            yield self._frame(number, atoms)

    def _frame(self, number: int, atoms: Any) -> Frame:
        momenta = atoms.arrays.get("momenta")
        velocities = None
        if momenta is not None and np.any(momenta):
            velocities = np.asarray(momenta, np.float64) / atoms.get_masses()[:, None] * self._per_time
        matrix, pbc = np.array(atoms.cell.array, np.float64), np.array(atoms.pbc, bool)
        return Frame(
            index=number,
            time=float(atoms.info["time"]) if self._timed and "time" in atoms.info else float(number),
            positions=np.array(atoms.positions, np.float64),
            box=Box(matrix, pbc),
            velocities=velocities,
            labels=np.array(atoms.get_chemical_symbols()),
        )

    def _first(self) -> Any:
        """The first frame of the file."""
        for _, atoms in self._images(iter([0])):
            return atoms
        raise InputError("the file holds no frame", remedy="Check how it was written", where=str(self.path))

    def _unreadable(self, number: int, error: BaseException) -> UnreadableFrame:
        if isinstance(error, UnknownFileTypeError) and self.format == str(error):
            raise InputError(
                f"--format {self.format!r} is known to neither MDAnalysis nor ASE",
                remedy="Write it as one of them does: XTC, DCD, lammpstrj, extxyz, ...",
                where=str(self.path),
            ) from error
        said = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
        if said in _ENDS:
            said = "the file ends in it"
        return UnreadableFrame(f"frame {number} cannot be read ({said})", frame=number, where=str(self.path))

    def _of_traj(self, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
        from ase.io.trajectory import TrajectoryReader

        with TrajectoryReader(str(self.path)) as reader:
            for number in numbers:
                if number >= len(reader):
                    return
                try:
                    atoms = reader[number]
                except _UNREADABLE as error:
                    raise self._unreadable(number, error) from error
                yield number, atoms

    def _of_extxyz(self, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
        """One block of lines at a time: ASE itself looks at the whole file before the first frame."""
        from ase.io import read
        from ase.io.formats import open_with_compression

        wanted = next(numbers, None)
        with open_with_compression(str(self.path), "r") as lines:
            number = 0
            while wanted is not None:
                try:
                    block = _block(lines)
                    if block is None:
                        return
                    atoms = read(io.StringIO("".join(block)), format="extxyz") if number == wanted else None
                except _UNREADABLE as error:
                    raise self._unreadable(number, error) from error
                if number == wanted:
                    yield number, atoms
                    wanted = next(numbers, None)
                number += 1

    def _of_any(self, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
        from ase.io import iread

        images = iread(str(self.path), index=slice(None), format=self.format, do_not_split_by_at_sign=True)
        number = 0
        for wanted in numbers:
            try:
                skipped = sum(1 for _ in islice(images, wanted - number))
                atoms = next(images, None) if skipped == wanted - number else None
            except _UNREADABLE as error:
                raise self._unreadable(wanted, error) from error
            if atoms is None:
                return
            number = wanted + 1
            yield wanted, atoms


def _block(lines: Any) -> list[str] | None:
    """The lines of the next frame of an XYZ file; None at its end."""
    head = lines.readline()
    if not head.strip():
        if any(line.strip() for line in lines):
            raise ValueError("a blank line where the number of atoms is expected")
        return None
    try:
        count = int(head)
    except ValueError:
        raise ValueError(f"{head.strip()[:40]!r} where the number of atoms is expected") from None
    block = [head, *islice(lines, count + 1)]
    if len(block) != count + 2:
        raise ValueError(f"the file ends after {max(len(block) - 2, 0):,} of {count:,} atoms")
    refuse_cut_line(block[2:])
    return block


def _frames_of_traj(path: Path) -> int:
    from ase.io.trajectory import TrajectoryReader

    try:
        with TrajectoryReader(str(path)) as reader:
            return len(reader)
    except _UNREADABLE as error:
        raise InputError(
            f"ASE cannot open it ({error})", remedy="Check that it was written to its end", where=str(path)
        ) from error


def _units(path: Path) -> Units:
    """Units of the mdnum run that a file belongs to; else ASE's Å, and ps for times and velocities."""
    system = path.parent / "system.toml"
    if path.name != "trajectory.traj" or not system.exists():
        return METAL
    return units_named(str(tomllib.loads(system.read_text()).get("units", "metal")))
