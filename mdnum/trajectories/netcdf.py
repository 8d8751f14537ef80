"""Amber's NetCDF files that end early, read up to where they do: what a run that was killed has left.

The libraries that read them take a file with fewer records than its head names for no file at all. Classic
format, with 32 or 64 bit offsets (docs.unidata.ucar.edu/netcdf-c, "File Format Specifications"); frames as
MDAnalysis hands over those of whole files (ambermd.org/netcdf/nctraj.xhtml).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mdnum.errors import InputError
from mdnum.trajectories.boxes import box_of
from mdnum.trajectories.frame import Box, Frame, UnreadableFrame
from mdnum.trajectories.topology import notes_on
from mdnum.trajectories.trajectory import Trajectory

# bytes of each type: byte, char, short, int, float, double
_TYPES = {1: ">i1", 2: "S1", 3: ">i2", 4: ">i4", 5: ">f4", 6: ">f8"}
_OFFSETS = {1: ">I", 2: ">Q"}
# what a writer leaves in the place of the number of records until it knows
_STREAMING = 0xFFFFFFFF
# heads have some kilobytes; no name or attribute is longer
_LONGEST = 1 << 24


class RecordVariable(NamedTuple):
    """A variable with a value in every record."""

    begin: int  # of the first value in the file, bytes
    dtype: np.dtype  # of a value, as stored
    shape: tuple[int, ...]
    size: int  # of a value, bytes
    scale: float | None  # factor that values are meant to be multiplied with; None for none


@dataclass(frozen=True)
class NetcdfHead:
    """What the head of a NetCDF file says."""

    records: int | None  # how many there should be; None where the writer did not get to say
    whole: int  # how many there are from beginning to end
    rest: int  # bytes behind them
    record: int  # bytes of one
    atoms: int  # the dimension of that name; 0 without one
    variables: dict[str, RecordVariable]  # those with a value in every record, by name

    @property
    def cut(self) -> bool:
        """Whether the file ends before its head says."""
        return self.records is not None and self.whole < self.records


def head_of(path: str | Path) -> NetcdfHead | None:
    """The head of a NetCDF file in classic format; None for another file, or where the head itself is cut."""
    try:
        with Path(path).open("rb") as file:
            return _head(file, Path(path).stat().st_size)
    except (OSError, struct.error, ValueError, KeyError, IndexError, UnicodeDecodeError):
        return None


def _head(file: BufferedReader, size: int) -> NetcdfHead | None:
    magic = file.read(4)
    if magic[:3] != b"CDF" or magic[3] not in _OFFSETS:
        return None
    records = _number(file)
    dimensions = [(_word(file), _number(file)) for _ in range(_count(file))]
    _attributes(file)
    variables, sizes = {}, []
    for _ in range(_count(file)):
        name = _word(file)
        of = [dimensions[_number(file)] for _ in range(_number(file))]
        scale = _attributes(file).get("scale_factor")
        dtype = np.dtype(_TYPES[_number(file)])
        # its size is told too, rounded up; too large a one is told wrong
        _number(file)
        (begin,) = struct.unpack(_OFFSETS[magic[3]], file.read(struct.calcsize(_OFFSETS[magic[3]])))
        # the dimension without a length is that of the records
        if of and of[0][1] == 0:
            shape = tuple(length for _, length in of[1:])
            bytes_of_it = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
            scale = None if scale is None else float(scale[0])
            variables[name] = RecordVariable(begin, dtype, shape, bytes_of_it, scale)
            sizes.append(bytes_of_it)
    if not variables:
        return None
    # each begins at a multiple of four, unless it is the only one
    record = sizes[0] if len(sizes) == 1 else sum(-(-one // 4) * 4 for one in sizes)
    there = size - min(one.begin for one in variables.values())
    told = None if records == _STREAMING else records
    whole = max(there, 0) // record if told is None else min(max(there, 0) // record, told)
    atoms = next((length for name, length in dimensions if name == "atom"), 0)
    return NetcdfHead(told, whole, there - whole * record, record, atoms, variables)


def _number(file: BufferedReader) -> int:
    return struct.unpack(">I", file.read(4))[0]


def _count(file: BufferedReader) -> int:
    """Elements of a list, behind its kind."""
    _number(file)
    return _number(file)


def _word(file: BufferedReader) -> str:
    length = _number(file)
    if length > _LONGEST:
        raise ValueError("no name is as long")
    return file.read(-(-length // 4) * 4)[:length].decode()


def _attributes(file: BufferedReader) -> dict[str, Any]:
    found = {}
    for _ in range(_count(file)):
        name, dtype = _word(file), np.dtype(_TYPES[_number(file)])
        size = _number(file) * dtype.itemsize
        if size > _LONGEST:
            raise ValueError("no attribute is as long")
        found[name] = np.frombuffer(file.read(-(-size // 4) * 4)[:size], dtype)
    return found


class NetcdfTrajectory(Trajectory):
    """An Amber NetCDF file that ends early, in Å and ps."""

    format = "NCDF"

    def __init__(self, path: Path, topology: str | Path | None, frames: slice):
        super().__init__(path, topology, frames)
        head = head_of(path)
        if head is None or "coordinates" not in head.variables or not head.atoms:
            raise InputError(
                "it is no Amber NetCDF file, or one that ends in its head",
                remedy="Check that the file is whole and of the kind its name says",
                where=str(path),
            )
        self._head, self._count = head, head.whole + 1
        if not head.whole:
            raise self._ends(0)
        self.bits = 8 * head.variables["coordinates"].dtype.itemsize
        self.time = "ps" if "time" in head.variables else "frame"
        self._has(head.atoms)
        self.notes = notes_on(self.table)

    def _raw(self, numbers: Iterator[int]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        names = ("coordinates", "velocities", "time", "cell_lengths", "cell_angles")
        with self.path.open("rb") as file:
            for number in numbers:
                if number >= self._head.whole:
                    raise self._ends(number)
                variables = {name: self._head.variables.get(name) for name in names}
                yield (
                    number,
                    {
                        name: self._value(file, one, number)
                        for name, one in variables.items()
                        if one is not None
                    },
                )

    def _ends(self, number: int) -> UnreadableFrame:
        count = self._head.records or 0
        return self._unreadable(number, f"the file ends in it, and its head tells of {count:,} frames")

    def _frame(self, number: int, raw: dict[str, np.ndarray]) -> Frame:
        box = Box()
        if {"cell_lengths", "cell_angles"} <= set(raw):
            box = box_of(np.concatenate([raw["cell_lengths"], raw["cell_angles"]]).astype(np.float32))
        return Frame(
            index=number,
            time=float(raw["time"]) if "time" in raw else float(number),
            positions=raw["coordinates"].astype(np.float64),
            box=box,
            velocities=raw["velocities"].astype(np.float64) if "velocities" in raw else None,
        )

    def _value(self, file: BufferedReader, one: RecordVariable, number: int) -> np.ndarray:
        file.seek(one.begin + number * self._head.record)
        values = np.frombuffer(file.read(one.size), one.dtype).reshape(one.shape)
        values = values.astype(one.dtype.newbyteorder("="))
        # rounded once, as MDAnalysis does
        return values if one.scale is None else (values * np.float64(one.scale)).astype(values.dtype)
