"""What every reader gives: the frames asked for, one after the other, and what is known of the atoms.

Positions are those of the file: nothing is wrapped, made whole or centered. Readers differ in what they keep:
ASE's and mdnum's own (gro, LAMMPS's text dumps) keep every digit, MDAnalysis's narrow every coordinate to
float32 (`Trajectory.bits`).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.trajectories.frame import Frame, FrameError, UnreadableFrame
from mdnum.trajectories.topology import CHECK, AtomTable, first_line

#: Frames from which the resolution of a file is read.
SAMPLE = 8
_SLICE = re.compile(r"(-?\d+)?(:(-?\d+)?(:(-?\d+)?)?)?")


class Trajectory(ABC):
    """Frames of one file, read lazily and in order, as often as wanted.

    A reader says how many atoms there are (`_has`), finds frames (`_raw`) and decodes them (`_frame`).

    Args:
        path: the file.
        topology: the file that says what the atoms are, where it is another one.
        slice: the frames asked for.
    """

    format: str  # the file's format in the reader's word ("XTC", "extxyz")
    reader: str = "mdnum"  # who reads it: "MDAnalysis", "ASE", "mdnum"
    bits: int = (
        64  # width of a coordinate as it comes from the reader, 32 or 64; frames are float64 either way
    )
    length: str = "Å"  # unit in words; "" where the file does not say
    # unit in words; "frame" where the file has no times, whose numbers then stand for them (velocities are per
    # ps there, if the file has any)
    time: str = "frame"
    table: AtomTable  # what is known of the atoms
    notes: tuple[str, ...] = ()  # what a reader of the results should know about the reading, each a sentence
    # what a frame that is none raises while it is decoded
    _fails: tuple[type[BaseException], ...] = (OSError, EOFError, ValueError, RuntimeError, LookupError)
    # frames in the file, where they are known
    _count: int | None = None

    def __init__(self, path: Path, topology: str | Path | None, slice: slice):
        self.path, self.slice = path, slice
        self.topology = None if topology is None else Path(topology)

    def _has(self, atoms: int, table: AtomTable | None = None) -> None:
        """Sets the table of atoms: the topology's, where there is one."""
        if self.topology is not None:
            table = AtomTable.read(self.topology)
            self._belongs(len(table), atoms)
        self.table = AtomTable.plain(["X"] * atoms, named=False) if table is None else table

    def _belongs(self, topology: int, atoms: int) -> None:
        """Refuses a topology with another number of atoms."""
        if self.topology is not None and topology != atoms:
            raise self._refused(
                f"the topology {self.topology.name} has {topology:,} atoms and the trajectory {atoms:,}",
                "Give the topology that the trajectory was written with, or a selection of it",
            )

    def _refused(self, message: str, remedy: str = CHECK) -> InputError:
        return InputError(message, remedy=remedy, where=str(self.path))

    @property
    def atoms(self) -> int:
        """Atoms in every frame."""
        return len(self.table)

    @property
    def species(self) -> np.ndarray:
        """Species of every atom, words, shape (atoms,)."""
        return self.table.species

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    @property
    def in_file(self) -> int | None:
        """Frames in the file; None where they are not known without reading it."""
        if self._count is None and any((end or 0) < 0 for end in (self.slice.start, self.slice.stop)):
            self._count = sum(1 for _ in self._raw(chosen(slice(None), None)))
        return self._count

    @property
    def count(self) -> int | None:
        """Frames that `frames` gives; None where they are not known without reading the file."""
        return None if self.in_file is None else len(range(*self.slice.indices(self.in_file)))

    @property
    def universe(self) -> Any:
        """The MDAnalysis Universe behind it, or None: another reader has none."""
        return None

    def frames(self) -> Iterator[Frame]:
        """The frames asked for, in order, one in memory at a time. Each call starts at the first again.

        Raises:
            UnreadableFrame: one cannot be read. Those before it have been given.
            InputError: a frame has another number of atoms.
        """
        for number, raw in self._raw(chosen(self.slice, self.in_file)):
            try:
                frame = self._frame(number, raw)
            except self._fails as error:
                raise self._unreadable(number, error) from error
            if len(frame.positions) != self.atoms:
                raise self._odd(
                    number,
                    f"has {len(frame.positions):,} atoms and the first {self.atoms:,}",
                    "Leave out the frames with another number of atoms: a flip needs the pair before",
                )
            yield frame

    def sample(self) -> list[Frame]:
        """The first of the frames asked for, `SAMPLE` of them; fewer where one of them cannot be read.

        Raises:
            InputError: there is none, or not even the first can be read.
        """
        sample = []
        try:
            for frame in islice(self.frames(), SAMPLE):
                sample.append(frame)
        except InputError:
            if not sample:
                raise
        if not sample:
            words, of = self.slice_words, "" if self.in_file is None else f" of {self.in_file:,}"
            raise self._refused(f"@{words} leaves no frame{of}", "Ask for others") if words else self._empty()
        return sample

    @property
    def slice_words(self) -> str:
        """The frames asked for, as behind an @; empty for all."""
        if self.slice == slice(None):
            return ""
        start, stop, step = self.slice.start, self.slice.stop, self.slice.step
        ends = [start, stop] if step in (None, 1) else [start, stop, step]
        return ":".join("" if end is None else str(end) for end in ends)

    @abstractmethod
    def _raw(self, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
        """Frames by their numbers, which go up, as `_frame` takes them; ends with the file."""

    @abstractmethod
    def _frame(self, number: int, raw: Any) -> Frame:
        """A frame from what `_raw` gave."""

    def _guarded(self, numbers: Iterator[int], get: Callable[[int], Any]) -> Iterator[tuple[int, Any]]:
        """Frames by number as a reader gives them, up to None; what it raises is an unreadable frame."""
        for number in numbers:
            try:
                raw = get(number)
            except self._fails as error:
                raise self._unreadable(number, error) from error
            if raw is None:
                return
            yield number, raw

    def _first(self) -> tuple[int, Any]:
        """The first of the file."""
        first = next(self._raw(iter([0])), None)
        if first is None:
            raise self._empty()
        return first

    def _empty(self) -> InputError:
        return self._refused("the file holds no frame", "Check how it was written")

    def _odd(self, number: int, seen: str, remedy: str) -> FrameError:
        return FrameError(f"frame {number} {seen}", frame=number, remedy=remedy, where=str(self.path))

    def _unreadable(self, number: int, error: BaseException | str) -> UnreadableFrame:
        said = error if isinstance(error, str) else first_line(error)
        return UnreadableFrame(f"frame {number} cannot be read ({said})", frame=number, where=str(self.path))


# ---- which frames: run.xtc@100:, run.xtc@::10, run.xtc@5, as ASE writes it


def split_path(text: str) -> tuple[Path, str]:
    """(path, words of the slice behind its last @); a file whose own name has an @ is found as it is."""
    whole = Path(text).expanduser()
    name, at, words = text.rpartition("@")
    if not at or whole.exists():
        return whole, ""
    path = Path(name).expanduser()
    # words that name no frames are told where the file is there without them
    return (path, words) if _SLICE.fullmatch(words) or path.is_file() else (whole, "")


def parse_slice(words: str, where: str = "") -> slice:
    """The slice that words name: "100:", "::10", "-50:", "5" (that frame alone), "" (all).

    Raises:
        InputError: the words are no slice, or go backward: flips follow time.
    """
    match = _SLICE.fullmatch(words.strip())
    if match is None:
        raise InputError(
            f"{words!r} names no frames",
            remedy="Write START:STOP:STEP, for example 100: or ::10 or -50:, or the number of one frame",
            where=where or None,
        )
    colon = match[2]
    start, stop, step = (None if match[k] is None else int(match[k]) for k in (1, 3, 5))
    if colon is None:
        return slice(None) if start is None else slice(start, start + 1 or None)
    if step is not None and step < 1:
        raise InputError(
            f"the frames {words!r} go backward or nowhere",
            remedy="Write a stride of 1 or more: flips follow time",
            where=where or None,
        )
    return slice(start, stop, step or 1)


def chosen(frames: slice, count: int | None) -> Iterator[int]:
    """The numbers of the frames, upward; without an end where neither the slice nor a count has one."""
    if count is not None:
        yield from range(*frames.indices(count))
        return
    number, stop, step = frames.start or 0, frames.stop, frames.step or 1
    while stop is None or number < stop:
        yield number
        number += step
