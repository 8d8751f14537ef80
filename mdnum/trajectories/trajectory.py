"""Base class of all trajectory readers. Readers provide frames and properties of atoms.

Positions are those of the file, without wrapping, unwrapping or centering. The readers of ASE and mdnum (gro,
LAMMPS's text dumps) keep every digit. The readers of MDAnalysis reduce coordinates to float32
(`Trajectory.bits`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.reading import CHECK, FrameError, UnreadableFrame, check_claim, reading
from mdnum.trajectories.frame import Box, Frame, FrameCheck
from mdnum.trajectories.repeats import RepeatedFrames
from mdnum.trajectories.topology import AtomTable, Topology

#: Number of frames from which the resolution of a file is determined.
SAMPLE = 8


class Trajectory(ABC):
    """Frames of one file, which can be read any number of times in order.

    A subclass defines `has_atoms`, `raw_frames` and `decoded`. An exception in these methods is reported as
    an unreadable frame.

    Args:
        path: the trajectory file.
        topology: the file that identifies the atoms, if not the trajectory file.
        slice: the requested frames.
    """

    format: str  # the file's format in the reader's word ("XTC", "extxyz")
    in_memory = False  # whether a program gives the frames, and no file
    reader: str = "mdnum"  # who reads it: "MDAnalysis", "ASE", "mdnum"
    bits: int = 64  # width of a coordinate as the reader gives it, 32 or 64; frames are float64 either way
    length: str = "Å"  # unit in words; "" where the file does not say
    # unit in words; "frame" where the file has no times, whose numbers then stand for them (velocities, if it
    # has any, are per ps there)
    time: str = "frame"
    table: AtomTable  # what is known of the atoms
    notes: tuple[str, ...] = ()  # what a reader of the results should know about the reading, each a sentence
    # frames in the file, where they are known
    _count: int | None = None
    # ids of the atoms in ascending order, where the file has them
    _ids: np.ndarray | None = None
    # whether frames that repeat earlier ones are left out; which did, and what was found of frames, when read
    drop_repeats = False
    remembered = math.inf  # frames with which later ones are compared
    repeats: RepeatedFrames
    check: FrameCheck
    universe: Any = None  # the MDAnalysis Universe behind it, where there is one
    # the time step with its bytes in the other order, over that one, where the file has one
    swapped: float = math.nan

    def __init__(self, path: Path, topology: Topology | None, slice: slice):
        self.path, self.topology, self.slice = path, topology, slice

    def has_atoms(self, atoms: int, table: AtomTable | None = None) -> None:
        """Set the table of atoms, read from the topology if one was given."""
        check_claim(self.path, atoms)
        if self.topology is not None:
            table, _ = self.topology.read()
            self._belongs(len(table), atoms)
        self.table = AtomTable.plain(["X"] * atoms, named=False) if table is None else table

    def _belongs(self, topology: int, atoms: int) -> None:
        """Raise an error if topology and trajectory have different numbers of atoms."""
        if self.topology is not None and topology != atoms:
            seen = (
                f"the topology {self.topology.path.name} has {topology:,} atoms and the trajectory {atoms:,}"
            )
            remedy = "Give the topology with which the trajectory was written, or a selection of its atoms"
            raise self._refused(seen, remedy)

    def _refused(self, message: str, remedy: str = CHECK) -> InputError:
        return InputError(message, remedy=remedy, where=str(self.path))

    @property
    def atoms(self) -> int:
        """Number of atoms in every frame."""
        return len(self.table)

    @property
    def species(self) -> np.ndarray:
        """Species of all atoms as strings, shape (atoms,)."""
        return self.table.species

    def other_box(self, number: int) -> tuple[str, Box] | None:
        """Return (code of a finding, second possible box of a frame). None if only one box is possible."""
        return None

    @property
    def in_file(self) -> int | None:
        """Number of frames in the file. None if still unknown."""
        if self._count is None and any((end or 0) < 0 for end in (self.slice.start, self.slice.stop)):
            with self._opened() as get:
                for number in chosen(slice(None), None):
                    with self._reading(number):
                        if get(number) is None:
                            self._count = number
                            break
        return self._count

    @property
    def count(self) -> int | None:
        """Number of frames that `frames` yields. None if still unknown."""
        return None if self.in_file is None else len(range(*self.slice.indices(self.in_file)))

    def frames(self) -> Iterator[Frame]:
        """Yield the requested frames in order. Each call starts at the first frame.

        Raises:
            UnreadableFrame: a frame cannot be read; all earlier frames have been yielded.
            InputError: a frame has a different number of atoms.
        """
        number = None
        with self._opened() as get:
            for number in chosen(self.slice, self.in_file):
                with self._reading(number):
                    if (raw := get(number)) is None:
                        return
                    frame = self.decoded(number, raw)
                if len(frame.positions) != self.atoms:
                    seen = f"has {len(frame.positions):,} atoms, but the first has {self.atoms:,}"
                    remedy = "Leave out the frames with another number of atoms"
                    raise self._odd(number, seen, remedy)
                yield frame
        end = self.in_file or 0
        if number is None or not (self.slice.stop is None or self.slice.stop > end):
            return
        with self._reading(end):
            if rest := self._behind():
                raise self._unreadable(end, rest)

    def sample(self) -> list[Frame]:
        """Return the first `SAMPLE` requested frames. Return fewer if one of these frames is unreadable.

        Raises:
            InputError: there is no frame, or the first frame cannot be read.
        """
        sample = []
        try:
            sample.extend(islice(self.frames(), SAMPLE))
        except InputError:
            if not sample:
                raise
        if not sample:
            words, of = self.slice_words, "" if self.in_file is None else f" of {self.in_file:,}"
            raise self._refused(f"@{words} leaves no frame{of}", "Ask for others") if words else self._empty()
        return sample

    @property
    def slice_words(self) -> str:
        """Requested frames as written after @ in a file name. Empty for all frames."""
        if self.slice == slice(None):
            return ""
        start, stop, step = self.slice.start, self.slice.stop, self.slice.step
        ends = [start, stop] if step in (None, 1) else [start, stop, step]
        return ":".join("" if end is None else str(end) for end in ends)

    @abstractmethod
    def raw_frames(self) -> AbstractContextManager[Callable[[int], Any]]:
        """Open the file and provide a function that returns raw frames, and None after the last."""

    @abstractmethod
    def decoded(self, number: int, raw: Any) -> Frame:
        """Decode a raw frame of `raw_frames`. The attributes `length` and `time` give the units."""

    def _behind(self) -> str | None:
        """Describe data after the last frame of the file. None if there is no such data."""
        return None

    def _by_id(self, number: int, ids: np.ndarray) -> np.ndarray:
        """Return the indices that sort the atoms by id. The first frame must have the same ids."""
        order = np.argsort(ids, kind="stable")
        known = self._ids = ids[order] if self._ids is None else self._ids
        if not np.array_equal(known, ids[order]):
            lost = np.setdiff1d(known, ids)
            seen = f"lacks atom {lost[0]}" if len(lost) else "has other atoms"
            seen += f" of the first frame: {len(ids):,} atoms, and {len(known):,} there"
            raise self._odd(number, seen, "Dump a group of atoms that does not change")
        return order

    @contextmanager
    def _opened(self) -> Iterator[Callable[[int], Any]]:
        with ExitStack() as stack:
            with reading(self.path, by=self.reader):
                get = stack.enter_context(self.raw_frames())
            yield get

    def _reading(self, number: int) -> AbstractContextManager[None]:
        return reading(self.path, number, by=self.reader)

    def in_order(self, following: Callable[[], Any]) -> Callable[[int], Any]:
        """Return a function that reads frames of a format without random access, in order."""
        at = 0

        def get(number: int) -> Any:
            nonlocal at
            raw = None
            while at <= number:
                # the frame at fault may be one that is skipped
                with self._reading(at):
                    raw = following()
                if raw is None:
                    break
                at += 1
            return raw

        return get

    def first(self) -> Any:
        """Return the first frame of the file in raw form."""
        with self._opened() as get, self._reading(0):
            first = get(0)
        if first is None:
            raise self._empty()
        return first

    def _empty(self) -> InputError:
        return self._refused("the file holds no frame", "Check how it was written")

    def _odd(self, number: int, seen: str, remedy: str) -> FrameError:
        return FrameError(f"frame {number} {seen}", frame=number, remedy=remedy, where=str(self.path))

    def _unreadable(self, number: int, said: str) -> UnreadableFrame:
        return UnreadableFrame(f"frame {number} cannot be read ({said})", frame=number, where=str(self.path))


def chosen(frames: slice, total: int | None) -> Iterator[int]:
    """Return the frame numbers of a slice in ascending order. Infinite if no end is known."""
    if total is not None:
        return iter(range(*frames.indices(total)))
    return islice(count(), frames.start, frames.stop, frames.step)
