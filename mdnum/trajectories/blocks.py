"""Trajectories that are text, one block of lines a frame: read block by block, every digit kept."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from io import TextIOBase
from pathlib import Path
from typing import cast

from mdnum.errors import InputError
from mdnum.trajectories.checked import FrameError
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.slices import chosen, counts_from_end
from mdnum.trajectories.source import AtomTable, Trajectory, UnreadableFrame, table_of_topology

# what lines that are no frame make of themselves
_NOT_A_FRAME = (ValueError, IndexError, KeyError)


class TextTrajectory(Trajectory):
    """A text file of frames. A reader of a format says where a block ends and what is in it."""

    reader = "mdnum"
    bits = 64

    def __init__(self, path: Path, topology: str | Path | None, frames: slice):
        self.path, self.slice = path, frames
        self.topology = None if topology is None else Path(topology)
        self._count: int | None = None
        first = next(self._blocks(iter([0])), None)
        if first is None:
            raise InputError("the file holds no frame", remedy="Check how it was written", where=str(path))
        try:
            atoms = len(self._frame(*first).positions)
            told = self._told(*first)
        except _NOT_A_FRAME as error:
            raise self._unreadable(0, error) from error
        self.table = told if topology is None else table_of_topology(topology)
        if len(self.table) != atoms:
            raise InputError(
                f"the topology {Path(str(topology)).name} has {len(self.table):,} atoms "
                f"and the trajectory {atoms:,}",
                remedy="Give the topology that the trajectory was written with, or a selection of it",
                where=str(path),
            )

    @property
    def in_file(self) -> int | None:
        if self._count is None and counts_from_end(self.slice):
            self._count = sum(1 for _ in self._blocks(chosen(slice(None), None)))
        return self._count

    def frames(self) -> Iterator[Frame]:
        for number, block in self._blocks(chosen(self.slice, self.in_file)):
            try:
                frame = self._frame(number, block)
            except _NOT_A_FRAME as error:
                raise self._unreadable(number, error) from error
            if len(frame.positions) != self.atoms:
                raise FrameError(
                    f"frame {number} has {len(frame.positions):,} atoms and the first {self.atoms:,}",
                    remedy="Leave out the frames with another number: a flip needs the pair before",
                    where=str(self.path),
                    frame=number,
                )
            yield frame

    @abstractmethod
    def _block(self, lines: TextIOBase) -> list[str] | None:
        """The lines of the next frame; None at the end of the file.

        Raises:
            ValueError: the lines are not what a frame consists of.
        """

    @abstractmethod
    def _frame(self, number: int, block: list[str]) -> Frame:
        """The frame that lines hold."""

    @abstractmethod
    def _told(self, number: int, block: list[str]) -> AtomTable:
        """What the first frame tells of its atoms."""

    def _blocks(self, numbers: Iterator[int]) -> Iterator[tuple[int, list[str]]]:
        from ase.io.formats import open_with_compression

        wanted = next(numbers, None)
        with open_with_compression(str(self.path), "r") as lines:
            number = 0
            while wanted is not None:
                try:
                    block = self._block(cast(TextIOBase, lines))
                except (ValueError, IndexError, OSError, EOFError) as error:
                    raise self._unreadable(number, error) from error
                if block is None:
                    return
                if number == wanted:
                    yield number, block
                    wanted = next(numbers, None)
                number += 1

    def _unreadable(self, number: int, error: BaseException) -> UnreadableFrame:
        said = str(error).strip().splitlines() or [type(error).__name__]
        return UnreadableFrame(
            f"frame {number} cannot be read ({said[0].rstrip('.')})", frame=number, where=str(self.path)
        )


def whole_number(line: str, what: str) -> int:
    """The number in a line.

    Raises:
        ValueError: there is none; says what was expected.
    """
    try:
        return int(line)
    except ValueError:
        raise ValueError(f"{line.strip()[:40]!r} where {what} is expected") from None


def end_of(lines: list[str], expected: int) -> None:
    """Raises ValueError where a file ended before its frame did."""
    if len(lines) < expected:
        raise ValueError(f"the file ends after {len(lines):,} of {expected:,} atoms")
