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
def _scan_changed(before, now, places, values, write):
    """Count the changed bits of flat byte arrays; with write, also note byte * 8 + bit and the bit now."""
    at = 0
    n = now.shape[0]
    for first in range(0, n, _BLOCK):
        last = min(first + _BLOCK, n)
        any_changed = np.uint8(0)
        for q in range(first, last):
            any_changed |= before[q] ^ now[q]
        if any_changed:
            for q in range(first, last):
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


def changed_bits(
    before: UInt8[np.ndarray, "words columns"], now: UInt8[np.ndarray, "words columns"]
) -> tuple[Int[np.ndarray, "flips"], Int[np.ndarray, "flips"], UInt8[np.ndarray, "flips"]]:
    """The slots whose decision differs between two steps of one list.

    Returns:
        slot, column and the decision now (1 yes, 0 no) of every changed bit, by slot word, column, bit.
    """
    old, new = np.ascontiguousarray(before).ravel(), np.ascontiguousarray(now).ravel()
    none, no_values = np.empty(0, np.int64), np.empty(0, np.uint8)
    count = _scan_changed(old, new, none, no_values, False)
    places, values = np.empty(count, np.int64), np.empty(count, np.uint8)
    _scan_changed(old, new, places, values, True)
    byte, bit = np.divmod(places, 8)
    word, column = np.divmod(byte, now.shape[1]) if now.shape[1] else (byte, byte)
    return 8 * word + bit, column, values


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
