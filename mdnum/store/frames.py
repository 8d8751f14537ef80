"""Exact float64 frames in ASE's own trajectory file, cut back to a known frame when a run resumes."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import FolderError
from mdnum.store.atomic import disk_errors, opened, refuse_link

if TYPE_CHECKING:
    from ase import Atoms

# ASE's ulm format: 8 bytes magic, 16 bytes tag, then int64 version, frames, position of the offset table
_FRAMES_AT = 32
_HEADER = struct.Struct("<qq")


class FrameFile:
    """`trajectory.traj`, opened at the first frame."""

    def __init__(self, path: Path):
        self.path = path
        self._writer: Any = None

    def append(self, atoms: Atoms) -> None:
        """Writes one frame (positions, momenta, cell and what a single-point calculator holds).

        Raises:
            FolderError: the disk is full; the file is left with the frames before this one.
        """
        from ase.io.trajectory import TrajectoryWriter

        refuse_link(self.path, in_place=True)
        mark = self.mark()
        with disk_errors(self.path):
            try:
                if self._writer is None:
                    self._writer = TrajectoryWriter(self.path, "a" if mark[0] else "w")
                self._writer.write(atoms)
            except OSError:
                self._writer = None
                self.truncate(mark)
                raise

    def mark(self) -> tuple[int, int, int]:
        """(frames, position of the offset table, bytes) of the file now; zeros before the first frame."""
        if not self.path.exists() or self.path.stat().st_size < _FRAMES_AT + _HEADER.size:
            return (0, 0, 0)
        with opened(self.path) as file:
            file.seek(_FRAMES_AT)
            frames, table = _HEADER.unpack(file.read(_HEADER.size))
        return (frames, table, self.path.stat().st_size)

    def truncate(self, mark: tuple[int, int, int]) -> None:
        """Puts the file back to what it was at mark, a half-written frame included.

        ASE moves its offset table as the file grows, hence the table's position in the mark.
        """
        self.close()
        frames, table, size = mark
        if frames == 0:
            self.path.unlink(missing_ok=True)
            return
        if self.mark()[2] < size:
            raise FolderError(
                f"trajectory is shorter than its checkpoint says ({frames} frames)",
                remedy="The folder was changed since; run again in a new folder",
                where=str(self.path),
            )
        with disk_errors(self.path), opened(self.path, "r+b") as file:
            file.seek(_FRAMES_AT)
            file.write(_HEADER.pack(frames, table))
            file.flush()
            os.ftruncate(file.fileno(), size)

    def close(self) -> None:
        """Closes the file; the next frame opens it again."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
