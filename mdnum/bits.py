"""Operations on packed bits (one bit per cutoff decision), and sorting of integers.

This module works without jax, for the analysis of trajectories.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int, UInt8

from mdnum.compiled import njit
from mdnum.vectors import lowest_bit

# Decisions are packed eight slots to a byte. A step of a list with W*8 slots for each of C columns leaves a
# (W, C) array of bytes; slot k of column c is bit k % 8 of byte [k // 8, c].


@njit
def _scan(before, rows, columns, row, slot, column, values):
    """Record the bits that change from row to row. Return the number of changes."""
    at, room = 0, row.shape[0]
    for r in range(rows.shape[0]):
        # the eight slots that the scan is in, and the places of their bytes
        slots, begin, end = 0, 0, columns
        for w in range(rows.shape[1]):
            now = rows[r, w]
            changed = now ^ (rows[r - 1, w] if r else before[w])
            while changed:
                bit = np.int64(lowest_bit(changed))
                changed &= changed - np.uint64(1)
                if at < room:
                    place = 8 * w + (bit >> 3)
                    while place >= end:
                        slots, begin, end = slots + 8, end, end + columns
                    row[at], slot[at], column[at] = r, slots + (bit & 7), place - begin
                    values[at] = (now >> np.uint64(bit)) & np.uint64(1)
                at += 1
    return at


def changes_in_time(
    before: UInt8[np.ndarray, "words columns"], rows: UInt8[np.ndarray, "rows words columns"]
) -> tuple[
    Int[np.ndarray, "flips"], Int[np.ndarray, "flips"], Int[np.ndarray, "flips"], UInt8[np.ndarray, "flips"]
]:
    """Find all pair decisions that change from one step to the next.

    Args:
        before: decisions before the first row.
        rows: decisions of each row.

    Returns:
        row, slot, column and new decision (1 yes, 0 no) of each change, by row, slot word, column and bit.
    """
    count, words, columns = rows.shape
    size = words * columns
    spare = -size % 8
    flat = rows.reshape(count, size), before.reshape(1, size)
    if spare:
        flat = tuple(np.pad(part, ((0, 0), (0, spare))) for part in flat)
    # on a big-endian machine the bytes of a word would be met in the other order
    wide, ahead = (np.ascontiguousarray(p).view("<u8").astype(np.uint64, copy=False) for p in flat)
    # rarely too little; where it is, the count says how much is needed
    room = wide.size // 4 + 64
    while True:
        row, slot, column = (np.empty(room, np.int32) for _ in range(3))
        values = np.empty(room, np.uint8)
        total = _scan(ahead[0], wide, max(columns, 1), row, slot, column, values)
        if total <= room:
            return row[:total], slot[:total], column[:total], values[:total]
        room = total


def set_bits(
    packed: UInt8[np.ndarray, "words columns"],
) -> tuple[Int[np.ndarray, "set"], Int[np.ndarray, "set"]]:
    """Return the row and the column of every set bit."""
    _, slots, columns, _ = changes_in_time(np.zeros_like(packed), packed[None])
    return slots, columns


def count_set(packed: UInt8[np.ndarray, "..."]) -> int:
    """Return the number of set bits in an array of packed bits."""
    flat = np.ascontiguousarray(packed).reshape(-1)
    whole = len(flat) // 8 * 8
    return int(np.bitwise_count(flat[:whole].view(np.uint64)).sum(dtype=np.int64)) + int(
        np.bitwise_count(flat[whole:]).sum(dtype=np.int64)
    )


@njit
def digit_order(room, count, most):
    """Return the indices that sort integer keys (0 <= key < `most`). The sort is stable.

    The keys are in row 0 of `room`, an int64 array of shape (4, count or more). `room` is overwritten.
    """
    keys, numbers, other_keys, other_numbers = room[0], room[1], room[2], room[3]
    bits = 1
    for k in range(count):
        numbers[k] = k
    while most >> bits:
        bits += 1
    digits = (bits + 10) // 11
    width = (bits + digits - 1) // digits
    cursor, mask = np.empty((1 << width) + 1, np.int64), (1 << width) - 1
    for digit in range(digits):
        cursor[:] = 0
        for k in range(count):
            cursor[((keys[k] >> digit * width) & mask) + 1] += 1
        for value in range(mask):
            cursor[value + 1] += cursor[value]
        for k in range(count):
            value = (keys[k] >> digit * width) & mask
            other_keys[cursor[value]], other_numbers[cursor[value]] = keys[k], numbers[k]
            cursor[value] += 1
        keys, numbers, other_keys, other_numbers = other_keys, other_numbers, keys, numbers
    return numbers[:count]
