"""What a neighbor list gave, whatever form it has: brought into one, or told what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray

#: Names that the parts of an answer go by in mappings and attributes.
NAMES = {
    "i": ("i", "first", "centers", "idx_i", "senders"),
    "j": ("j", "second", "neighbors", "idx_j", "receivers"),
    "shift": ("shift", "shifts", "S", "cell_shifts"),
    "distance": ("distance", "distances", "d"),
    "vector": ("vector", "vectors", "D"),
}

_ROWS = "pairs one by one are to be tuples (i, j) in a list, or rows of an array"


class Malformed(Exception):
    """An answer that is no list of pairs; the message says why."""


@dataclass(frozen=True)
class Answer:
    """The rows that a list gave.

    Attributes:
        i, j: atoms, shape (rows,).
        shift: lattice vectors added to atom j, whole numbers of shape (rows, 3); None where it has none.
        distance: length, shape (rows,); None where it has none.
        vector: x_j - x_i of the image, length, shape (rows, 3); None where it has none.
    """

    i: ndarray
    j: ndarray
    shift: ndarray | None = None
    distance: ndarray | None = None
    vector: ndarray | None = None

    def __len__(self) -> int:
        return len(self.i)

    def same(self, other: Answer) -> bool:
        """Whether two answers have the same rows in the same order."""
        return all(
            mine is theirs if mine is None or theirs is None else np.array_equal(mine, theirs)
            for mine, theirs in (
                (self.i, other.i),
                (self.j, other.j),
                (self.shift, other.shift),
                (self.distance, other.distance),
                (self.vector, other.vector),
            )
        )


def read(given: Any) -> Answer:
    """The rows of what a list returned.

    It may return (i, j), (i, j, shift), (i, j, shift, distance), (i, j, shift, distance, vector), or any of
    these without the parts in between: a part of one number a row is a distance, the first of three whole
    numbers a row the shift, another of three the vector. Or a mapping, or an object with attributes, by the
    names i, j, shift, distance and vector. Or the pairs one by one: a list of tuples (i, j), or one array
    with a row (i, j) for each pair. A list of lists is parts, never pairs: some would look like both.

    Raises:
        Malformed: it is none of these.
    """
    parts = _parts(given)
    rows: dict[str, ndarray] = {}
    for name in ("i", "j"):
        rows[name] = _indices(parts[name], name)
    count = len(rows["i"])
    if len(rows["j"]) != count:
        raise Malformed(f"i has {count} entries and j has {len(rows['j'])}")
    for name, width in (("shift", 3), ("distance", 1), ("vector", 3)):
        if parts.get(name) is not None:
            rows[name] = _numbers(parts[name], name, count, width)
    if "shift" in rows:
        whole = np.rint(rows["shift"])
        if not np.array_equal(whole, rows["shift"]):
            raise Malformed("shifts are not whole numbers of lattice vectors")
        rows["shift"] = whole.astype(np.int64)
    return Answer(**rows)


def handed_out(given: Any) -> list[ndarray]:
    """The arrays of an answer as they lie in the list's memory, where they lie in an array at all.

    Raises:
        Malformed: it is no list of pairs.
    """
    # np.asarray of a tensor on the same device is a view of it, and of a list of numbers none
    return [np.asarray(part) for part in _parts(given).values() if hasattr(part, "__array__")]


def _parts(given: Any) -> dict[str, Any]:
    if given is None:
        raise Malformed("it returned None")
    if isinstance(given, Mapping):
        found = {
            name: next((given[word] for word in words if word in given), None)
            for name, words in NAMES.items()
        }
    elif isinstance(given, list) and all(isinstance(row, tuple) for row in given):
        return _one_by_one(given)
    elif isinstance(given, Sequence) and not isinstance(given, str):
        return _in_order([_array(part, f"part {n + 1}") for n, part in enumerate(given)])
    elif hasattr(given, "i") and hasattr(given, "j"):
        found = {
            name: next((getattr(given, word) for word in words if hasattr(given, word)), None)
            for name, words in NAMES.items()
        }
    else:
        return _one_by_one(given)
    if found["i"] is None or found["j"] is None:
        raise Malformed("it has no i and j")
    return found


def _one_by_one(given: Any) -> dict[str, Any]:
    """Rows (i, j); none at all where nothing is given."""
    table = _array(given, "the answer")
    if table.size == 0 and table.ndim:
        return {"i": np.zeros(0, np.int64), "j": np.zeros(0, np.int64)}
    if table.ndim != 2 or table.shape[1] != 2:
        raise Malformed(
            f"it returned {type(given).__name__} of shape {table.shape}, not (i, j), (i, j, shift), ..., a "
            "mapping with i and j, or a row (i, j) for each pair"
        )
    return {"i": table[:, 0], "j": table[:, 1]}


def _in_order(parts: list[ndarray]) -> dict[str, Any]:
    """Parts of a tuple by their places and shapes."""
    if not 2 <= len(parts) <= 5:
        raise Malformed(f"it returned {len(parts)} parts, not (i, j), (i, j, shift), ...; {_ROWS}")
    found: dict[str, Any] = {"i": parts[0], "j": parts[1]}
    if len(parts) == 2 and parts[0].ndim == 2 and parts[0].shape[0] == 2:
        # an edge index of shape (2, rows) with shifts
        return {"i": parts[0][0], "j": parts[0][1], "shift": parts[1]}
    for part in parts[2:]:
        if part.ndim <= 1:
            name = "distance"
        elif "shift" not in found and np.array_equal(np.rint(part), part):
            name = "shift"
        else:
            name = "vector"
        if name in found:
            raise Malformed(f"two of its parts look like a {name}; return a mapping with names instead")
        if name == "distance" and part.size and part.dtype.kind in "iu":
            raise Malformed(f"the distances are whole numbers; {_ROWS}")
        found[name] = part
    return found


def _array(part: Any, name: str) -> ndarray:
    try:
        array = np.asarray(part)
    except Exception as error:  # ragged rows, arrays on other devices
        raise Malformed(f"{name} is no array ({type(error).__name__}: {error})") from error
    if array.dtype == object:
        raise Malformed(f"{name} is no array of numbers but {type(part).__name__}")
    return array


def _indices(part: Any, name: str) -> ndarray:
    array = _array(part, name)
    if array.size == 0:
        return np.zeros(0, np.int64)
    if array.ndim != 1:
        raise Malformed(f"{name} has shape {array.shape}, not one entry for each pair")
    if array.dtype.kind not in "iu":
        raise Malformed(f"{name} has dtype {array.dtype}, not whole numbers")
    return array.astype(np.int64)


def _numbers(part: Any, name: str, count: int, width: int) -> ndarray:
    array = _array(part, name)
    wanted = (count,) if width == 1 else (count, width)
    if array.size == 0 and count == 0:
        return np.zeros(wanted)
    if array.shape != wanted:
        raise Malformed(f"{name} has shape {array.shape} where i has {count} entries")
    if array.dtype.kind not in "iuf":
        raise Malformed(f"{name} has dtype {array.dtype}, not real numbers")
    return array.astype(np.float64)
