"""Decisions as packed bits: eight slots to a byte, and the exclusive-or that finds the flips.

A step of a list with W*8 slots for each of C columns leaves a (W, C) array of bytes; slot k of column c
is bit k % 8 of byte [k // 8, c].
"""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Int, UInt8

_POPULATION = np.array([int(byte).bit_count() for byte in range(256)], np.int64)


# most bytes do not change: this many are looked at together before any is looked at alone
_BLOCK = 16


@numba.njit(cache=True, nogil=True)
def _scan_changed(before, now, first, places, values, write):
    """Count the changed bits of flat byte arrays; with write, also note byte * 8 + bit and the bit now."""
    at = first
    n = now.shape[0]
    for start in range(0, n, _BLOCK):
        end = min(start + _BLOCK, n)
        any_changed = np.uint8(0)
        for q in range(start, end):
            any_changed |= before[q] ^ now[q]
        if any_changed:
            for q in range(start, end):
                changed = before[q] ^ now[q]
                if changed and not write:
                    at += _POPULATION[changed]
                elif changed:
                    for k in range(8):
                        if (changed >> k) & 1:
                            places[at] = 8 * q + k
                            values[at] = (now[q] >> k) & 1
                            at += 1
    return at


@numba.njit(cache=True, nogil=True)
def _scan_rows(before, rows, ends, places, values, write):
    """`_scan_changed` from row to row; ends[r] is the number of changes up to and including row r."""
    at = 0
    for r in range(rows.shape[0]):
        at = _scan_changed(before if r == 0 else rows[r - 1], rows[r], at, places, values, write)
        ends[r] = at
    return at


def changes_in_time(
    before: UInt8[np.ndarray, "words columns"], rows: UInt8[np.ndarray, "rows words columns"]
) -> tuple[
    Int[np.ndarray, "flips"], Int[np.ndarray, "flips"], Int[np.ndarray, "flips"], UInt8[np.ndarray, "flips"]
]:
    """The decisions that differ from the row before, for consecutive rows of one list.

    Args:
        before: decisions ahead of the first row.
        rows: decisions of each row.

    Returns:
        row, slot, column and the decision now (1 yes, 0 no) of every change, by row, slot word, column, bit.
    """
    count, words, columns = rows.shape
    flat = np.ascontiguousarray(rows).reshape(count, words * columns)
    first = np.ascontiguousarray(before).ravel()
    ends = np.zeros(count, np.int64)
    total = _scan_rows(first, flat, ends, np.empty(0, np.int64), np.empty(0, np.uint8), False)
    places, values = np.empty(total, np.int64), np.empty(total, np.uint8)
    _scan_rows(first, flat, ends, places, values, True)
    word, column = np.divmod(places >> 3, max(columns, 1))
    row = np.repeat(np.arange(count), np.diff(ends, prepend=0))
    return row, 8 * word + (places & 7), column, values


def changed_bits(
    before: UInt8[np.ndarray, "words columns"], now: UInt8[np.ndarray, "words columns"]
) -> tuple[Int[np.ndarray, "flips"], Int[np.ndarray, "flips"], UInt8[np.ndarray, "flips"]]:
    """The slots whose decision differs between two steps of one list.

    Returns:
        slot, column and the decision now (1 yes, 0 no) of every changed bit, by slot word, column, bit.
    """
    _, slot, column, values = changes_in_time(before, now[None])
    return slot, column, values


def set_bits(
    packed: UInt8[np.ndarray, "words columns"],
) -> tuple[Int[np.ndarray, "set"], Int[np.ndarray, "set"]]:
    """Slot and column of every yes decision."""
    slots, columns, _ = changed_bits(np.zeros_like(packed), packed)
    return slots, columns


@numba.njit(cache=True, nogil=True)
def count_set(packed):
    """How many decisions of packed bytes (any number of columns) are yes."""
    total = 0
    for value in packed.ravel():
        total += _POPULATION[value]
    return total
