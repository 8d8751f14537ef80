"""GROMACS's xtc files, read so that a damaged one is an error and not the end of the process.

The library that decodes them divides by zero, or writes where it must not, when bytes are wrong, and all that
was read before is lost with the process. So each frame is looked at first. The compressed stream says how
many bits each atom takes, and walking through it (decoding nothing) tells whether it is one: head, number of
atoms, step sizes and length have to come out. Damage that leaves a stream which could have been written is
not found.

Source: the algorithm of xdr3dfcoord (F. van Hoesel; GROMACS, libxdrfile), of which this is the walk alone.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np

from mdnum.errors import InputError
from mdnum.trajectories.boxes import box_of
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.topology import NARROWED, notes_on
from mdnum.trajectories.trajectory import Trajectory

# magic number, and bytes of the length of the stream: files with more than 2^31 bytes a frame have another
_MAGIC = {1995: 4, 2023: 8}
# magic, atoms, step; time and box as floats; then atoms again
_HEAD = struct.Struct(">3i10fi")
# precision; smallest and largest of three coordinates; first step size
_PACKED = struct.Struct(">f3i3ii")
# up to this many atoms are written as plain floats
_PLAIN = 9
# step sizes in the table that both sides have, the first and the last that a stream may use
_FIRST, _LAST = 9, 72
# a coordinate this wide is written by itself
_WIDE = 0xFFFFFF


def opened(trajectory: Any) -> XtcFile | None:
    """The file behind an MDAnalysis trajectory; None where that is no xtc file."""
    path = getattr(trajectory, "filename", None)
    if trajectory.format != "XTC" or not isinstance(path, str | Path):
        return None
    return XtcFile(path)


class XtcFile:
    """Frames of an xtc file, by number.

    Args:
        path: the file.

    Raises:
        ValueError: by every method, where bytes are not what they have to be or the file ends.
    """

    def __init__(self, path: str | Path):
        self._file = open(path, "rb")  # noqa: SIM115 -- as long as frames are read
        self.path = path
        self._size = Path(path).stat().st_size
        self._starts = [0]
        self._library: Any = None
        self._at = 0

    def close(self) -> None:
        """Closes the file."""
        self._file.close()
        if self._library is not None:
            self._library.close()

    @property
    def atoms(self) -> int:
        """Atoms of the first frame."""
        return self._head(0)[1]

    def whole_frames(self) -> int:
        """Frames up to the end of the file, or to the first whose head is damaged or whose end is missing."""
        number = 0
        try:
            while self._starts[number] < self._size:
                self._start(number + 1)
                number += 1
        except ValueError:
            pass
        return number

    def ends_at(self, number: int) -> bool:
        """Whether the file ends with the frame before this one."""
        return self._start(number) == self._size

    def check(self, number: int) -> None:
        """Looks at a frame without decoding it."""
        self._stream(number, look=True)

    def read(self, number: int) -> Any:
        """A frame as the library decodes it, in nm and ps, once it has been checked."""
        self.check(number)
        if self._library is None:
            from MDAnalysis.lib.formats.libmdaxdr import XTCFile

            self._library = XTCFile(str(self.path))
        if number != self._at:
            # its own search for frames trusts their heads
            self._library.set_offsets(np.array(self._starts[: number + 1], np.int64))
            self._library.seek(number)
        self._at = number + 1
        return self._library.read()

    def _start(self, number: int) -> int:
        while len(self._starts) <= number:
            at = len(self._starts) - 1
            self._stream(at, look=False)
            end = self._file.tell()
            if end > self._size:
                raise ValueError("the file ends in it")
            self._starts.append(end)
        return self._starts[number]

    def _head(self, number: int) -> tuple[Any, ...]:
        self._file.seek(self._start(number))
        head = _HEAD.unpack(self._read(_HEAD.size))
        if head[0] not in _MAGIC or head[1] != head[-1] or head[1] < 0:
            raise ValueError("damaged: no head of a frame where one has to be")
        return head

    def _stream(self, number: int, look: bool) -> None:
        """Goes to the end of a frame, through its compressed coordinates or past them."""
        head = self._head(number)
        atoms = head[1]
        if atoms <= _PLAIN:
            self._read(12 * atoms)
            return
        precision, *limits, small = _PACKED.unpack(self._read(_PACKED.size))
        size = int.from_bytes(self._read(_MAGIC[head[0]]), "big", signed=True)
        if size < 0:
            raise ValueError("damaged: a negative length")
        if not look:
            self._file.seek((size + 3) // 4 * 4, 1)
            return
        sizes = [high - low + 1 for low, high in zip(limits[:3], limits[3:], strict=True)]
        if not _FIRST <= small <= _LAST or min(sizes) <= 0 or not precision > 0:
            raise ValueError("damaged: the head of the compressed coordinates makes no sense")
        product = sizes[0] * sizes[1] * sizes[2]
        wide = max(sizes) > _WIDE
        bits = sum(one.bit_length() for one in sizes) if wide else product.bit_length()
        stream = np.frombuffer(self._read(size), np.uint8)
        self._read(-size % 4)
        if (_walk(stream, atoms, bits, small) + 7) // 8 != size:
            raise ValueError("damaged: the compressed coordinates do not end where their length says")

    def _read(self, count: int) -> bytes:
        data = self._file.read(min(count, self._size + 1))
        if len(data) < count:
            raise ValueError("the file ends in it")
        return data


@numba.njit(cache=True, nogil=True)
def _bits(stream, at, count):
    """The number that `count` bits hold, the first of them the largest."""
    value = 0
    while count > 0:
        free = 8 - (at & 7)
        take = min(free, count)
        part = (np.int64(stream[at >> 3]) >> (free - take)) & ((1 << take) - 1)
        value = (value << take) | part
        at += take
        count -= take
    return value


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
        flag = _bits(stream, at, 1)
        at += 1
        change = 0
        if flag:
            if at + 5 > most:
                return -8
            value = _bits(stream, at, 5)
            at += 5
            run = value - value % 3
            change = value % 3 - 1
        at += run // 3 * small
        done += run // 3
        small += change
        if small < _FIRST or small > _LAST:
            return -8
    return at if done == atoms and at <= most else -8


class XtcTrajectory(Trajectory):
    """An xtc file, in Å and ps. Its coordinates are integers, and float32 by the time they come here."""

    format = "XTC"
    reader = "MDAnalysis"
    bits = 32
    time = "ps"

    def __init__(self, path: Path, topology: str | Path | None, frames: slice):
        super().__init__(path, topology, frames)
        file = XtcFile(path)
        try:
            atoms = file.atoms
        except ValueError as error:
            raise InputError(
                f"it is no xtc file, or a damaged one ({error})",
                remedy="Check that the file is whole and of the kind its name says",
                where=str(path),
            ) from None
        whole = file.whole_frames()
        # a frame that is cut is one to read
        self._count = whole + (not file.ends_at(whole))
        file.close()
        self._has(atoms)
        self.notes = (NARROWED, *notes_on(self.table))

    def _raw(self, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
        file = XtcFile(self.path)
        try:
            for number in numbers:
                try:
                    found = file.read(number)
                except self._fails as error:
                    raise self._unreadable(number, error) from error
                yield number, found
        finally:
            file.close()

    def _frame(self, number: int, raw: Any) -> Frame:
        # in Å by the operations that MDAnalysis makes, so that both see the same numbers
        from MDAnalysis.lib.mdamath import triclinic_box

        ten = np.float32(10)
        dimensions: Any = triclinic_box(*raw.box)
        dimensions[:3] *= ten
        return Frame(number, float(raw.time), (np.array(raw.x) * ten).astype(np.float64), box_of(dimensions))
