"""Detection of frames that repeat earlier frames, for example after a restart.

A restarted run writes some frames again. Concatenated files may share frames. A stopped simulation or a
rejected Monte Carlo move repeats the previous frame. After a restart with different rounding, times repeat
but data differ. The first frame with each time is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any
from zlib import crc32

import numpy as np

from mdnum.trajectories.frame import Frame

# atoms that are digested one by one, for speed; a checksum stands for all
_ATOMS = 1000
# fractions of the box that are the same place: far above the rounding of float64, far below any motion
_SAME = 1e-8


def digest(frame: Frame) -> bytes:
    """Return sixteen bytes that are equal for frames with identical positions and boxes."""
    x = np.ascontiguousarray(frame.positions)
    parts = (x[:: max(1, len(x) // _ATOMS)], np.array(crc32(x.data)), frame.box.matrix, frame.box.pbc)
    return blake2b(b"".join(part.tobytes() for part in parts), digest_size=16).digest()


@dataclass
class RepeatedFrames:
    """Record of repeated frames, from one stored digest per distinct frame.

    Attributes:
        drop: whether to omit repeated frames from the frames that are yielded.
        most: largest number of digests stored; the oldest digests are deleted.
        frames: number of repeated frames.
        again: ranges of frames that repeat times but not data, with numbers as in `stretches`, the first and
            the last time (time, to), and the number of frames (frames).
        stretches: ranges of consecutive frames that repeat consecutive frames: frame numbers (first, last,
            of_first, of_last), and whether all frames of the range repeat a single frame (still).
    """

    drop: bool = False
    most: float = math.inf
    frames: int = 0
    stretches: list[dict[str, Any]] = field(default_factory=list)
    # (place, number) of each frame known, and how far back the last one was found; 0 where it is new
    _known: dict[bytes, tuple[int, int]] = field(default_factory=dict)
    _place = _back = 0
    again: list[dict[str, Any]] = field(default_factory=list)
    # digests (cells, frame) by that of the fractions of the box
    _wrapped: dict[bytes, tuple[bytes, bytes]] = field(default_factory=dict)
    # numbers of frames by time, and the place of the last one whose time was there
    _times: dict[str, int] = field(default_factory=dict)
    _had = 0

    def __call__(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames; omit repeated frames if `drop` is true."""
        for frame in frames:
            every: list[dict[Any, Any]] = [self._known, self._wrapped, self._times]
            for held in every:
                if len(held) > self.most:
                    del held[next(iter(held))]
            if not (
                self.see(frame.index, self._digest(frame)) | self.had(frame.index, frame.time) and self.drop
            ):
                yield frame

    def _digest(self, frame: Frame) -> bytes:
        """Return the digest of a frame, or of an earlier frame that differs only by wrapping."""
        digested, box = digest(frame), frame.box
        if not box.pbc.all() or not np.linalg.det(box.matrix):
            return digested
        x = frame.positions[:: max(1, len(frame.positions) // _ATOMS)]
        places = np.rint(x @ np.linalg.inv(box.matrix) / _SAME)
        # the same as np.divmod, which takes four times as long
        cells = np.floor(places * _SAME + 0.5 * _SAME)
        rest = (places - cells / _SAME).astype(np.int32)
        key, mine = (blake2b(one.tobytes(), digest_size=16).digest() for one in (rest, cells + 0.0))
        before, known = self._wrapped.setdefault(key + box.matrix.tobytes(), (mine, digested))
        return digested if before == mine else known

    def had(self, number: int, time: float) -> bool:
        """Return True if an earlier frame has the same time. False if all times are equal."""
        of = self._times.setdefault(f"{time:.12g}", number)
        if of == number or len(self._times) < 2:
            return False
        if not self._back:
            if not self.again or self._had < self._place - 1:
                self.again.append({"first": number, "of_first": of, "time": time, "frames": 0})
            last, self._had = self.again[-1], self._place
            last |= {"last": number, "of_last": of, "to": time, "frames": last["frames"] + 1}
        return True

    def see(self, number: int, digested: bytes) -> bool:
        """Return True if the next frame repeats an earlier frame."""
        # of several that are the same the last one counts, so that no motion is a repeat of the frame before
        place, of = self._known.get(digested, (self._place, number))
        self._known[digested] = self._place, number
        back, before = self._place - place, self._back
        self._place, self._back = self._place + 1, back
        if back and back == before:
            self.stretches[-1] |= {"last": number} | ({} if back == 1 else {"of_last": of})
        elif back:
            ends = {"first": number, "last": number, "of_first": of, "of_last": of}
            self.stretches.append(ends | {"still": back == 1})
        self.frames += back > 0
        return back > 0

    def plain(self, most: int = 100) -> dict[str, Any]:
        """Return the record as plain values, with up to `most` ranges of frames per list."""
        sizes = {"frames": self.frames, "stretches": len(self.stretches), "to_the_end": self._back > 0}
        return sizes | {"dropped": self.drop, "ranges": self.stretches[:most], "again": self.again[:most]}
