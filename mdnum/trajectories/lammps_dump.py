"""LAMMPS's text dumps: every digit, boxes with any tilt, and which directions repeat.

Of `dump custom` and `dump atom`, with columns x, xu, xs or xsu (docs.lammps.org/dump.html, Howto_triclinic).
"""

from __future__ import annotations

from io import TextIOBase
from itertools import islice

import numpy as np
from jaxtyping import Bool, Float

from mdnum.errors import InputError
from mdnum.trajectories.blocks import TextTrajectory, end_of, whole_number
from mdnum.trajectories.checked import FrameError
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.source import AtomTable
from mdnum.trajectories.tails import refuse_cut_line

# unit styles (docs.lammps.org/units.html): length, time
_UNITS = {
    "lj": ("σ", "τ"),
    "real": ("Å", "fs"),
    "metal": ("Å", "ps"),
    "si": ("m", "s"),
    "cgs": ("cm", "s"),
    "electron": ("Bohr", "fs"),
    "micro": ("μm", "μs"),
    "nano": ("nm", "ns"),
}
# columns of positions, first choice first; the last two are fractions of the box
_COLUMNS = (("x", "y", "z"), ("xu", "yu", "zu"), ("xs", "ys", "zs"), ("xsu", "ysu", "zsu"))
_VELOCITIES = ("vx", "vy", "vz")


class LammpsDump(TextTrajectory):
    """A text dump of LAMMPS. Atoms are in the order of their ids."""

    format = "lammpstrj"
    _ids: np.ndarray | None = None

    def _told(self, number: int, block: list[str]) -> AtomTable:
        items = _items(block)
        columns, rows = _atoms(items)
        order = self._order(number, columns, rows)
        units = items.get("UNITS")
        self.length, time = _UNITS.get(units[0].strip(), ("", "")) if units else ("", "")
        self.time = time if "TIME" in items else "step"
        if units is None:
            self.notes = ("The dump does not say its units (LAMMPS's dump_modify units yes writes them).",)
        labels = _labels(columns, rows[order])
        if labels is None:
            return AtomTable.plain(["X"] * len(rows), named=False)
        return AtomTable.plain([str(one) for one in labels])

    def _frame(self, number: int, block: list[str]) -> Frame:
        items = _items(block)
        columns, rows = _atoms(items)
        rows = rows[self._order(number, columns, rows)]
        matrix, pbc = _box(items)
        positions = velocities = None
        for names in _COLUMNS:
            if set(names) <= set(columns):
                positions = _numbers(rows, columns, names)
                if names[0].startswith("xs"):
                    # from the box's corner: it moves as the box breathes, and would hide the digits
                    positions = positions @ matrix
                break
        if positions is None:
            raise FrameError(
                f"frame {number} has no positions among its columns ({' '.join(columns)})",
                remedy="Dump x y z, xu yu zu or xs ys zs",
                where=str(self.path),
                frame=number,
            )
        step = whole_number(items["TIMESTEP"][0], "the time step")
        if "TIME" in items and set(_VELOCITIES) <= set(columns):
            velocities = _numbers(rows, columns, _VELOCITIES)
        time = float(items["TIME"][0]) if "TIME" in items else float(step)
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

    def _block(self, lines: TextIOBase) -> list[str] | None:
        block: list[str] = []
        atoms = None
        for line in lines:
            if not block and not line.strip():
                continue
            if not line.startswith("ITEM:"):
                if not block:
                    raise ValueError(f"{line.strip()[:40]!r} where ITEM: is expected")
                block.append(line)
                continue
            block.append(line)
            if line.startswith("ITEM: NUMBER OF ATOMS"):
                block.append(next(lines, ""))
                atoms = whole_number(block[-1], "the number of atoms")
            elif line.startswith("ITEM: ATOMS"):
                if atoms is None:
                    raise ValueError("atoms before their number")
                rows = list(islice(lines, atoms))
                end_of(rows, atoms)
                refuse_cut_line(rows)
                return block + rows
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
        for name in ("BOX BOUNDS", "ATOMS"):
            if words.startswith(name):
                rows = items[name] = [words[len(name) :]]
                break
        else:
            rows = items[words] = []
        if words.startswith("ATOMS"):
            items["ATOMS"] += block[k + 1 :]
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


def _numbers(rows: np.ndarray, columns: list[str], names: tuple[str, ...]) -> Float[np.ndarray, "atoms 3"]:
    return rows[:, [columns.index(one) for one in names]].astype(np.float64)


def _box(items: dict[str, list[str]]) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, "3"]]:
    """Lattice vectors, and which directions repeat."""
    head, *rows = items["BOX BOUNDS"]
    words = head.split()
    pbc = np.array([word == "pp" for word in words[-3:]], bool)
    values = np.array([row.split() for row in rows[:3]], np.float64)
    if "abc" in words:
        # vectors in any direction; the corner is the fourth column
        return values[:, :3], pbc
    low, high = values[:, 0], values[:, 1]
    xy, xz, yz = values[:, 2] if values.shape[1] > 2 else np.zeros(3)
    # the bounds of a tilted box are those of the box around it
    low = low - [min(0.0, xy, xz, xy + xz), min(0.0, yz), 0.0]
    high = high - [max(0.0, xy, xz, xy + xz), max(0.0, yz), 0.0]
    size = high - low
    return np.array([[size[0], 0, 0], [xy, size[1], 0], [xz, yz, size[2]]]), pbc
