"""Trajectories read by MDAnalysis, and data that MDAnalysis does not read.

MDAnalysis takes a damaged frame of dcd, trr and some text formats for the end of the file. MDAnalysis skips
the remaining data silently. The digits of a truncated last number in a text file are read as a different
number. The Amber NetCDF file of a killed run has fewer records than its header states. MDAnalysis rejects
such a file; this module reads it (ambermd.org/netcdf/nctraj.xhtml).
"""

from __future__ import annotations

import math
import struct
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import netcdf_file

from mdnum.reading import check_claim, reading
from mdnum.trajectories.binary import TrrFile, opened
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.text import refuse_cut_line
from mdnum.trajectories.topology import (
    NARROWED,
    AtomTable,
    Boxes,
    Topology,
    atoms_in,
    box_of,
    file_of,
    formats_of,
)
from mdnum.trajectories.trajectory import Trajectory

_STALE = (
    "the index of frames that MDAnalysis keeps next to the file is not of this file; open the Universe with "
    "refresh_offsets=True"
)
# readers of text by lines, and where each has its open file
_LINES = {"XYZ": "xyzfile", "TXYZ": "xyzfile", "ARC": "xyzfile", "TRJ": "trjfile", "MDCRD": "trjfile"}
# where readers keep the places at which frames begin
_BEGINS = {"XYZ": "_offsets", "PDB": "_start_offsets", "ENT": "_start_offsets"}
# enough of a file's end for some lines
_LAST_BYTES = 20_000
_PART = 1 << 22


class LibraryFrames:
    """Frames of an MDAnalysis reader, each checked before MDAnalysis reads it.

    Attributes:
        raw: the last frame read, before transformations; None if there are no transformations.
        replaced: whether transformations in memory have replaced the values from the file.
    """

    def __init__(self, trajectory: Any):
        from MDAnalysis.coordinates.base import ProtoReader

        self.trajectory = trajectory
        self.raw: Frame | None = None
        self._later: tuple[Any, ...] = tuple(getattr(trajectory, "transformations", ()))
        on_reading = type(trajectory)._apply_transformations is ProtoReader._apply_transformations
        self.replaced = bool(self._later) and not (on_reading and hasattr(trajectory, "_transformations"))
        self.boxes, self.labels = Boxes(trajectory), labels_of(trajectory)
        self._guard = opened(trajectory)

    def timestep(self, number: int, forward: bool = False) -> Any:
        """Return the Timestep of a frame. `forward` means that the reader is at the previous frame.

        Raises:
            UnreadableFrame: the frame is unreadable, would crash the process, or ends with a truncated
                number.
        """
        with self._reading(number):
            if self._guard is not None:
                self._guard.check(number)
                offsets = getattr(getattr(self.trajectory, "_xdr", None), "offsets", ())
                if len(offsets) > number and offsets[number] != self._guard.start(number):
                    raise ValueError(_STALE)
            self._refuse_cut_text(number)
            if not self._later or self.replaced:
                return self.trajectory.next() if forward else self.trajectory[number]
            trajectory = self.trajectory
            trajectory._transformations = []
            try:
                ts = trajectory[number]
                self.raw = Frame(number, 0.0, np.array(ts.positions, np.float64), self._box(ts, number))
            finally:
                trajectory._transformations = list(self._later)
            for one in self._later:
                ts = one(ts)
            trajectory.ts = ts
            return ts

    def frame(self, ts: Any, number: int, untimed: bool = False) -> Frame:
        """Return a `Frame` with copies of a timestep's data. Raise the same errors as `timestep`."""
        with self._reading(number):
            time, x = float(number) if untimed else float(ts.time), np.array(ts.positions, np.float64)
            velocities = np.array(ts.velocities, np.float64) if ts.has_velocities else None
            return Frame(number, time, x, self._box(ts, number), velocities, self.labels(number))

    def _box(self, ts: Any, number: int) -> Box:
        if isinstance(self._guard, TrrFile) and not self._guard.has_box(number):
            # what MDAnalysis has then is what was in the memory
            return Box()
        return self.boxes.box(ts, number)

    def _reading(self, number: int) -> AbstractContextManager[None]:
        return reading(file_of(self.trajectory) or "the trajectory", number)

    def _refuse_cut_text(self, number: int) -> None:
        """Reject the last frame of a text file with a truncated last number."""
        trajectory = self.trajectory
        if number != trajectory.n_frames - 1 or (found := _text(trajectory)) is None:
            return
        path, word = found
        end, size = _last_bytes(path)
        offsets = getattr(trajectory, "_offsets", ())
        if len(offsets) > number + 1 and offsets[number + 1] < size:
            # what was cut are lines behind this frame, too few for another: left_over tells of them
            return
        last = end.decode("latin-1").splitlines(keepends=True)
        if word == "XYZ":
            refuse_cut_line(last[-int(trajectory.n_atoms) :])
        elif word in ("TRJ", "MDCRD") and last:
            # a line of it holds several numbers
            refuse_cut_line(last[-1:], last[-1].split()[:-1])


class MDAnalysisTrajectory(Trajectory):
    """Trajectory read through an MDAnalysis Universe, with all coordinates reduced to float32."""

    reader = "MDAnalysis"
    bits = 32

    def __init__(self, path: Path, topology: Topology | None, frames: slice, format: str | None = None):
        super().__init__(path, topology, frames)
        with reading(path):
            self.universe, said = self._universe_of(format)
            if topology is None:
                self.table = AtomTable.of(self.universe.atoms)
            self.table.give_elements(self.universe)
            trajectory = self.universe.trajectory
            self.format, self._count = formats_of(trajectory)[0], int(trajectory.n_frames)
            self.length = _length_of(trajectory)
            # a frame may have its time without a step between frames
            untimed = "time" not in trajectory.ts.data and any("no dt information" in one for one in said)
            self.time = "frame" if untimed else "ps"
            self._time_factor, self.swapped = _time_factors(trajectory)
            self._boxes = Boxes(trajectory)
            self.notes = (NARROWED, *self.table.notes, *self._boxes.notes)

    def other_box(self, number: int) -> tuple[str, Box] | None:
        with reading(self.path, number):
            return self._boxes.other(self.universe.trajectory[number], number)

    def _universe_of(self, format: str | None) -> tuple[Any, list[str]]:
        """Return a Universe of the trajectory, and the warnings of its reader."""
        import MDAnalysis

        path = self.path
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            if self.topology is None:
                check_claim(path, atoms_in(path, format=format) or 0)
                universe = MDAnalysis.Universe(str(path), format=format)
            else:
                self.table, universe = self.topology.read()
                atoms = len(universe.atoms)
                other = atoms_in(path, atoms, format)
                check_claim(path, other or 0)
                self._belongs(atoms, atoms if other is None else other)
                try:
                    universe.load_new(str(path), format=format)
                except ValueError as error:
                    # an H5MD file may say nothing of its units
                    if "convert_units" not in str(error):
                        raise
                    universe.load_new(str(path), format=format, convert_units=False)
            # a topology without coordinates has no trajectory at all
            if not len(getattr(universe, "trajectory", ())):
                raise self._empty()
            _ = universe.trajectory.dt
        return universe, [str(one.message) for one in caught]

    @contextmanager
    def raw_frames(self) -> Iterator[Callable[[int], Frame]]:
        trajectory, at = self.universe.trajectory, None
        with reading(self.path):
            frames = LibraryFrames(trajectory)

        def get(number: int) -> Frame:
            nonlocal at
            # some formats go forward only, so that the next frame is asked for as the next
            forward = at is not None and number == at + 1 and trajectory.ts.frame == at
            ts, at = frames.timestep(number, forward), number
            frame = frames.frame(ts, number, self.time == "frame")
            return replace(frame, time=frame.time * self._time_factor)

        yield get

    def _behind(self) -> str | None:
        return left_over(self.universe.trajectory)

    def decoded(self, number: int, raw: Frame) -> Frame:
        return raw


def labels_of(trajectory: Any) -> Callable[[int], np.ndarray | None]:
    """Return a function that reads the labels of any frame. MDAnalysis reads only those of the first frame.

    The function returns None except for XYZ files and PDB files with several models.
    """
    from MDAnalysis.lib.util import anyopen

    word = next((word for word in formats_of(trajectory) if word in _BEGINS), None)
    # another release of MDAnalysis may keep it elsewhere
    offsets = None if word is None or trajectory.n_frames < 2 else getattr(trajectory, _BEGINS[word], None)
    if offsets is None:
        return lambda number: None
    file: Any = anyopen(str(trajectory.filename))

    def of(number: int) -> np.ndarray | None:
        file.seek(offsets[number])
        if word == "XYZ":
            rows = list(islice(file, trajectory.n_atoms + 2))[2:]
            return np.array([row.split(maxsplit=1)[0] for row in rows])
        found: list[str] = []
        for row in file:
            if row.startswith(("ATOM  ", "HETATM")):
                found.append(f"{row[17:21].strip()} {row[12:16].strip()}")
            elif found and row.startswith(("ENDMDL", "MODEL", "END")):
                break
        return np.array(found)

    return of


def _length_of(trajectory: Any) -> str:
    """Return the length unit of a trajectory. "" if the file format defines no unit (GSD)."""
    unit = trajectory.units.get("length")
    if unit is None or getattr(trajectory, "convert_units", True):
        return "Å" if unit else ""
    # left as they are, because the file did not name all its units
    return "Å" if str(unit) in ("A", "Angstrom", "angstrom") else str(unit)


def _time_factors(trajectory: Any) -> tuple[float, float]:
    """Return ratios of DCD time steps: stored / MDAnalysis's value, and byte-swapped / stored value."""
    read = trajectory._file.header["delta"] if "DCD" in formats_of(trajectory) else 0.0
    if not read:
        return 1.0, math.nan
    with Path(trajectory.filename).open("rb") as file:
        head = file.read(88)
    # without a version, it is X-PLOR's
    kind, orders = "f" if any(head[84:]) else "d", "<>" if head[:1] == b"T" else "><"
    step, other = (struct.unpack_from(order + kind, head, 44)[0] for order in orders)
    return (step / read, other / step) if step else (1.0, math.nan)


# ---- behind the last frame


def left_over(trajectory: Any) -> str | None:
    """Describe data after the last frame that MDAnalysis reads. None if there are no data.

    For text formats, this call moves the MDAnalysis reader to its last frame.
    """
    path = file_of(trajectory)
    if path is None or not path.is_file():
        return None
    words = formats_of(trajectory)
    if "DCD" in words:
        rest, frame = _behind_dcd(path, int(trajectory.n_frames))
    elif (file := opened(trajectory)) is not None:
        with closing(file):
            try:
                if not file.ends_at(count := int(trajectory.n_frames)):
                    file.check(count)
                    return _STALE
            except ValueError as error:
                return str(error)
        return None
    elif "NCDF" in words:
        # a run that was killed has not always come to saying in the head what it wrote
        head = netcdf_of(path)
        rest, frame = (head.rest, head.record) if head is not None else (0, 0)
    elif found := _text(trajectory):
        if trajectory.ts.frame != trajectory.n_frames - 1:
            trajectory[trajectory.n_frames - 1]
        return _behind_text(getattr(trajectory, _LINES[found[1]], None))
    else:
        return None
    if rest <= 0:
        return None
    if rest < frame:
        return f"the file ends after {rest:,} bytes of it"
    if "NCDF" in words:
        return f"the file goes on for {rest // frame:,} frames more than its head tells of"
    return f"the {rest:,} bytes behind the frame before are no frame"


def _behind_dcd(path: Path, frames: int) -> tuple[int, int]:
    """Return the sizes (bytes) of the data after the last DCD frame and of one frame."""
    from MDAnalysis.lib.formats.libdcd import DCDFile

    with DCDFile(str(path)) as file:
        sizes = [getattr(file, name, None) for name in ("_header_size", "_firstframesize", "_framesize")]
    if None in sizes:
        # another release of MDAnalysis keeps them elsewhere
        return 0, 0
    head, first, other = (int(one) for one in sizes if one is not None)
    return path.stat().st_size - head - first - (frames - 1) * other, other


def _behind_text(file: Any) -> str | None:
    """Describe lines after the last frame of a text file, except blank lines. None if there are no lines."""
    if file is None or file.closed:
        return None
    lines = 0
    try:
        for number, line in enumerate(file):
            lines = number + 1 if line.strip() else lines
    except (OSError, EOFError, ValueError):
        return None
    return f"the file ends after {lines:,} lines of it" if lines else None


def _last_bytes(path: Path) -> tuple[bytes, int]:
    """Return the last bytes and the size of a file. A compressed file is decompressed."""
    from MDAnalysis.lib.util import anyopen

    packed = path.suffix in (".gz", ".bz2")
    last, size = b"", 0 if packed else max(path.stat().st_size - _LAST_BYTES, 0)
    opened_file: Any = anyopen(str(path), "rb")
    with opened_file as file:
        file.seek(size)
        while part := file.read(_PART):
            last, size = (last + part)[-_LAST_BYTES:], size + len(part)
    return last, size


def _text(trajectory: Any) -> tuple[Path, str] | None:
    """Return (path, format) if MDAnalysis reads the file as lines of text, else None."""
    path, word = file_of(trajectory), next((one for one in formats_of(trajectory) if one in _LINES), None)
    return None if word is None or path is None else (path, word)


# ---- Amber's NetCDF


class NetcdfFile(netcdf_file):
    """A classic NetCDF file. Complete records can be read even if the header is wrong."""

    # where the first record begins, bytes
    _begin = sys.maxsize

    def _read_var(self) -> Any:
        found: Any = super()._read_var()
        if found[2][:1] == (None,):
            self._begin = min(self._begin, int(found[-2]))
        return found

    @property
    def record(self) -> int:
        """Size of a record in bytes; 0 if the file has no records."""
        return int(vars(self)["_recsize"])

    @property
    def told(self) -> int:
        """Number of records in the header. -1 if the number was never set."""
        return int(vars(self)["_recs"])

    @property
    def whole(self) -> int:
        """Number of complete records in the file."""
        room = max(self._behind, 0) // self.record
        return room if self.told < 0 else min(room, self.told)

    # what scipy reads
    _recs = whole

    @property
    def rest(self) -> int:
        """Number of bytes after the last complete record."""
        return self._behind - self.whole * self.record

    @property
    def _behind(self) -> int:
        return Path(self.filename).stat().st_size - self._begin


def netcdf_of(path: str | Path) -> NetcdfFile | None:
    """Open a classic NetCDF file. Return None for other formats or a truncated header."""
    try:
        file = NetcdfFile(str(path))
    except (OSError, TypeError, ValueError, KeyError, IndexError):
        return None
    # arrays keep what they need of it
    file._mm_buf = None
    return file if file.record else None


class NetcdfTrajectory(Trajectory):
    """Trajectory from an Amber NetCDF file with missing records, in Å and ps."""

    format = "NCDF"

    def __init__(self, path: Path, topology: Topology | None, frames: slice):
        super().__init__(path, topology, frames)
        file = netcdf_of(path)
        atoms = 0 if file is None else file.dimensions.get("atom")
        if file is None or "coordinates" not in file.variables or not atoms:
            raise self._refused("the file is not an Amber NetCDF file, or ends within its header")
        self._file, self._count = file, file.whole + 1
        if not file.whole:
            raise self._unreadable(0, self._ends)
        self.bits = 8 * file.variables["coordinates"].itemsize()
        self.time = "ps" if "time" in file.variables else "frame"
        self.has_atoms(atoms)
        self.notes = self.table.notes

    @contextmanager
    def raw_frames(self) -> Iterator[Callable[[int], dict[str, np.ndarray]]]:
        names = {"coordinates", "velocities", "time", "cell_lengths", "cell_angles"}
        variables = {name: one for name, one in self._file.variables.items() if name in names and one.isrec}

        def get(number: int) -> dict[str, np.ndarray]:
            if number >= self._file.whole:
                raise ValueError(self._ends)
            return {name: _scaled(one, number) for name, one in variables.items()}

        yield get

    @property
    def _ends(self) -> str:
        return f"the file ends within this frame; its header announces {max(self._file.told, 0):,} frames"

    def decoded(self, number: int, raw: dict[str, np.ndarray]) -> Frame:
        box, velocities = Box(), raw.get("velocities")
        if {"cell_lengths", "cell_angles"} <= set(raw):
            box = box_of(np.concatenate([raw["cell_lengths"], raw["cell_angles"]]).astype(np.float32))
        velocities = None if velocities is None else velocities.astype(np.float64)
        time, x = float(raw.get("time", number)), raw["coordinates"].astype(np.float64)
        return Frame(number, time, x, box, velocities)


def _scaled(variable: Any, number: int) -> np.ndarray:
    """Return the value of a NetCDF variable in a record, times its scale factor."""
    values, scale = np.array(variable[number]), getattr(variable, "scale_factor", None)
    values = values.astype(values.dtype.newbyteorder("="))
    # rounded once, as MDAnalysis does
    return values if scale is None else (values * np.float64(scale)).astype(values.dtype)
