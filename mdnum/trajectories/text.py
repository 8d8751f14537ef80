"""Trajectories read through ASE, and readers of text formats that preserve all digits.

This module reads three text formats itself, because other libraries lose information
(tests/trajectories/test_source.py):

- LAMMPS's `dump custom` and `dump atom`, with columns x, xu, xs or xsu (docs.lammps.org/dump.html,
  Howto_triclinic). MDAnalysis reduces the coordinates to float32 and ignores the tilt of the box.
- GROMACS's gro files. The column width of a gro file is the distance between decimal points
  (manual.gromacs.org, reference manual, file formats). MDAnalysis and ASE read only the first gro frame.
- Extended XYZ, one frame at a time. By default, ASE scans the whole file first.
"""

from __future__ import annotations

import io
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from decimal import Decimal
from itertools import islice
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from ase.data import chemical_symbols
from ase.io.formats import UnknownFileTypeError, filetype, get_ioformat
from ase.io.trajectory import TrajectoryReader
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.reading import ase_images, ignored_velocities, reading, with_elements
from mdnum.store import RunFolder
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.topology import AtomTable, Topology, topology_universe
from mdnum.trajectories.trajectory import Trajectory
from mdnum.units import METAL
from mdnum.units import get as units_named

_NOT_READ = "Columns {} are not read as velocities, which are taken from {} alone."
_MOMENTA = "a column momenta in ASE's units"
_SYMBOLS = np.array(chemical_symbols)  # by atomic number: a frame has many atoms
_NUMBER = re.compile(r"[-+]?(\d*)(?:\.(\d*))?(?:[eEdD]([-+]?\d*))?")


class AseFrames(Trajectory):
    """Base class of readers that obtain each frame as an ASE Atoms object."""

    reader = "ASE"
    _timed, _per_time = False, 1.0

    def _atoms_of(self, raw: Any) -> Any:
        return raw

    def _of_atoms(self, first: Any) -> AtomTable:
        """Return the atoms of the first frame, and set the units."""
        self._timed = "time" in first.info
        units = METAL
        if self.path.name == "trajectory.traj":
            units = units_named(str(RunFolder(self.path.parent).system.get("units", "metal")))
        self.length, self.time = units.length, units.time if self._timed else "frame"
        self._per_time = units.time_factor
        if names := ignored_velocities(first.arrays):
            self.notes += (_NOT_READ.format(", ".join(f"“{name}”" for name in names), _MOMENTA),)
        order = np.arange(len(first)) if _ids(first) is None else np.argsort(first.arrays["id"])
        arrays = {name: values[order] for name, values in first.arrays.items()}
        return AtomTable.plain(_SYMBOLS[first.numbers[order]].tolist(), arrays=arrays)

    def decoded(self, number: int, raw: Any) -> Frame:
        atoms = self._atoms_of(raw)
        momenta, velocities = atoms.arrays.get("momenta"), None
        if momenta is not None:
            velocities = np.asarray(momenta, np.float64) / atoms.get_masses()[:, None] * self._per_time
        timed = self._timed and "time" in atoms.info
        labels, identified = _SYMBOLS[atoms.numbers], _ids(atoms) is not None
        if identified:
            order = self._by_id(number, atoms.arrays["id"])
            atoms, labels = atoms[order], labels[order]
            velocities = None if velocities is None else velocities[order]
        box = Box(np.array(atoms.cell.array, np.float64), np.array(atoms.pbc, bool))
        time, x = float(atoms.info["time"]) if timed else float(number), np.array(atoms.positions, np.float64)
        return Frame(number, time, x, box, velocities, labels, identified)


def _ids(atoms: Any) -> np.ndarray | None:
    """Return the ids of the atoms. None if ids are missing or not unique."""
    ids = atoms.arrays.get("id")
    return ids if ids is not None and ids.ndim == 1 and len(np.unique(ids)) == len(ids) else None


class AseTrajectory(AseFrames):
    """Trajectory read with `ase.io`, if possible frame by frame."""

    def __init__(self, path: Path, topology: Topology | None, frames: slice, format: str):
        super().__init__(path, topology, frames)
        self.format = format
        try:
            get_ioformat(format)
        except UnknownFileTypeError:
            seen = f"--format {format!r} is not a format of MDAnalysis or ASE"
            remedy = "Use a name of MDAnalysis or ASE, such as XTC, DCD, lammpstrj, extxyz, ..."
            raise self._refused(seen, remedy) from None
        if format == "traj":
            with reading(path, by="ASE"), TrajectoryReader(str(path)) as reader:
                self._count = len(reader)
        first = self.first()
        with self._reading(0):
            self.has_atoms(len(first), self._of_atoms(first))

    @contextmanager
    def raw_frames(self) -> Iterator[Callable[[int], Any]]:
        if self.format == "traj":
            with TrajectoryReader(str(self.path)) as reader:
                yield lambda number: with_elements(reader[number]) if number < len(reader) else None
            return
        images = ase_images(self.path, format=self.format)
        yield self.in_order(lambda: next(images, None))


def format_of(path: Path) -> str:
    """Return ASE's name for the format of a trajectory file.

    Raises:
        InputError: the format is unknown to ASE, or the file cannot be read.
    """
    try:
        with reading(path, by="ASE"):
            return filetype(str(path))
    except UnknownFileTypeError as error:
        message = "neither MDAnalysis nor ASE can read this format"
        remedy = "Give the file the suffix of its format (.xtc, .dcd, .extxyz, ...), or convert it"
        raise InputError(message, remedy=remedy, where=str(path)) from error


# ---- text


def refuse_cut_line(lines: Sequence[str], like: Sequence[str] = ()) -> None:
    """Reject a last line that ends within its last number.

    A missing newline at the end is no sign of truncation. A number is truncated if it has fewer digits than
    the numbers above it.

    Args:
        lines: lines of a frame, each of which ends with a number.
        like: numbers to compare with, instead of the last numbers of the lines.

    Raises:
        ValueError: the last number was truncated.
    """
    if not lines or lines[-1].endswith(("\n", "\r")):
        return
    words = lines[-1].split()
    if not words or lines[-1][-1].isspace():
        # more was written behind the number
        return
    others = list(like) or [line.split()[-1] for line in lines[:-1] if line.strip()]
    if not others:
        # one atom: its other coordinates are written alike
        others = [word for word in words[:-1] if "." in word]
    if _is_cut(words[-1], others):
        raise ValueError(
            f"the file ends in the middle of a number: {words[-1]!r} has fewer digits than the numbers "
            "before it, and no newline follows. If the number is complete, add a newline"
        )


def _is_cut(word: str, others: Sequence[str]) -> bool:
    mine, rest = _digits(word), [one for one in map(_digits, others) if one is not None]
    # a mass or a charge stands in other rows too
    if mine is None or not rest or word in others:
        return False
    decimals, significant, exponent = mine
    if 0 <= exponent < 2:
        # C, Fortran and Python write two digits at least
        return True
    if exponent < 0 and all(one[2] >= 0 for one in rest):
        return True
    if len({one[0] for one in rest}) == 1:
        return decimals < rest[0][0]
    # so many digits in all, and zeros at the end left out
    return significant < median(one[1] for one in rest)


def _digits(word: str) -> tuple[int, int, int] | None:
    """Count decimals, significant digits and exponent digits (-1: none) of a number. None for other text."""
    match = _NUMBER.fullmatch(word)
    if match is None:
        return None
    before, after, exponent = match.groups()
    digits = ((before or "") + (after or "")).lstrip("0")
    return len(after or ""), len(digits), -1 if exponent is None else len(exponent.lstrip("+-"))


class TextTrajectory(Trajectory):
    """Base class of text readers. A subclass finds the end of a frame and decodes it."""

    def __init__(self, path: Path, topology: Topology | None, frames: slice):
        super().__init__(path, topology, frames)
        block = self.first()
        with self._reading(0):
            atoms, table = len(self.decoded(0, block).positions), self._described(block)
        self.has_atoms(atoms, table)

    @abstractmethod
    def _block(self, lines: Any) -> list[str] | None:
        """Read the lines of the next frame. None at the end of the file.

        Raises:
            ValueError: the lines do not form a frame.
        """

    @abstractmethod
    def _described(self, block: list[str]) -> AtomTable:
        """Return the table of atoms, derived from the lines of the first frame."""

    @contextmanager
    def raw_frames(self) -> Iterator[Callable[[int], Any]]:
        from ase.io.formats import open_with_compression

        with open_with_compression(str(self.path), "r") as lines:
            yield self.in_order(lambda: self._block(lines))


def _whole_number(line: str, what: str) -> int:
    try:
        return int(line)
    except ValueError:
        raise ValueError(f"expected {what}; found {line.strip()[:40]!r}") from None


def _rows(lines: Any, head: int, atoms: int, cut: bool = True) -> list[str]:
    """Read `head` lines, followed by one line for each atom."""
    if atoms < 0:
        raise ValueError(f"the number of atoms of a frame is {atoms}; expected 0 or more")
    rows = list(islice(lines, head + atoms))
    if len(rows) < head + atoms:
        raise ValueError(f"the file ends after {max(len(rows) - head, 0):,} of {atoms:,} atoms of a frame")
    if cut:
        refuse_cut_line(rows[head:])
    return rows


class ExtxyzTrajectory(AseFrames, TextTrajectory):
    """Trajectory in extended XYZ format."""

    format = "extxyz"

    def _block(self, lines: Any) -> list[str] | None:
        head = lines.readline()
        if not head.strip():
            if any(line.strip() for line in lines):
                raise ValueError("found a blank line where the number of atoms of a frame was expected")
            return None
        return [head, *_rows(lines, 1, _whole_number(head, "the number of atoms"))]

    def _described(self, block: list[str]) -> AtomTable:
        return self._of_atoms(self._atoms_of(block))

    def _atoms_of(self, raw: Any) -> Any:
        from ase.io import read

        return with_elements(read(io.StringIO("".join(raw)), format=self.format))


class XdatcarTrajectory(ExtxyzTrajectory):
    """Trajectory in VASP's XDATCAR format. A change of the cell repeats the header."""

    format = "vasp-xdatcar"
    # lines with the cell and the atoms, and how many atoms there are
    _head: tuple[list[str], int] = ([], 0)

    def _block(self, lines: Any) -> list[str] | None:
        line = lines.readline()
        if "configuration=" not in line:
            # the name in its first line may be blank
            head = [line, *islice(lines, 6)]
            if not "".join(head).strip():
                return None
            self._head = head, sum(_whole_number(one, "a number of atoms") for one in head[-1].split())
            line = lines.readline()
        head, atoms = self._head
        return [*head, line, *_rows(lines, 0, atoms)]


# ---- LAMMPS

# unit styles (docs.lammps.org/units.html): length, time
_UNITS = {
    "lj": ("σ", "τ"), "real": ("Å", "fs"), "metal": ("Å", "ps"), "si": ("m", "s"), "cgs": ("cm", "s"),
    "electron": ("Bohr", "fs"), "micro": ("μm", "μs"), "nano": ("nm", "ns"),
}  # fmt: skip
# columns of positions, first choice first; the last two are fractions of the box
_COLUMNS = (("x", "y", "z"), ("xu", "yu", "zu"), ("xs", "ys", "zs"), ("xsu", "ysu", "zsu"))
_VELOCITIES = ("vx", "vy", "vz")
# worth of the last digit of a box from which on it is taken for a rounded one
_ROUNDED = 1e-4


class LammpsDump(TextTrajectory):
    """Trajectory in a LAMMPS text dump, with atoms sorted by id."""

    format = "lammpstrj"

    def _described(self, block: list[str]) -> AtomTable:
        items = _items(block)
        columns, rows = _atoms(items)
        units = items.get("UNITS")
        self.length, time = _UNITS.get(units[0].strip(), ("", "")) if units else ("", "")
        self.time = time if "TIME" in items else "step"
        if units is None:
            self.notes = ("The dump does not say its units (LAMMPS's dump_modify units yes writes them).",)
        if set(_VELOCITIES) <= set(columns) and "TIME" not in items:
            self.notes += (_NOT_READ.format(", ".join(_VELOCITIES), "dumps with dump_modify time yes"),)
        labels = _labels(columns, rows[self._order(0, columns, rows)])
        return AtomTable.plain(["X"] * len(rows) if labels is None else labels.tolist(), labels is not None)

    def decoded(self, number: int, raw: list[str]) -> Frame:
        items = _items(raw)
        columns, rows = _atoms(items)
        rows = rows[self._order(number, columns, rows)]
        box = _bounds(items)

        def numbers(names: tuple[str, ...]) -> Float[np.ndarray, "atoms 3"]:
            return rows[:, [columns.index(one) for one in names]].astype(np.float64)

        names = next((names for names in _COLUMNS if set(names) <= set(columns)), None)
        if names is None:
            seen = f"has no positions among its columns ({' '.join(columns)})"
            raise self._odd(number, seen, "Write the dump with the columns x y z, xu yu zu or xs ys zs")
        positions = numbers(names)
        if names[0].startswith("xs"):
            positions = box.origin + positions @ box.matrix
        timed = "TIME" in items
        velocities = numbers(_VELOCITIES) if timed and set(_VELOCITIES) <= set(columns) else None
        step = _whole_number(items["TIMESTEP"][0], "the time step")
        time = float(items["TIME"][0]) if timed else float(step)
        labels = _labels(columns, rows)
        return Frame(number, time, positions, box, velocities, labels, identified=True)

    def _order(self, number: int, columns: list[str], rows: np.ndarray) -> np.ndarray:
        """Return the indices that sort the rows by id. All frames must have the same ids."""
        if "id" not in columns:
            message = "the dump has no atom ids, but LAMMPS changes the order of atoms as they move"
            raise self._refused(message, "Write the dump with the column id")
        return self._by_id(number, rows[:, columns.index("id")].astype(np.int64))

    def _block(self, lines: Any) -> list[str] | None:
        block: list[str] = []
        atoms = None
        for line in lines:
            if not block and not line.strip():
                continue
            if not block and not line.startswith("ITEM:"):
                raise ValueError(f"expected a line that begins with ITEM:; found {line.strip()[:40]!r}")
            block.append(line)
            if line.startswith("ITEM: NUMBER OF ATOMS"):
                block.append(next(lines, ""))
                atoms = _whole_number(block[-1], "the number of atoms")
            elif line.startswith("ITEM: ATOMS"):
                if atoms is None:
                    raise ValueError("the section with the atoms of a frame comes before the number of atoms")
                return block + _rows(lines, 0, atoms)
        if block:
            raise ValueError("the file ends in the header of a frame")
        return None


def _labels(columns: list[str], rows: np.ndarray) -> np.ndarray | None:
    """Return the elements of the atoms, or their types. None if elements and types are missing."""
    name = next((one for one in ("element", "type") if one in columns), None)
    return None if name is None else rows[:, columns.index(name)].astype(str)


def _items(block: list[str]) -> dict[str, list[str]]:
    """Return the lines of a frame, in groups named by their ITEM headers."""
    items: dict[str, list[str]] = {}
    rows: list[str] = []
    for k, line in enumerate(block):
        if not line.startswith("ITEM:"):
            rows.append(line)
            continue
        words = line[5:].strip()
        name = next((name for name in ("BOX BOUNDS", "ATOMS") if words.startswith(name)), words)
        rows = items[name] = [words[len(name) :]] if name != words or name == "ATOMS" else []
        if name == "ATOMS":
            items[name] += block[k + 1 :]
            break
    return items


def _atoms(items: dict[str, list[str]]) -> tuple[list[str], np.ndarray]:
    """Return the column names, and the values as text, shape (atoms, columns)."""
    head, *rows = items["ATOMS"]
    columns = head.split()
    words = np.array("".join(rows).split(), dtype=object)
    if len(words) != len(rows) * len(columns):
        odd = next(row for row in rows if len(row.split()) != len(columns))
        raise ValueError(f"the line of an atom is {odd.strip()[:40]!r}; expected {len(columns)} columns")
    return columns, words.reshape(len(rows), len(columns))


def _bounds(items: dict[str, list[str]]) -> Box:
    """Return the box of a dump frame. The origin is a corner of the box."""
    head, *rows = items["BOX BOUNDS"]
    names, words = head.split(), [row.split() for row in rows[:3]]
    pbc, values = np.array([name == "pp" for name in names[-3:]], bool), np.array(words, np.float64)
    step = 0.0
    if np.isfinite(values).all():
        step = 10.0 ** min(int(Decimal(word).as_tuple().exponent) for row in words for word in row)
    # a box of few digits is not a rounded one, but was written by hand or never changes
    step = step if step <= _ROUNDED else 0.0
    if "abc" in names:
        # vectors in any direction; the corner is the fourth column
        return Box(values[:, :3], pbc, values[:, 3], step)
    xy, xz, yz = values[:, 2] if values.shape[1] > 2 else np.zeros(3)
    # the bounds of a tilted box are those of the box around it
    low = values[:, 0] - [min(0.0, xy, xz, xy + xz), min(0.0, yz), 0.0]
    size = values[:, 1] - [max(0.0, xy, xz, xy + xz), max(0.0, yz), 0.0] - low
    return Box(np.array([[size[0], 0, 0], [xy, size[1], 0], [xz, yz, size[2]]]), pbc, low, step)


# ---- GROMACS

_TIME = re.compile(r"\bt=\s*([-+0-9.eE]+)")
_HEAD = 20
_TOUCHING, _LONG = re.compile(r"-?\d+\.\d{5}"), 20
# the file has nm and nm/ps
_NANOMETER = 10.0


class GroTrajectory(TextTrajectory):
    """Trajectory in a GROMACS gro file, in Å and Å/ps."""

    format = "GRO"
    # numbers of the box in the frame before
    _box_words = 0

    def _described(self, block: list[str]) -> AtomTable:
        self.time = "ps" if _TIME.search(block[0]) else "frame"
        return AtomTable.of(topology_universe(self.path).atoms)

    def decoded(self, number: int, raw: list[str]) -> Frame:
        rows = [line.rstrip("\n") for line in raw[2:-1]]
        if not rows:
            raise ValueError("the frame has no atoms")
        points = [k for k, letter in enumerate(rows[0]) if letter == "." and k >= _HEAD]
        if len(points) < 3:
            raise ValueError(f"found the line {rows[0]!r}; expected three coordinates with a decimal point")
        width = points[1] - points[0]
        # one decimal more in the same width and one column more
        moving = all(len(row.rstrip()) >= _HEAD + 6 * width for row in rows)
        values = _fixed_columns(rows, width, 6 if moving else 3) * _NANOMETER
        found = _TIME.search(raw[0])
        time = float(found[1]) if found and self.time == "ps" else float(number)
        # residue and name; numbers are cut to five digits
        labels = np.array([row[5:15].strip() for row in rows])
        return Frame(
            number, time, values[:, :3], _gro_box(raw[-1]), values[:, 3:] if moving else None, labels
        )

    def _block(self, lines: Any) -> list[str] | None:
        title = lines.readline()
        if not title:
            return None
        count = lines.readline()
        if not title.strip() and not count.strip():
            return None
        rows = _rows(lines, 0, _whole_number(count, "the number of atoms"), cut=False)
        box = lines.readline()
        if not box.strip():
            raise ValueError("the file ends before the box of a frame")
        words = _box_words(box)
        if not box.endswith("\n"):
            refuse_cut_line([box], words[:-1])
            if len(words) < self._box_words:
                raise ValueError(f"the file ends in the box line of a frame, after {len(words)} numbers")
        self._box_words = len(words)
        return [title, count, *rows, box]


def _fixed_columns(rows: list[str], width: int, count: int) -> Float[np.ndarray, "atoms numbers"]:
    """Return the numbers in columns of fixed width. Spaces between columns are not needed."""
    size = _HEAD + count * width
    text = np.array([row[:size].ljust(size).encode() for row in rows], dtype=f"S{size}")
    letters = np.frombuffer(text.tobytes(), "S1").reshape(len(rows), size)[:, _HEAD:]
    return np.ascontiguousarray(letters).view(f"S{width}").astype(np.float64)


def _gro_box(line: str) -> Box:
    """Return the box from a line v1x v2y v3z or v1x v2y v3z v1y v1z v2x v2z v3x v3y. Zeros mean no box."""
    values = [float(word) * _NANOMETER for word in _box_words(line)]
    if len(values) not in (3, 9):
        raise ValueError(f"the box line of a frame has {len(values)} numbers; expected 3 or 9")
    if not any(values):
        return Box()
    xx, yy, zz, xy, xz, yx, yz, zx, zy = values if len(values) == 9 else [*values, *[0.0] * 6]
    return Box(np.array([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]]), np.array([xx, yy, zz]) != 0)


def _box_words(line: str) -> list[str]:
    """Split a box line into numbers with five decimals. Spaces between numbers may be missing."""
    return _TOUCHING.findall(line) if max(map(len, line.split())) > _LONG else line.split()
