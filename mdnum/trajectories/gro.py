"""GROMACS's gro files with any number of frames: MDAnalysis reads the first alone, and without a word.

Fixed columns (manual.gromacs.org/current/reference-manual/file-formats.html#gro), as wide as the distance
between two points.
"""

from __future__ import annotations

import re
from io import TextIOBase
from itertools import islice

import numpy as np
from jaxtyping import Float

from mdnum.trajectories.blocks import TextTrajectory, end_of, whole_number
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.source import AtomTable, table_of_topology
from mdnum.trajectories.tails import refuse_cut_line

_TIME = re.compile(r"\bt=\s*([-+0-9.eE]+)")
_HEAD = 20
_TOUCHING, _LONG = re.compile(r"-?\d+\.\d{5}"), 20
# the file has nm and nm/ps
_NANOMETER = 10.0


class GroTrajectory(TextTrajectory):
    """A gro file, in Å and Å/ps as MDAnalysis has it."""

    format = "GRO"
    length = "Å"
    # numbers of the box in the frame before
    _box_words = 0

    def _told(self, number: int, block: list[str]) -> AtomTable:
        self.time = "ps" if _TIME.search(block[0]) else "frame"
        return table_of_topology(self.path)

    def _frame(self, number: int, block: list[str]) -> Frame:
        rows = [line.rstrip("\n") for line in block[2:-1]]
        if not rows:
            raise ValueError("no atoms")
        points = [k for k, letter in enumerate(rows[0]) if letter == "." and k >= _HEAD]
        if len(points) < 3:
            raise ValueError(f"no three numbers in {rows[0]!r}")
        width = points[1] - points[0]
        values = _columns(rows, width, 3)
        velocities = None
        if all(len(row.rstrip()) >= _HEAD + 6 * width for row in rows):
            # one decimal more in the same width and one column more
            velocities = _columns(rows, width, 6)[:, 3:] * _NANOMETER
        found = _TIME.search(block[0])
        time = float(found[1]) if found and self.time == "ps" else float(number)
        # residue and name; numbers are cut to five digits
        labels = np.array([row[5:15].strip() for row in rows])
        return Frame(number, time, values * _NANOMETER, _box(block[-1]), velocities, labels)

    def _block(self, lines: TextIOBase) -> list[str] | None:
        title = lines.readline()
        if not title:
            return None
        count = lines.readline()
        if not title.strip() and not count.strip():
            return None
        atoms = whole_number(count, "the number of atoms")
        rows = list(islice(lines, atoms))
        end_of(rows, atoms)
        box = lines.readline()
        if not box.strip():
            raise ValueError("the file ends before the box")
        if not box.endswith("\n"):
            words = _words(box)
            refuse_cut_line([box], words[:-1])
            if len(words) < self._box_words:
                raise ValueError(f"the file ends after {len(words)} numbers of the box")
        self._box_words = len(_words(box))
        return [title, count, *rows, box]


def _columns(rows: list[str], width: int, count: int) -> Float[np.ndarray, "atoms numbers"]:
    """The numbers in fixed columns, which may touch one another."""
    size = _HEAD + count * width
    text = np.array([row[:size].ljust(size).encode() for row in rows], dtype=f"S{size}")
    letters = np.frombuffer(text.tobytes(), "S1").reshape(len(rows), size)[:, _HEAD:]
    words = np.ascontiguousarray(letters).view(f"S{width}")
    return words.astype(np.float64)


def _box(line: str) -> Box:
    """Three diagonal elements, or nine: v1x v2y v3z v1y v1z v2x v2z v3x v3y; zeros for no box."""
    values = [float(word) * _NANOMETER for word in _words(line)]
    if len(values) not in (3, 9):
        raise ValueError(f"a box of {len(values)} numbers")
    if not any(values):
        return Box()
    xx, yy, zz, xy, xz, yx, yz, zx, zy = values if len(values) == 9 else [*values, *[0.0] * 6]
    matrix = np.array([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]])
    return Box(matrix, np.array([xx, yy, zz]) != 0)


def _words(line: str) -> list[str]:
    """The numbers of a box, as written."""
    # five decimals, which boxes of 10 µm and more leave no room between
    return _TOUCHING.findall(line) if max(map(len, line.split())) > _LONG else line.split()
