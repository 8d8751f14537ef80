"""Whether a frame of an xtc file can be decompressed: a damaged one makes the library divide by zero.

That ends the whole process, and with it everything that was read before. The compressed stream says how many
bits each atom takes, so that walking through it (and decoding nothing) tells whether it is one: the number of
atoms, the table of step sizes and the length must come out. Garbage that happens to be a stream is not found.

Source: the algorithm of xdr3dfcoord (F. van Hoesel, GROMACS; libxdrfile), written anew.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numba
import numpy as np

_MAGIC = {1995: 4, 2023: 8}
# magic, atoms, step; time and box as floats; then atoms again
_HEAD = struct.Struct(">3i10fi")
# precision; smallest and largest of three coordinates; first step size
_PACKED = struct.Struct(">f3i3ii")
# up to this many atoms are written as plain floats
_PLAIN = 9
# step sizes that the table has
_FIRST, _LAST = 9, 72
_WIDE = 0xFFFFFF


def guard_of(trajectory: Any) -> XtcGuard | None:
    """For an MDAnalysis trajectory; None where it is not of one xtc file."""
    path = getattr(trajectory, "filename", None)
    if trajectory.format != "XTC" or not isinstance(path, str | Path):
        return None
    return XtcGuard(path)


class XtcGuard:
    """Looks at the frames of an xtc file before the library does.

    Args:
        path: the file.
    """

    def __init__(self, path: str | Path):
        self._file = open(path, "rb")  # noqa: SIM115 -- as long as frames are read
        self._starts = [0]

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def check(self, number: int) -> None:
        """Looks at one frame.

        Raises:
            ValueError: it cannot be decompressed, or the file ends before it.
        """
        while len(self._starts) <= number:
            self._starts.append(self._end(len(self._starts) - 1, look=False))
        self._end(number, look=True)

    def _end(self, number: int, look: bool) -> int:
        """Where the next frame begins."""
        start = self._starts[number]
        self._file.seek(start)
        magic, atoms, *_, again = _HEAD.unpack(self._read(_HEAD.size))
        if magic not in _MAGIC or atoms != again or atoms < 0:
            raise ValueError("damaged: no head of a frame where one must be")
        if atoms <= _PLAIN:
            return start + _HEAD.size + 12 * atoms
        _, *limits, small = _PACKED.unpack(self._read(_PACKED.size))
        width = _MAGIC[magic]
        size = int.from_bytes(self._read(width), "big", signed=True)
        begin = start + _HEAD.size + _PACKED.size + width
        if size < 0:
            raise ValueError("damaged: a negative length")
        if look:
            sizes = [high - low + 1 for low, high in zip(limits[:3], limits[3:], strict=True)]
            if not _FIRST <= small <= _LAST or min(sizes) <= 0:
                raise ValueError("damaged: the head of the compressed coordinates makes no sense")
            # large boxes have their coordinates one by one
            whole = sizes[0] * sizes[1] * sizes[2]
            bits = sum(one.bit_length() for one in sizes) if max(sizes) > _WIDE else whole.bit_length()
            stream = np.frombuffer(self._read(size), np.uint8)
            if (_walk(stream, atoms, bits, small) + 7) // 8 != size:
                raise ValueError("damaged: the compressed coordinates end elsewhere than their length says")
        return begin + (size + 3) // 4 * 4

    def _read(self, count: int) -> bytes:
        data = self._file.read(count)
        if len(data) < count:
            raise ValueError("the file ends in it")
        return data


@numba.njit(cache=True, nogil=True)
def _walk(stream, atoms, whole, small):
    """Bits that the coordinates of so many atoms take; -8 where the stream is none.

    An atom takes `whole` bits, and after it comes a flag; where it is set, five bits that say how many atoms
    follow as differences of `small` bits each, and whether `small` changes.
    """
    at, done, run = 0, 0, 0
    most = 8 * stream.shape[0]
    while done < atoms:
        at += whole
        done += 1
        if at >= most:
            return -8
        flag = (stream[at >> 3] >> (7 - (at & 7))) & 1
        at += 1
        change = 0
        if flag:
            if at + 5 > most:
                return -8
            value = 0
            for k in range(at, at + 5):
                value = 2 * value + ((stream[k >> 3] >> (7 - (k & 7))) & 1)
            at += 5
            run = value - value % 3
            change = value % 3 - 1
        at += run // 3 * small
        done += run // 3
        small += change
        if small < _FIRST or small > _LAST:
            return -8
    return at if done == atoms and at <= most else -8
