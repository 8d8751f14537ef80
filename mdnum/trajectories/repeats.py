"""Frames that repeat earlier ones bit for bit: an overlap at a restart, a copied stretch, no motion at all.

A run that continues from a checkpoint writes some frames again, joined files have frames in common, and a
simulation that stopped, or a rejected Monte Carlo move, leaves the frame before. Times do not always tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any
from zlib import crc32

import numpy as np

from mdnum.trajectories.frame import Frame

# atoms that are digested one by one, for speed; a checksum stands for all
_ATOMS = 1000


def digest(frame: Frame) -> bytes:
    """Sixteen bytes that two frames share if their positions and boxes are the same bit for bit."""
    x = np.ascontiguousarray(frame.positions)
    parts = (x[:: max(1, len(x) // _ATOMS)], np.array(crc32(x.data)), frame.box.matrix, frame.box.pbc)
    return blake2b(b"".join(part.tobytes() for part in parts), digest_size=16).digest()


@dataclass
class Repeats:
    """Which frames repeat earlier ones. Memory: a digest for each frame that differs from all before.

    Attributes:
        drop: leave them out when frames are passed on.
        frames: how many there are.
        stretches: of consecutive ones that repeat consecutive ones: numbers in the file (first, last,
            of_first, of_last), and whether that is one frame without motion (still).
    """

    drop: bool = False
    frames: int = 0
    stretches: list[dict[str, Any]] = field(default_factory=list)
    # (place, number) of each frame known, and how far back the last one was found; 0 where it is new
    _known: dict[bytes, tuple[int, int]] = field(default_factory=dict)
    _place = _back = 0

    def __call__(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Passes frames on, without those that repeat others if they are to be left out."""
        for frame in frames:
            if not (self.see(frame.index, digest(frame)) and self.drop):
                yield frame

    def see(self, number: int, digested: bytes) -> bool:
        """Whether the next frame, of this number in the file, repeats an earlier one."""
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
        """As plain values, with so many of the stretches."""
        sizes = {"frames": self.frames, "stretches": len(self.stretches), "to_the_end": self._back > 0}
        return sizes | {"dropped": self.drop, "ranges": self.stretches[:most]}
