"""Decisions as packed bits: eight slots to a byte, and the exclusive-or that finds the flips.

A step of a list with W*8 slots for each of C columns leaves a (W, C) array of bytes; slot k of column c
is bit k % 8 of byte [k // 8, c].
"""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Int, UInt8

_POPULATION = np.array([int(byte).bit_count() for byte in range(256)], np.int64)


@numba.njit(cache=True, nogil=True)
def _count_changed(before, now):
    total = 0
    for w in range(now.shape[0]):
        for c in range(now.shape[1]):
            total += _POPULATION[before[w, c] ^ now[w, c]]
    return total


@numba.njit(cache=True, nogil=True)
def _list_changed(before, now, slots, columns, values):
    at = 0
    for w in range(now.shape[0]):
        for c in range(now.shape[1]):
            changed = before[w, c] ^ now[w, c]
            if changed:
                for k in range(8):
                    if (changed >> k) & 1:
                        slots[at] = 8 * w + k
                        columns[at] = c
                        values[at] = (now[w, c] >> k) & 1
                        at += 1


def changed_bits(
    before: UInt8[np.ndarray, "words columns"], now: UInt8[np.ndarray, "words columns"]
) -> tuple[Int[np.ndarray, "flips"], Int[np.ndarray, "flips"], UInt8[np.ndarray, "flips"]]:
    """The slots whose decision differs between two steps of one list.

    Returns:
        slot, column and the decision now (1 yes, 0 no) of every changed bit, by slot word, column, bit.
    """
    count = _count_changed(before, now)
    slots = np.empty(count, np.int64)
    columns = np.empty(count, np.int64)
    values = np.empty(count, np.uint8)
    if count:
        _list_changed(before, now, slots, columns, values)
    return slots, columns, values


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
