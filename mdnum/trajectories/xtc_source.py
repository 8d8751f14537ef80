"""Trajectories in GROMACS's xtc format: coordinates as MDAnalysis has them, damage as an error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.trajectories.boxes import box_of
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.mdanalysis_source import first_line, notes_on
from mdnum.trajectories.slices import chosen
from mdnum.trajectories.source import AtomTable, Trajectory, UnreadableFrame, table_of_topology
from mdnum.trajectories.xtc import XtcFile, XtcFrame

_NANOMETER = np.float32(10)


class XtcTrajectory(Trajectory):
    """An xtc file, in Å and ps. Its coordinates are whole numbers, and float32 by the time they come here."""

    format = "XTC"
    reader = "MDAnalysis"
    bits = 32
    time = "ps"

    def __init__(self, path: Path, topology: str | Path | None, frames: slice):
        self.path, self.slice = path, frames
        self.topology = None if topology is None else Path(topology)
        file = XtcFile(path)
        try:
            atoms = file.atoms
        except ValueError as error:
            raise InputError(
                f"it is no xtc file, or a damaged one ({error})",
                remedy="Check that the file is whole and of the kind its name says",
                where=str(path),
            ) from None
        self._whole = file.whole_frames()
        self._cut = not file.ends_at(self._whole)
        file.close()
        self.table = (
            AtomTable.plain(["X"] * atoms, named=False) if topology is None else table_of_topology(topology)
        )
        if len(self.table) != atoms:
            raise InputError(
                f"the topology {Path(str(topology)).name} has {len(self.table):,} atoms "
                f"and the trajectory {atoms:,}",
                remedy="Give the topology that the trajectory was written with, or a selection of it",
                where=str(path),
            )
        self.notes = tuple(notes_on(self.table))

    @property
    def in_file(self) -> int | None:
        return self._whole + self._cut

    def frames(self) -> Iterator[Frame]:
        file = XtcFile(self.path)
        try:
            for number in chosen(self.slice, self.in_file):
                try:
                    frame = _frame(file.read(number), number)
                except (ValueError, OSError, EOFError, RuntimeError) as error:
                    raise UnreadableFrame(
                        f"frame {number} cannot be read ({first_line(error)})",
                        frame=number,
                        where=str(self.path),
                    ) from error
                yield frame
        finally:
            file.close()


def _frame(found: XtcFrame, number: int) -> Frame:
    """In Å, by the operations that MDAnalysis makes, so that both see the same numbers."""
    from MDAnalysis.lib.mdamath import triclinic_box

    dimensions: Any = triclinic_box(*found.box)
    dimensions[:3] *= _NANOMETER
    positions = found.positions * _NANOMETER
    return Frame(number, found.time, positions.astype(np.float64), box_of(dimensions))
