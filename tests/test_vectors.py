"""Instructions written out as LLVM's do what plain loops do."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from mdnum import vectors
from mdnum.vectors import EIGHT, SIXTEEN

bits_set, kept, lowest_bit, moved = vectors.bits_set, vectors.kept, vectors.lowest_bit, vectors.moved
near_atom, near_box, turned = vectors.near_atom, vectors.near_box, vectors.turned


@pytest.mark.parametrize("kind", [np.float64, np.int32])
def test_numbers_are_copied_with_one_added(kind):
    source, out = np.arange(12).astype(kind), np.full(14, -1).astype(kind)
    numba.njit(lambda x, shift, y: moved(x, 3, shift, y, 5))(source, kind(7), out)
    assert out.tolist() == [-1] * 5 + list(range(10, 18)) + [-1]


@pytest.mark.parametrize("compresses", [False, vectors._COMPRESSES])
def test_labels_are_kept_by_a_mask(monkeypatch, compresses):
    monkeypatch.setattr(vectors, "_COMPRESSES", compresses)
    mask, labels = np.array([9, 1, 0, 0, 1, 1, 0, 1, 0], np.uint8), np.arange(20, 32, dtype=np.int32)
    out = np.full(4 + EIGHT, -1, np.int32)
    end = numba.njit(lambda mask, labels, out: kept(mask, 1, labels, 2, out, 3))(mask, labels, out)
    assert end == 7 and out[:7].tolist() == [-1] * 3 + [22, 25, 26, 28]


def test_rows_become_columns():
    rows, out = np.arange(130, dtype=np.int32), np.zeros((10, 11), np.int32)
    numba.njit(lambda rows, out: turned(rows, 2, 15, out, 13, 11))(rows, out)
    expected = np.zeros_like(out)
    expected[1:9, 2:10] = np.lib.stride_tricks.sliding_window_view(rows, EIGHT)[2 : 2 + 15 * EIGHT : 15].T
    np.testing.assert_array_equal(out, expected)


def test_atoms_near_a_box_and_near_an_atom():
    """Distances in sixteenths, which float32 has without rounding."""
    rng = np.random.default_rng(5)
    atoms, other = rng.integers(-64, 64, (2, 3, SIXTEEN)).astype(np.float32) / 16
    shift, box = np.array([0.5, -1, 0.25], np.float32), np.array([-1, -2, -1, 0.5, 1, 1], np.float32)
    room = np.zeros((3, SIXTEEN), np.float32)

    @numba.njit
    def both(atoms, shift, box, reach, room, other, low, high):
        place = np.uintp(room.ctypes.data)
        near = near_box(
            np.uintp(atoms.ctypes.data), np.uintp(shift.ctypes.data), np.uintp(box.ctypes.data), reach, place
        )
        found = near_atom(place + np.uintp(20), np.uintp(other.ctypes.data), low, high)
        return near, found, room[0, 0]

    near, found, _ = both(atoms, shift, box, np.float32(4), room, other, np.float32(9), np.float32(16))
    x = atoms - shift[:, None]
    np.testing.assert_array_equal(room, x)
    gap = np.maximum(0, np.maximum(box[:3, None] - x, x - box[3:, None]))
    square = ((other - x[:, 5:6]) ** 2).sum(axis=0)
    for word, expected in (
        (near, (gap**2).sum(axis=0) <= 4),
        (found & 0xFFFF, square < 9),
        (found >> 16, square < 16),
    ):
        assert [bool(word >> k & 1) for k in range(SIXTEEN)] == expected.tolist()
        assert 0 < expected.sum() < SIXTEEN


@pytest.mark.parametrize("word", [1, 0b101000, 2**63, 2**64 - 8])
def test_bits_of_a_word(word):
    both = numba.njit(lambda word: (lowest_bit(word), bits_set(word)))(np.uint64(word))
    assert both == ((word & -word).bit_length() - 1, word.bit_count())
