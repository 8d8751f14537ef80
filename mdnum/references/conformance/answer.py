"""Convert the pairs that a neighbor list returns to named arrays.

This file is copied into the scripts that reproduce a failure. The file requires only numpy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

#: Names of the entries of an answer, as keys of a mapping and as attributes.
NAMES = {
    "i": ("i", "first", "centers", "idx_i", "senders"),
    "j": ("j", "second", "neighbors", "idx_j", "receivers"),
    "shift": ("shift", "shifts", "S", "cell_shifts"),
    "distance": ("distance", "distances", "d"),
    "vector": ("vector", "vectors", "D"),
}
_ROWS = "pairs one by one are to be tuples (i, j) in a list, or rows of an array"


class Malformed(Exception):
    """Raised if a neighbor list returns a value that is not a list of pairs."""


@dataclass(frozen=True)
class ListAnswer:
    """Pairs returned by a neighbor list, one pair per row."""

    # i, j: atoms, shape (rows,)
    i: np.ndarray
    j: np.ndarray
    # lattice vectors added to atom j, integers of shape (rows, 3); None where it has none
    shift: np.ndarray | None = None
    distance: np.ndarray | None = None  # length, shape (rows,); None where it has none
    # x_j - x_i of the image, length, shape (rows, 3); None where it has none
    vector: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.i)

    def same(self, other: ListAnswer) -> bool:
        """Return whether two lists have the same pairs in the same order."""
        return all(map(np.array_equal, vars(self).values(), vars(other).values()))


def read(given: Any) -> ListAnswer:
    """Return the pairs in a neighbor list's return value as a `ListAnswer`.

    A neighbor list may return (i, j), (i, j, shift), (i, j, shift, distance) or (i, j, shift, distance,
    vector). A subset of the optional arrays is also accepted. The arrays are recognized by shape. An array
    with one number per row contains distances. The first array with three integers per row contains shifts.
    Another array with three numbers per row contains vectors. A mapping with the keys i, j, shift, distance
    and vector is also accepted, or an object with these attributes. A list of tuples (i, j) is accepted, too,
    or one array with a row (i, j) for each pair. A Python list of lists is always read as arrays, not as
    pairs.

    Raises:
        Malformed: the value has none of the supported forms.
    """
    given = parts(given)
    i, j = _indices(given["i"], "i"), _indices(given["j"], "j")
    if len(j) != len(i):
        raise Malformed(f"i has {len(i)} entries and j has {len(j)}")
    rows = {
        name: _numbers(given[name], name, (len(i), 3) if name != "distance" else (len(i),))
        for name in ("shift", "distance", "vector")
        if given.get(name) is not None
    }
    if "shift" in rows:
        whole = np.rint(rows["shift"])
        if not np.array_equal(whole, rows["shift"]):
            raise Malformed("shifts are not whole numbers of lattice vectors")
        rows["shift"] = whole.astype(np.int64)
    return ListAnswer(i, j, **rows)


def parts(given: Any) -> dict[str, Any]:
    """Return the arrays in the result of a neighbor list, named as in `ListAnswer`.

    Raises:
        Malformed: the value is not a list of pairs.
    """
    if given is None:
        raise Malformed("it returned None")
    if isinstance(given, list) and all(isinstance(row, tuple) for row in given):
        return _one_by_one(given)
    if isinstance(given, Sequence) and not isinstance(given, str):
        return _in_order([_array(part, f"part {n + 1}") for n, part in enumerate(given)])
    if not isinstance(given, Mapping):
        if not (hasattr(given, "i") and hasattr(given, "j")):
            return _one_by_one(given)
        given = {key: getattr(given, key) for keys in NAMES.values() for key in keys if hasattr(given, key)}
    named = {name: next((given[key] for key in keys if key in given), None) for name, keys in NAMES.items()}
    if named["i"] is None or named["j"] is None:
        raise Malformed("it has no i and j")
    return named


def _one_by_one(given: Any) -> dict[str, Any]:
    """Return the arrays i and j from rows (i, j)."""
    table = _array(given, "the answer")
    if table.size == 0 and table.ndim:
        table = np.zeros((0, 2), np.int64)
    if table.ndim != 2 or table.shape[1] != 2:
        raise Malformed(
            f"it returned {type(given).__name__} of shape {table.shape}, not (i, j), (i, j, shift), ..., a "
            "mapping with i and j, or a row (i, j) for each pair"
        )
    return {"i": table[:, 0], "j": table[:, 1]}


def _in_order(arrays: list[np.ndarray]) -> dict[str, Any]:
    """Identify the arrays of a returned tuple by their position and shape."""
    if not 2 <= len(arrays) <= 5:
        raise Malformed(f"it returned {len(arrays)} parts, not (i, j), (i, j, shift), ...; {_ROWS}")
    first, second = arrays[:2]
    if len(arrays) == 2 and first.ndim == 2 and first.shape[0] == 2:
        # an edge index of shape (2, rows) with shifts
        return {"i": first[0], "j": first[1], "shift": second}
    named: dict[str, Any] = {"i": first, "j": second}
    for part in arrays[2:]:
        whole = part.ndim > 1 and "shift" not in named and np.array_equal(np.rint(part), part)
        name = "distance" if part.ndim <= 1 else "shift" if whole else "vector"
        if name in named:
            raise Malformed(f"two of its parts look like a {name}; return a mapping with names instead")
        if name == "distance" and part.size and part.dtype.kind in "iu":
            raise Malformed(f"the distances are whole numbers; {_ROWS}")
        named[name] = part
    return named


def _array(part: Any, name: str) -> np.ndarray:
    try:
        array = np.asarray(part)
    except Exception as error:  # ragged rows, arrays on other devices
        raise Malformed(f"{name} is no array ({type(error).__name__}: {error})") from error
    if array.dtype == object:
        raise Malformed(f"{name} is no array of numbers but {type(part).__name__}")
    return array


def _indices(part: Any, name: str) -> np.ndarray:
    array = _array(part, name)
    if array.size == 0:
        return np.zeros(0, np.int64)
    if array.ndim != 1:
        raise Malformed(f"{name} has shape {array.shape}, not one entry for each pair")
    if array.dtype.kind not in "iu":
        raise Malformed(f"{name} has dtype {array.dtype}, not whole numbers")
    return array.astype(np.int64)


def _numbers(part: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    array = _array(part, name)
    if array.size == 0 and shape[0] == 0:
        return np.zeros(shape)
    if array.shape != shape:
        raise Malformed(f"{name} has shape {array.shape} where i has {shape[0]} entries")
    if array.dtype.kind not in "iuf":
        raise Malformed(f"{name} has dtype {array.dtype}, not real numbers")
    return array.astype(np.float64)
