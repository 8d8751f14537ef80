"""The heads of NetCDF files: how many records there should be, and how many there are.

The libraries that read them take a file with fewer records than its head tells of for no file at all. Classic
format, with 32 or 64 bit offsets (docs.unidata.ucar.edu/netcdf-c, "File Format Specifications").
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

# bytes of each type: byte, char, short, int, float, double
_TYPES = {1: ">i1", 2: "S1", 3: ">i2", 4: ">i4", 5: ">f4", 6: ">f8"}
_OFFSETS = {1: ">I", 2: ">Q"}
# what a writer leaves in the place of the number of records until it knows
_STREAMING = 0xFFFFFFFF
# heads have some kilobytes; no name or attribute is longer
_LONGEST = 1 << 24


@dataclass(frozen=True)
class RecordVariable:
    """A variable with a value in every record.

    Attributes:
        begin: of the first value in the file, bytes.
        dtype: as stored.
        shape: of a value.
        size: of a value, bytes.
        scale: factor that values are meant to be multiplied with; None for none.
    """

    begin: int
    dtype: np.dtype
    shape: tuple[int, ...]
    size: int
    scale: float | None


@dataclass(frozen=True)
class NetcdfHead:
    """What the head of a NetCDF file says.

    Attributes:
        records: how many there should be; None where the writer did not get to say.
        whole: how many there are from beginning to end.
        rest: bytes behind them.
        record: bytes of one.
        atoms: the dimension of that name; 0 without one.
        variables: those with a value in every record, by name.
    """

    records: int | None
    whole: int
    rest: int
    record: int
    atoms: int
    variables: dict[str, RecordVariable] = field(default_factory=dict)

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
    """Elements of a list, whose kind stands before it."""
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
