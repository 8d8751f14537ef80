"""Trajectories that MDAnalysis reads."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.trajectories.boxes import Boxes, box_of, formats_of
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.rules import CutoffRule
from mdnum.trajectories.tails import left_over, refuse_cut_text
from mdnum.trajectories.topology import (
    NARROWED,
    READING_FAILS,
    notes_on,
    opened_by_mdanalysis,
    table_of,
    topology_universe,
    with_elements,
)
from mdnum.trajectories.tracker import Tracker
from mdnum.trajectories.trajectory import Trajectory

# a distance that bonded atoms have, and others do not come to, Å
_CLOSE = 1.4


class MDAnalysisTrajectory(Trajectory):
    """A file behind an MDAnalysis Universe. Coordinates pass through float32 there, whatever it holds."""

    reader = "MDAnalysis"
    bits = 32

    def __init__(self, path: Path, topology: str | Path | None, frames: slice, format: str | None = None):
        super().__init__(path, topology, frames)
        self._universe, said = open_universe(path, topology, format)
        self.table = table_of(self._universe.atoms)
        with_elements(self._universe, self.table)
        trajectory = self._universe.trajectory
        self.format, self._count = formats_of(trajectory)[0], int(trajectory.n_frames)
        self.length = _length_of(trajectory)
        self.time = "frame" if _has_no_times(trajectory, said) else "ps"
        boxes = Boxes(trajectory)
        self.notes = (NARROWED, *notes_on(self.table), *boxes.notes, *differing_box(trajectory, boxes))

    @property
    def universe(self) -> Any:
        return self._universe

    def _raw(self, numbers: Iterator[int]) -> Iterator[tuple[int, Frame]]:
        trajectory = self._universe.trajectory
        boxes, labels = Boxes(trajectory), labels_of(trajectory)
        at = None
        for number in numbers:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    refuse_cut_text(trajectory, number)
                    # some formats go forward only, so that the next frame is asked for as the next
                    step = at is not None and number == at + 1 and trajectory.ts.frame == at
                    ts = trajectory.next() if step else trajectory[number]
                    frame = frame_of(ts, number, boxes, self.time == "frame", labels(number))
                except READING_FAILS as error:
                    raise self._unreadable(number, error) from error
            at = number
            yield number, frame
        count = int(trajectory.n_frames)
        if at is None or not (self.slice.stop is None or self.slice.stop > count):
            return
        if rest := left_over(trajectory):
            raise self._unreadable(count, rest)

    def _frame(self, number: int, raw: Frame) -> Frame:
        return raw


def labels_of(trajectory: Any) -> Callable[[int], np.ndarray | None]:
    """What the file says its atoms are in each frame: MDAnalysis reads that of the first alone.

    Args:
        trajectory: MDAnalysis's reader. Others than those of XYZ files and of PDB models give None.
    """
    from MDAnalysis.lib.util import anyopen

    begins = {"XYZ": "_offsets", "PDB": "_start_offsets", "ENT": "_start_offsets"}
    word = next((word for word in formats_of(trajectory) if word in begins), None)
    # where each frame begins; another release of MDAnalysis may keep it elsewhere
    offsets = None if word is None or trajectory.n_frames < 2 else getattr(trajectory, begins[word], None)
    if offsets is None:
        return lambda number: None
    file: Any = anyopen(str(trajectory.filename))

    def of(number: int) -> np.ndarray | None:
        file.seek(offsets[number])
        if word == "XYZ":
            rows = list(islice(file, trajectory.n_atoms + 2))[2:]
            return np.array([row.split(maxsplit=1)[0] for row in rows])
        found: list[str] = []
        for row in file:
            if row.startswith(("ATOM  ", "HETATM")):
                found.append(f"{row[17:21].strip()} {row[12:16].strip()}")
            elif found and row.startswith(("ENDMDL", "MODEL", "END")):
                break
        return np.array(found)

    return of


def frame_of(
    ts: Any, number: int, boxes: Boxes, untimed: bool = False, labels: np.ndarray | None = None
) -> Frame:
    """A frame from an MDAnalysis timestep, copied."""
    return Frame(
        index=number,
        time=float(number) if untimed else float(ts.time),
        positions=np.array(ts.positions, np.float64),
        box=boxes.box(ts, number),
        velocities=np.array(ts.velocities, np.float64) if ts.has_velocities else None,
        labels=labels,
    )


def open_universe(
    path: Path, topology: str | Path | None, format: str | None = None
) -> tuple[Any, list[str]]:
    """A Universe of a trajectory, and the warnings that opening it gave.

    Raises:
        InputError: nobody reads it, or it has another number of atoms than its topology.
    """
    import MDAnalysis

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if topology is None:
            universe = opened_by_mdanalysis(path, lambda: MDAnalysis.Universe(str(path), format=format), path)
        else:
            universe = topology_universe(topology)
            atoms = len(universe.atoms)
            if (other := atoms_in(path, atoms, format)) not in (None, atoms):
                raise InputError(
                    f"the topology {Path(topology).name} has {atoms:,} atoms and the trajectory {other:,}",
                    remedy="Give the topology that the trajectory was written with, or a selection of it",
                    where=str(path),
                )
            opened_by_mdanalysis(path, lambda: _loaded(universe, path, format), path)
        # a topology without coordinates has no trajectory at all
        if not opened_by_mdanalysis(path, lambda: len(getattr(universe, "trajectory", ())), path):
            raise InputError("the file holds no frame", remedy="Check how it was written", where=str(path))
    return universe, [str(one.message) for one in caught]


def _loaded(universe: Any, path: Path, format: str | None) -> None:
    try:
        universe.load_new(str(path), format=format)
    except ValueError as error:
        # an H5MD file may say nothing of its units
        if "convert_units" not in str(error):
            raise
        universe.load_new(str(path), format=format, convert_units=False)


def atoms_in(path: Path, topology: int, format: str | None = None) -> int | None:
    """Atoms in a trajectory; None where its format does not tell.

    Args:
        topology: atoms of its topology, which some readers want to know first.
    """
    from MDAnalysis.core._get_readers import get_reader_for

    for known in ({"n_atoms": topology}, {}):
        try:
            reader: Any = get_reader_for(str(path), format=format)
            return int(reader.parse_n_atoms(str(path), **known))
        except Exception:
            # a format without that question, or a file that opening will say more about
            continue
    return None


def _length_of(trajectory: Any) -> str:
    """Unit of length in words; "" where the file has one of its own (GSD)."""
    unit = trajectory.units.get("length")
    if unit is None or getattr(trajectory, "convert_units", True):
        return "Å" if unit else ""
    # left as they are, because the file did not name all its units
    return "Å" if str(unit) in ("A", "Angstrom", "angstrom") else str(unit)


def _has_no_times(trajectory: Any, said: list[str]) -> bool:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _ = trajectory.dt
    # a frame may have its time without a step between frames
    return "time" not in trajectory.ts.data and any(
        "no dt information" in one for one in [*said, *(str(w.message) for w in caught)]
    )


def differing_box(trajectory: Any, boxes: Boxes) -> Iterator[str]:
    """A sentence on where MDAnalysis takes a box for another one than the file has, from two frames."""
    if not boxes.own:
        return
    worst, said = -1, ""
    for number in (0, trajectory.n_frames - 1):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                ts = trajectory[number]
                ours, theirs = boxes.box(ts, number), box_of(ts.dimensions)
            apart = float(np.abs(ours.matrix - theirs.matrix)[ours.pbc].max(initial=0.0))
            # float32, and angles from cosines
            if not apart > 1e-4 * float(np.abs(ours.matrix).max()):
                continue
            counts = [_close_pairs(ts, box) for box in (theirs, ours)]
        except (*READING_FAILS, InputError):
            # a frame that cannot be used is told in its turn
            continue
        if counts[0] - counts[1] > worst:
            worst = counts[0] - counts[1]
            said = (
                "The file's box is not the one that MDAnalysis makes of its lengths and angles: its vectors "
                f"differ by up to {apart:.3g} Å, so that images stand elsewhere. mdnum takes the file's. In "
                f"frame {number} MDAnalysis puts {counts[0]:,} pairs of atoms closer than {_CLOSE:g} Å, "
                f"the file's {counts[1]:,}."
            )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # selections by place are made at the frame where the reader stands
        trajectory[0]
    if said:
        yield said


def _close_pairs(ts: Any, box: Box) -> int:
    tracker = Tracker(CutoffRule(_CLOSE))
    tracker.step(Frame(0, 0.0, np.array(ts.positions, np.float64), box))
    return len(tracker.members())
