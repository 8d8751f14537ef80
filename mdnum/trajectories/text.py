"""Trajectories that are text, one block of lines a frame: read block by block, every digit kept.

- LAMMPS's `dump custom` and `dump atom`, with columns x, xu, xs or xsu (docs.lammps.org/dump.html,
  Howto_triclinic): MDAnalysis narrows them to float32 and takes a tilted box without its tilt;
- GROMACS's gro files with any number of frames, in columns as wide as the distance of two points
  (manual.gromacs.org, reference manual, file formats): MDAnalysis and ASE read the first alone;
- extended XYZ, each block through ASE, which would otherwise look at the whole file before the first frame.
"""

from __future__ import annotations

import io
import re
from abc import abstractmethod
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mdnum.errors import InputError
from mdnum.trajectories.ase_source import AseFrames
from mdnum.trajectories.frame import Box, Frame, FrameError
from mdnum.trajectories.tails import refuse_cut_line
from mdnum.trajectories.topology import AtomTable, table_of_topology
from mdnum.trajectories.trajectory import Trajectory


class TextTrajectory(Trajectory):
    """A text file of frames. A reader of a format says where a block ends and what is in it."""

    # what lines that are no frame raise
    _fails = (ValueError, IndexError, KeyError)

    def __init__(self, path: Path, topology: str | Path | None, frames: slice):
        super().__init__(path, topology, frames)
        number, block = self._first()
        try:
            atoms = len(self._frame(number, block).positions)
            table = self._described(block)
        except self._fails as error:
            raise self._unreadable(0, error) from error
        self._has(atoms, table)

    @abstractmethod
    def _block(self, lines: Any) -> list[str] | None:
        """The lines of the next frame; None at the end of the file.

        Raises:
            ValueError: the lines are not what a frame consists of.
        """

    @abstractmethod
    def _described(self, block: list[str]) -> AtomTable:
        """What the first frame says of its atoms."""

    def _raw(self, numbers: Iterator[int]) -> Iterator[tuple[int, list[str]]]:
        from ase.io.formats import open_with_compression

        wanted = next(numbers, None)
        with open_with_compression(str(self.path), "r") as lines:
            number = 0
            while wanted is not None:
                try:
                    block = self._block(lines)
                except (ValueError, IndexError, OSError, EOFError) as error:
                    raise self._unreadable(number, error) from error
                if block is None:
                    return
                if number == wanted:
                    yield number, block
                    wanted = next(numbers, None)
                number += 1


def _whole_number(line: str, what: str) -> int:
    try:
        return int(line)
    except ValueError:
        raise ValueError(f"{line.strip()[:40]!r} where {what} is expected") from None


def _rows(lines: Any, head: int, atoms: int, cut: bool = True) -> list[str]:
    """The lines of so many atoms, behind some others."""
    rows = list(islice(lines, head + atoms))
    if len(rows) < head + atoms:
        raise ValueError(f"the file ends after {max(len(rows) - head, 0):,} of {atoms:,} atoms")
    if cut:
        refuse_cut_line(rows[head:])
    return rows


class ExtxyzTrajectory(AseFrames, TextTrajectory):
    """Extended XYZ."""

    format = "extxyz"
    # ASE's readers raise what they like
    _fails = (Exception,)

    def _block(self, lines: Any) -> list[str] | None:
        head = lines.readline()
        if not head.strip():
            if any(line.strip() for line in lines):
                raise ValueError("a blank line where the number of atoms is expected")
            return None
        return [head, *_rows(lines, 1, _whole_number(head, "the number of atoms"))]

    def _described(self, block: list[str]) -> AtomTable:
        return self._of_atoms(self._atoms_of(block))

    def _atoms_of(self, raw: Any) -> Any:
        from ase.io import read

        return read(io.StringIO("".join(raw)), format="extxyz")


# ---- LAMMPS

# unit styles (docs.lammps.org/units.html): length, time
_UNITS = {
    "lj": ("σ", "τ"), "real": ("Å", "fs"), "metal": ("Å", "ps"), "si": ("m", "s"), "cgs": ("cm", "s"),
    "electron": ("Bohr", "fs"), "micro": ("μm", "μs"), "nano": ("nm", "ns"),
}  # fmt: skip
# columns of positions, first choice first; the last two are fractions of the box
_COLUMNS = (("x", "y", "z"), ("xu", "yu", "zu"), ("xs", "ys", "zs"), ("xsu", "ysu", "zsu"))
_VELOCITIES = ("vx", "vy", "vz")


class LammpsDump(TextTrajectory):
    """A text dump of LAMMPS. Atoms are in the order of their ids."""

    format = "lammpstrj"
    _ids: np.ndarray | None = None

    def _described(self, block: list[str]) -> AtomTable:
        items = _items(block)
        columns, rows = _atoms(items)
        units = items.get("UNITS")
        self.length, time = _UNITS.get(units[0].strip(), ("", "")) if units else ("", "")
        self.time = time if "TIME" in items else "step"
        if units is None:
            self.notes = ("The dump does not say its units (LAMMPS's dump_modify units yes writes them).",)
        labels = _labels(columns, rows[self._order(0, columns, rows)])
        return AtomTable.plain(["X"] * len(rows) if labels is None else labels.tolist(), labels is not None)

    def _frame(self, number: int, raw: list[str]) -> Frame:
        items = _items(raw)
        columns, rows = _atoms(items)
        rows = rows[self._order(number, columns, rows)]
        matrix, pbc = _bounds(items)

        def numbers(names: tuple[str, ...]) -> Float[np.ndarray, "atoms 3"]:
            return rows[:, [columns.index(one) for one in names]].astype(np.float64)

        names = next((names for names in _COLUMNS if set(names) <= set(columns)), None)
        if names is None:
            raise FrameError(
                f"frame {number} has no positions among its columns ({' '.join(columns)})",
                remedy="Dump x y z, xu yu zu or xs ys zs",
                where=str(self.path),
                frame=number,
            )
        positions = numbers(names)
        if names[0].startswith("xs"):
            # from the box's corner: it moves as the box breathes, and would hide the digits
            positions = positions @ matrix
        timed = "TIME" in items
        velocities = numbers(_VELOCITIES) if timed and set(_VELOCITIES) <= set(columns) else None
        step = _whole_number(items["TIMESTEP"][0], "the time step")
        time = float(items["TIME"][0]) if timed else float(step)
        return Frame(number, time, positions, Box(matrix, pbc), velocities, _labels(columns, rows))

    def _order(self, number: int, columns: list[str], rows: np.ndarray) -> np.ndarray:
        """The rows in the order of their ids, which are those of the first frame."""
        if "id" not in columns:
            raise InputError(
                "the dump has no ids, and LAMMPS changes the order of atoms as they move",
                remedy="Dump the column id",
                where=str(self.path),
            )
        ids = rows[:, columns.index("id")].astype(np.int64)
        order = np.argsort(ids, kind="stable")
        known = self._ids = ids[order] if self._ids is None else self._ids
        if not np.array_equal(known, ids[order]):
            lost = np.setdiff1d(known, ids)
            seen = f"lacks atom {lost[0]}" if len(lost) else "has other atoms"
            raise FrameError(
                f"frame {number} {seen} of the first frame: {len(rows):,} atoms, and {len(known):,} there",
                remedy="Dump one group of atoms that stays the same",
                where=str(self.path),
                frame=number,
            )
        return order

    def _block(self, lines: Any) -> list[str] | None:
        block: list[str] = []
        atoms = None
        for line in lines:
            if not block and not line.strip():
                continue
            if not block and not line.startswith("ITEM:"):
                raise ValueError(f"{line.strip()[:40]!r} where ITEM: is expected")
            block.append(line)
            if line.startswith("ITEM: NUMBER OF ATOMS"):
                block.append(next(lines, ""))
                atoms = _whole_number(block[-1], "the number of atoms")
            elif line.startswith("ITEM: ATOMS"):
                if atoms is None:
                    raise ValueError("atoms before their number")
                return block + _rows(lines, 0, atoms)
        if block:
            raise ValueError("the file ends in the head of a frame")
        return None


def _labels(columns: list[str], rows: np.ndarray) -> np.ndarray | None:
    """Elements of the atoms, else their types; None where the dump has neither."""
    name = next((one for one in ("element", "type") if one in columns), None)
    return None if name is None else rows[:, columns.index(name)].astype(str)


def _items(block: list[str]) -> dict[str, list[str]]:
    """Lines by the words of their item; the box and the columns keep their head line as the first."""
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
    """Names of the columns, and the words of every atom, shape (atoms, columns)."""
    head, *rows = items["ATOMS"]
    columns = head.split()
    words = np.array("".join(rows).split(), dtype=object)
    if len(words) != len(rows) * len(columns):
        odd = next(row for row in rows if len(row.split()) != len(columns))
        raise ValueError(f"{odd.strip()[:40]!r} where {len(columns)} columns are expected")
    return columns, words.reshape(len(rows), len(columns))


def _bounds(items: dict[str, list[str]]) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, "3"]]:
    """Lattice vectors, and which directions repeat."""
    head, *rows = items["BOX BOUNDS"]
    words = head.split()
    pbc = np.array([word == "pp" for word in words[-3:]], bool)
    values = np.array([row.split() for row in rows[:3]], np.float64)
    if "abc" in words:
        # vectors in any direction; the corner is the fourth column
        return values[:, :3], pbc
    xy, xz, yz = values[:, 2] if values.shape[1] > 2 else np.zeros(3)
    # the bounds of a tilted box are those of the box around it
    low = values[:, 0] - [min(0.0, xy, xz, xy + xz), min(0.0, yz), 0.0]
    size = values[:, 1] - [max(0.0, xy, xz, xy + xz), max(0.0, yz), 0.0] - low
    return np.array([[size[0], 0, 0], [xy, size[1], 0], [xz, yz, size[2]]]), pbc


# ---- GROMACS

_TIME = re.compile(r"\bt=\s*([-+0-9.eE]+)")
_HEAD = 20
_TOUCHING, _LONG = re.compile(r"-?\d+\.\d{5}"), 20
# the file has nm and nm/ps
_NANOMETER = 10.0


class GroTrajectory(TextTrajectory):
    """A gro file, in Å and Å/ps as MDAnalysis has it."""

    format = "GRO"
    # numbers of the box in the frame before
    _box_words = 0

    def _described(self, block: list[str]) -> AtomTable:
        self.time = "ps" if _TIME.search(block[0]) else "frame"
        return table_of_topology(self.path)

    def _frame(self, number: int, raw: list[str]) -> Frame:
        rows = [line.rstrip("\n") for line in raw[2:-1]]
        if not rows:
            raise ValueError("no atoms")
        points = [k for k, letter in enumerate(rows[0]) if letter == "." and k >= _HEAD]
        if len(points) < 3:
            raise ValueError(f"no three numbers in {rows[0]!r}")
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
            raise ValueError("the file ends before the box")
        words = _box_words(box)
        if not box.endswith("\n"):
            refuse_cut_line([box], words[:-1])
            if len(words) < self._box_words:
                raise ValueError(f"the file ends after {len(words)} numbers of the box")
        self._box_words = len(words)
        return [title, count, *rows, box]


def _fixed_columns(rows: list[str], width: int, count: int) -> Float[np.ndarray, "atoms numbers"]:
    """The numbers in fixed columns, which may touch one another."""
    size = _HEAD + count * width
    text = np.array([row[:size].ljust(size).encode() for row in rows], dtype=f"S{size}")
    letters = np.frombuffer(text.tobytes(), "S1").reshape(len(rows), size)[:, _HEAD:]
    return np.ascontiguousarray(letters).view(f"S{width}").astype(np.float64)


def _gro_box(line: str) -> Box:
    """Three diagonal elements, or nine: v1x v2y v3z v1y v1z v2x v2z v3x v3y; zeros for no box."""
    values = [float(word) * _NANOMETER for word in _box_words(line)]
    if len(values) not in (3, 9):
        raise ValueError(f"a box of {len(values)} numbers")
    if not any(values):
        return Box()
    xx, yy, zz, xy, xz, yx, yz, zx, zy = values if len(values) == 9 else [*values, *[0.0] * 6]
    return Box(np.array([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]]), np.array([xx, yy, zz]) != 0)


def _box_words(line: str) -> list[str]:
    """The numbers of a box; five decimals, between which boxes of 10 µm and more leave no room."""
    return _TOUCHING.findall(line) if max(map(len, line.split())) > _LONG else line.split()
