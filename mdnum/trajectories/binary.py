"""Readers of GROMACS's xtc and trr files. Each frame is checked before it is decoded.

On damaged data, the xtc library may divide by zero or write outside its buffers. The process then crashes,
and all earlier results are lost. The compressed stream contains the number of bits of each atom's
coordinates. The header, the number of atoms, the bit counts and the length are verified without decoding.
File damage that leaves a valid stream is not detected. Source of the xtc format: the algorithm of xdr3dfcoord
(F. van Hoesel; GROMACS, libxdrfile).

MDAnalysis's readers of xtc and trr keep an index file next to the trajectory. MDAnalysis may use an index
file of another trajectory. MDAnalysis may write the index through symbolic links. This module uses no index
file. Source of the trr format: GROMACS, trrio.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.compiled import njit
from mdnum.reading import reading
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.topology import NARROWED, Topology, box_of, file_of
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

# of trr: magic, length of the word with its end, length of the word, the word; the bytes of ten blocks, of
# which the third is the box and the last three are positions, velocities and forces; atoms, step and one more
_TRR, _TRR_BEGIN = struct.Struct(">3i12s13i"), (1993, b"GMX_trn_file")
_BOX, _X = 2, 7
# nm to Å
_TEN = np.float32(10)


def opened(trajectory: Any) -> XdrFile | None:
    """Open the xtc or trr file of an MDAnalysis trajectory. None for other formats."""
    path, kind = file_of(trajectory), {"XTC": XtcFile, "TRR": TrrFile}.get(str(trajectory.format))
    return None if kind is None or path is None else kind(path)


class XdrFile:
    """Reader of the frames of a GROMACS file by number, without an index file.

    Raises:
        ValueError: the data are invalid or the file ends early (raised by every method).
    """

    def __init__(self, path: str | Path):
        self._file = open(path, "rb")  # noqa: SIM115 -- as long as frames are read
        self.path = path
        self._size = Path(path).stat().st_size
        self._starts = [0]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def whole_frames(self) -> int:
        """Return the number of complete frames before the end of the file or a damaged header."""
        number = 0
        try:
            while self._starts[number] < self._size:
                self.start(number + 1)
                number += 1
        except ValueError:
            pass
        return number

    def ends_at(self, number: int) -> bool:
        """Return True if the file ends where the given frame would begin."""
        return self.start(number) == self._size

    def start(self, number: int) -> int:
        """Return the byte offset at which a frame begins."""
        while len(self._starts) <= number:
            at = len(self._starts) - 1
            self._stream(at)
            end = self._file.tell()
            if end > self._size:
                raise ValueError("the file ends within a frame")
            self._starts.append(end)
        return self._starts[number]

    def check(self, number: int) -> None:
        """Check a frame without decoding it."""
        self.start(number + 1)

    def _stream(self, number: int, look: bool = False) -> None:
        """Move the file position to the end of a frame. If `look` is true, also verify the coordinates."""
        raise NotImplementedError

    def _read(self, count: int) -> bytes:
        data = self._file.read(min(count, self._size + 1))
        if len(data) < count:
            raise ValueError("the file ends within a frame")
        return data


class XtcFile(XdrFile):
    """Reader of the frames of an xtc file."""

    bits = 32

    def __init__(self, path: str | Path):
        super().__init__(path)
        self._library: Any = None
        self._at = 0

    def close(self) -> None:
        """Close the file."""
        super().close()
        if self._library is not None:
            self._library.close()

    @property
    def atoms(self) -> int:
        """Number of atoms in the first frame."""
        return self._head(0)[1]

    def check(self, number: int) -> None:
        """Check a frame without decoding it."""
        self._stream(number, look=True)
        if len(self._starts) == number + 1:
            self._starts.append(self._file.tell())

    def read(self, number: int) -> Any:
        """Check a frame. Return the frame as decoded by MDAnalysis's library, in nm and ps."""
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

    def _head(self, number: int) -> tuple[Any, ...]:
        self._file.seek(self.start(number))
        head = _HEAD.unpack(self._read(_HEAD.size))
        if head[0] not in _MAGIC or head[1] != head[-1] or head[1] < 0:
            raise ValueError("the file is damaged: the header of a frame is missing")
        return head

    def _stream(self, number: int, look: bool = False) -> None:
        head = self._head(number)
        atoms = head[1]
        if atoms <= _PLAIN:
            self._read(12 * atoms)
            return
        precision, *limits, small = _PACKED.unpack(self._read(_PACKED.size))
        size = int.from_bytes(self._read(_MAGIC[head[0]]), "big", signed=True)
        if size < 0:
            raise ValueError("the file is damaged: a stated length is negative")
        if not look:
            self._file.seek((size + 3) // 4 * 4, 1)
            return
        sizes = [high - low + 1 for low, high in zip(limits[:3], limits[3:], strict=True)]
        if not _FIRST <= small <= _LAST or min(sizes) <= 0 or not precision > 0:
            raise ValueError("the file is damaged: the header of the compressed coordinates is not valid")
        product = sizes[0] * sizes[1] * sizes[2]
        wide = max(sizes) > _WIDE
        bits = sum(one.bit_length() for one in sizes) if wide else product.bit_length()
        stream = np.frombuffer(self._read(size), np.uint8)
        self._read(-size % 4)
        if (_walk(stream, atoms, bits, small) + 7) // 8 != size:
            raise ValueError("the file is damaged: the coordinates do not have the stated length")


@njit
def _walk(stream, atoms, whole, small):
    """Return the number of bits of all coordinates, or -8 if the stream is invalid.

    The full coordinates of an atom occupy `whole` bits. A flag bit follows. If the flag is set, five bits
    follow. They contain the change of `small`, and the number of next atoms that are stored as differences
    of `small` bits.
    """
    at, done, run = 0, 0, 0
    most = 8 * stream.shape[0]
    while done < atoms:
        at += whole
        done += 1
        if at >= most:
            return -8
        # the flag and the five bits behind it, which lie in two bytes
        place = at >> 3
        pair = np.int64(stream[place]) << 8
        if place + 1 < stream.shape[0]:
            pair |= np.int64(stream[place + 1])
        value = pair >> (10 - (at & 7)) & 0x3F
        at += 1
        change = 0
        if value & 0x20:
            at += 5
            if at > most:
                return -8
            value &= 0x1F
            run = value - value % 3
            change = value % 3 - 1
        at += run // 3 * small
        done += run // 3
        small += change
        if small < _FIRST or small > _LAST:
            return -8
    return at if done == atoms and at <= most else -8


class TrrFile(XdrFile):
    """Reader of the frames of a trr file, in float32 or float64."""

    @property
    def atoms(self) -> int:
        """Number of atoms in the first frame."""
        return self.head(0)[0]

    @property
    def bits(self) -> int:
        """Width of the floating-point numbers in the file, in bits."""
        return 8 * self.head(0)[1]

    def head(self, number: int) -> tuple[int, int, list[int]]:
        """Read a frame header up to the time. Return (atoms, bytes per number, sizes of the data blocks)."""
        self._file.seek(self.start(number))
        magic, _, _, word, *numbers = _TRR.unpack(self._read(_TRR.size))
        sizes, atoms, box = numbers[:10], numbers[10], numbers[_BOX]
        # nine numbers of a box, or three an atom, are of one width, and so are the time and lambda
        vectors = [size for size in sizes[_X:] if size]
        width = box // 9 if box else max(vectors, default=0) // max(3 * atoms, 1)
        fits = all(size == 3 * width * atoms for size in vectors) and box in (0, 9 * width)
        if (magic, word) != _TRR_BEGIN or width not in (4, 8) or not fits or min(sizes) < 0:
            raise ValueError("the file is damaged: the header of a frame is missing")
        return atoms, width, sizes

    def has_box(self, number: int) -> bool:
        """Return True if the frame contains box vectors."""
        return self.head(number)[2][_BOX] > 0

    def _stream(self, number: int, look: bool = False) -> None:
        _, width, sizes = self.head(number)
        self._file.seek(2 * width + sum(sizes), 1)

    def read(self, number: int) -> tuple[float, Any, np.ndarray, Any]:
        """Return (time, box or None, positions, velocities or None) of a frame, in nm and ps."""
        _, width, sizes = self.head(number)
        time, *blocks = [np.frombuffer(self._read(size), f">f{width}") for size in (2 * width, *sizes)]
        box, x, v = (
            blocks[k].reshape(-1, 3).astype(f"f{width}") if sizes[k] else None for k in (_BOX, _X, _X + 1)
        )
        if x is None:
            raise ValueError("the frame has no positions")
        return float(time[0]), box, x, v


class XtcTrajectory(Trajectory):
    """An xtc trajectory in Å and ps. Integer coordinates are decoded to float32."""

    format = "XTC"
    reader = "MDAnalysis"
    time = "ps"
    notes = (NARROWED,)
    _file: type[Any] = XtcFile

    def __init__(self, path: Path, topology: Topology | None, frames: slice):
        super().__init__(path, topology, frames)
        with reading(path, by="mdnum"), closing(self._file(path)) as file:
            atoms, self.bits = file.atoms, file.bits
            whole = file.whole_frames()
            # a frame that is cut is one to read
            self._count = whole + (not file.ends_at(whole))
        self.has_atoms(atoms)
        # of the last frame, which has the same box as the next in most files
        self._box = b"", Box()
        self.notes = (*self.notes, *self.table.notes)

    @contextmanager
    def raw_frames(self) -> Iterator[Callable[[int], Any]]:
        with closing(self._file(self.path)) as file:
            yield file.read

    def decoded(self, number: int, raw: Any) -> Frame:
        return Frame(number, float(raw.time), (raw.x * _TEN).astype(np.float64), self._box_of(raw.box))

    def _box_of(self, vectors: np.ndarray) -> Box:
        # in Å by the operations that MDAnalysis makes, so that both see the same numbers
        from MDAnalysis.lib.mdamath import triclinic_box

        known, box = self._box
        if (read := vectors.tobytes()) != known:
            dimensions: Any = triclinic_box(*vectors)
            dimensions[:3] *= _TEN
            box = box_of(dimensions)
            self._box = read, box
        return box


class TrrTrajectory(XtcTrajectory):
    """A trr trajectory, in Å and ps."""

    format = "TRR"
    reader = "mdnum"
    notes = ()
    _file = TrrFile

    def decoded(self, number: int, raw: Any) -> Frame:
        time, vectors, x, v = raw
        box, ten = Box(), x.dtype.type(10)
        if vectors is not None and vectors.any():
            box = self._box_of(vectors) if self.bits == 32 else Box(vectors * ten, np.ones(3, bool))
        v = None if v is None else (v * ten).astype(np.float64)
        return Frame(number, time, (x * ten).astype(np.float64), box, v)
