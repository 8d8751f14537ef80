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
def _scan(rows, columns, row, slot, column, values):
    """Note the bits that change from row to row; returns their number, of which those that fit are noted.

    rows holds 64 decisions to a word; most words do not change, and those cost one comparison.
    """
    at, room = 0, row.shape[0]
    for r in range(1, rows.shape[0]):
        for w in range(rows.shape[1]):
            changed = rows[r, w] ^ rows[r - 1, w]
            if changed:
                now = rows[r, w]
                for byte in range(8):
                    bits = (changed >> np.uint64(8 * byte)) & np.uint64(255)
                    if bits and at + 8 > room:
                        at += _POPULATION[bits]
                    elif bits:
                        place = 8 * w + byte
                        for k in range(8):
                            if (bits >> np.uint64(k)) & np.uint64(1):
                                row[at] = r - 1
                                slot[at] = 8 * (place // columns) + k
                                column[at] = place % columns
                                values[at] = (now >> np.uint64(8 * byte + k)) & np.uint64(1)
                                at += 1
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
    size = words * columns
    padded = np.zeros((count + 1, -(-size // 8) * 8), np.uint8)
    padded[0, :size] = before.reshape(-1)
    padded[1:, :size] = rows.reshape(count, size)
    # on a big-endian machine the bytes of a word would be met in the other order
    wide = padded.view("<u8").astype(np.uint64, copy=False)
    # rarely too little; where it is, the count says how much is needed
    room = wide.size // 4 + 64
    while True:
        row, slot, column = (np.empty(room, np.int64) for _ in range(3))
        values = np.empty(room, np.uint8)
        total = _scan(wide, max(columns, 1), row, slot, column, values)
        if total + 8 <= room:
            return row[:total], slot[:total], column[:total], values[:total]
        room = total + 8


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


def count_set(packed: UInt8[np.ndarray, "..."]) -> int:
    """How many decisions of packed bytes (any number of columns) are yes."""
    flat = np.ascontiguousarray(packed).reshape(-1)
    whole = len(flat) // 8 * 8
    return int(np.bitwise_count(flat[:whole].view(np.uint64)).sum(dtype=np.int64)) + int(
        np.bitwise_count(flat[whole:]).sum(dtype=np.int64)
    )
