"""Trajectories that MDAnalysis reads, and the tables of atoms that its topologies hold."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.trajectories.boxes import Boxes, box_of
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.rules import Cutoff
from mdnum.trajectories.slices import chosen
from mdnum.trajectories.source import AtomTable, Trajectory, UnreadableFrame
from mdnum.trajectories.tails import left_over, refuse_cut_text
from mdnum.trajectories.tracker import Tracker

# a distance that bonded atoms have, and others do not come to, Å
_CLOSE = 1.4

#: what readers raise on files that end early or hold something else
# what a word that is no number is told as, by readers that take it for the end of the file
_NO_NUMBER = "could not convert"
READING_FAILS = (OSError, EOFError, ValueError, RuntimeError, StopIteration, IndexError, KeyError, TypeError)


class MDAnalysisTrajectory(Trajectory):
    """A file behind an MDAnalysis Universe. Coordinates pass through float32 there, whatever it holds."""

    reader = "MDAnalysis"
    bits = 32

    def __init__(self, path: Path, topology: str | Path | None, frames: slice, format: str | None = None):
        self.path, self.slice = path, frames
        self._universe, said = open_universe(path, topology, format)
        self.table = table_of(self._universe.atoms)
        with_elements(self._universe, self.table)
        trajectory = self._universe.trajectory
        self.format = str(trajectory.format if isinstance(trajectory.format, str) else trajectory.format[0])
        self.length = _length_of(trajectory)
        self.time = "frame" if _has_no_times(trajectory, said) else "ps"
        boxes = Boxes(trajectory)
        self.notes = (*notes_on(self.table), *boxes.notes, *differing_box(trajectory, boxes))

    @property
    def in_file(self) -> int | None:
        return int(self._universe.trajectory.n_frames)

    @property
    def universe(self) -> Any:
        return self._universe

    def frames(self) -> Iterator[Frame]:
        trajectory = self._universe.trajectory
        boxes, labels = Boxes(trajectory), labels_of(trajectory)
        at = None
        for number in chosen(self.slice, self.in_file):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    refuse_cut_text(trajectory, number)
                    # some formats go forward only, so that the next frame is asked for as the next
                    step = at is not None and number == at + 1 and trajectory.ts.frame == at
                    ts = trajectory.next() if step else trajectory[number]
                    frame = frame_of(ts, number, boxes, self.time == "frame", labels(number))
                except READING_FAILS as error:
                    raise UnreadableFrame(
                        f"frame {number} cannot be read ({first_line(error)})",
                        frame=number,
                        where=str(self.path),
                    ) from error
            at = number
            yield frame
        count = int(trajectory.n_frames)
        if at is None or not (self.slice.stop is None or self.slice.stop > count):
            return
        if rest := left_over(trajectory):
            raise UnreadableFrame(f"frame {count} cannot be read ({rest})", frame=count, where=str(self.path))


def labels_of(trajectory: Any) -> Callable[[int], np.ndarray | None]:
    """What the file says its atoms are in each frame: MDAnalysis reads that of the first alone.

    Args:
        trajectory: MDAnalysis's reader. Others than those of XYZ files and of PDB models give None.
    """
    from MDAnalysis.lib.util import anyopen

    words = [trajectory.format] if isinstance(trajectory.format, str) else list(trajectory.format)
    begins = {"XYZ": "_offsets", "PDB": "_start_offsets", "ENT": "_start_offsets"}
    word = next((word for word in words if word in begins), None)
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
            universe = _opened(path, lambda: MDAnalysis.Universe(str(path), format=format), path)
        else:
            universe = topology_universe(topology)
            atoms = len(universe.atoms)
            if (other := atoms_in(path, atoms, format)) not in (None, atoms):
                raise InputError(
                    f"the topology {Path(topology).name} has {atoms:,} atoms and the trajectory {other:,}",
                    remedy="Give the topology that the trajectory was written with, or a selection of it",
                    where=str(path),
                )
            _opened(path, lambda: _loaded(universe, path, format), path)
        # a topology without coordinates has no trajectory at all
        if not _opened(path, lambda: len(getattr(universe, "trajectory", ())), path):
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


def topology_universe(topology: str | Path) -> Any:
    """A Universe of a topology, with or without coordinates.

    Raises:
        InputError: MDAnalysis does not read it.
    """
    import MDAnalysis

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _opened(Path(topology), lambda: MDAnalysis.Universe(str(topology)), None)


def _opened(file: Path, act: Any, trajectory: Path | None) -> Any:
    hook = sys.unraisablehook
    # readers that could not open complain once more when they are thrown away
    sys.unraisablehook = lambda _: None
    try:
        try:
            return act()
        except READING_FAILS as error:
            said, package = first_line(error), "install" in str(error)
        except ImportError as error:
            said, package = first_line(error), True
    finally:
        sys.unraisablehook = hook
    if package:
        raise InputError(
            f"reading it needs a package that is not installed ({said})",
            remedy="Install the package, or convert the file to xtc or extxyz",
            where=str(file),
        )
    hint = "Check that the file is whole and of the kind its name says"
    if file == trajectory:
        hint += "; a trajectory without names of atoms needs its topology (-s TOPOLOGY)"
    raise InputError(f"MDAnalysis cannot open it ({said})", remedy=hint, where=str(file))


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


def table_of(atoms: Any) -> AtomTable:
    """What a topology says of its atoms.

    Args:
        atoms: an MDAnalysis AtomGroup.
    """
    count = len(atoms)
    has = {name: hasattr(atoms, name) for name in ("names", "types", "elements", "resnames", "resids")}
    names = np.array(atoms.names, dtype=object) if has["names"] else None
    types = np.array([str(one) for one in atoms.types], dtype=object) if has["types"] else None
    elements = np.array(atoms.elements, dtype=object) if has["elements"] else np.full(count, "", dtype=object)
    guessed = False
    if names is not None and any(not one for one in elements):
        from MDAnalysis.guesser.tables import SYMB2Z

        found = {one: _element(str(one), SYMB2Z) for one in set(names)}
        rest = types if types is not None else names
        elements = np.array(
            [e or found[n] or str(t) for e, n, t in zip(elements, names, rest, strict=True)], dtype=object
        )
        guessed = any(found.values())
    elif any(not one for one in elements):
        elements = types if types is not None else np.full(count, "X", dtype=object)
    named = names is not None or types is not None or has["elements"]
    return AtomTable(
        names=names if names is not None else elements,
        species=elements,
        residue_names=(
            np.array([str(one) for one in atoms.resnames], dtype=object)
            if has["resnames"]
            else np.full(count, "", dtype=object)
        ),
        residue_ids=np.array(atoms.resids if has["resids"] else np.zeros(count), np.int64),
        residues=np.array(atoms.resindices, np.int64),
        named=named,
        guessed=guessed,
    )


def with_elements(universe: Any, table: AtomTable) -> None:
    """Adds the elements that were guessed, for selections by element."""
    if table.guessed and not hasattr(universe.atoms, "elements"):
        universe.add_TopologyAttr("elements", table.species)


def _element(name: str, known: dict[str, int]) -> str:
    """The element in an atom's name; "" where there is none ("OW1" -> "O", "CL" -> "Cl", "CA" -> "C")."""
    from MDAnalysis.guesser.default_guesser import DefaultGuesser

    found = str(DefaultGuesser(None).guess_atom_element(name)).capitalize()
    return found if found in known else ""


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
    tracker = Tracker(Cutoff(_CLOSE))
    tracker.step(Frame(0, 0.0, np.array(ts.positions, np.float64), box))
    return len(tracker.members())


def notes_on(table: AtomTable) -> Iterator[str]:
    """What a reader of results from MDAnalysis's coordinates should know."""
    yield "MDAnalysis hands every coordinate over in float32, whatever the file stores."
    if not table.named:
        yield "The file says how many atoms there are and nothing else; names and elements need a topology."
    elif table.guessed:
        yield "Elements are guessed from the names of the atoms."


def first_line(error: BaseException) -> str:
    """What an error says, in a line."""
    cause: BaseException | None = error
    while cause is not None and not str(cause).strip():
        cause = cause.__context__
    text = str(error if cause is None else cause).strip().splitlines()
    if text and cause is not error and not text[0].startswith(_NO_NUMBER):
        # how a reader stumbles over an end is its own business
        text = []
    if not text and isinstance(error, StopIteration | EOFError):
        return "the file ends in it"
    return text[0].rstrip(".") if text else type(error).__name__
