"""Amber's NetCDF files that end early, read up to where they do: what a run that was killed has left.

As MDAnalysis hands over those of whole files (ambermd.org/netcdf/nctraj.xhtml).
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

import numpy as np

from mdnum.errors import InputError
from mdnum.trajectories.boxes import box_of
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.mdanalysis_source import notes_on
from mdnum.trajectories.netcdf import head_of
from mdnum.trajectories.slices import chosen
from mdnum.trajectories.source import AtomTable, Trajectory, UnreadableFrame, table_of_topology


class NetcdfTrajectory(Trajectory):
    """An Amber NetCDF file that ends early, in Å and ps."""

    format = "NCDF"
    reader = "mdnum"
    time = "ps"

    def __init__(self, path: Path, topology: str | Path | None, frames: slice):
        self.path, self.slice = path, frames
        self.topology = None if topology is None else Path(topology)
        head = head_of(path)
        if head is None or "coordinates" not in head.variables or not head.atoms:
            raise InputError(
                "it is no Amber NetCDF file, or one that ends in its head",
                remedy="Check that the file is whole and of the kind its name says",
                where=str(path),
            )
        self._head = head
        if not head.whole:
            raise UnreadableFrame(self._why(0), frame=0, where=str(path))
        self.bits = 8 * head.variables["coordinates"].dtype.itemsize
        self.time = "ps" if "time" in head.variables else "frame"
        self.table = (
            AtomTable.plain(["X"] * head.atoms, named=False)
            if topology is None
            else table_of_topology(topology)
        )
        if len(self.table) != head.atoms:
            raise InputError(
                f"the topology {Path(str(topology)).name} has {len(self.table):,} atoms "
                f"and the trajectory {head.atoms:,}",
                remedy="Give the topology that the trajectory was written with, or a selection of it",
                where=str(path),
            )
        self.notes = tuple(notes_on(self.table))[1:]

    @property
    def in_file(self) -> int | None:
        return self._head.whole + 1

    def frames(self) -> Iterator[Frame]:
        with self.path.open("rb") as file:
            for number in chosen(self.slice, self.in_file):
                if number >= self._head.whole:
                    raise UnreadableFrame(self._why(number), frame=number, where=str(self.path))
                yield self._frame(file, number)

    def _why(self, number: int) -> str:
        told = self._head.records or 0
        return f"frame {number} cannot be read (the file ends in it, and its head tells of {told:,} frames)"

    def _frame(self, file: BufferedReader, number: int) -> Frame:
        found = {
            name: self._value(file, name, number)
            for name in ("coordinates", "velocities", "time", "cell_lengths", "cell_angles")
            if name in self._head.variables
        }
        box = Box()
        if {"cell_lengths", "cell_angles"} <= set(found):
            sizes = np.concatenate([found["cell_lengths"], found["cell_angles"]])
            box = box_of(sizes.astype(np.float32))
        return Frame(
            index=number,
            time=float(found["time"]) if "time" in found else float(number),
            positions=found["coordinates"].astype(np.float64),
            box=box,
            velocities=found["velocities"].astype(np.float64) if "velocities" in found else None,
        )

    def _value(self, file: BufferedReader, name: str, number: int) -> np.ndarray:
        one = self._head.variables[name]
        file.seek(one.begin + number * self._head.record)
        values = np.frombuffer(file.read(one.size), one.dtype).reshape(one.shape)
        values = values.astype(one.dtype.newbyteorder("="))
        # rounded once, as MDAnalysis does
        return values if one.scale is None else (values * np.float64(one.scale)).astype(values.dtype)
