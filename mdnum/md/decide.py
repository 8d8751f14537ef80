"""The rule that decides which pairs are inside the cutoff.

Only this module defines the compared quantity and its threshold. The force loop, the check of neighbor lists
and the ledger therefore make the same decisions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numba
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt8

from mdnum.compiled import cfunc, njit
from mdnum.md import foreign
from mdnum.md.cell import Cell
from mdnum.md.foreign import asked_to_run, buffer, carray, peek, pointer, registered
from mdnum.md.neighbors import SLOTS
from mdnum.md.potentials import of_type
from mdnum.numerics import Reach, Threshold, distance_bound, squared_distance_bound
from mdnum.numerics.exact import root, squared_norm
from mdnum.numerics.rounding import unit_roundoff
from mdnum.registry import expect_known
from mdnum.vectors import bits_set, lowest_bit

# slots that the loops over a list take at a time: half a byte of decisions. Measured in float64 on one core,
# ms a force: 1.4 for N = 4,000 and 59 for 108,000; with 8 at a time 2.2 and 78 (the compiler then gives up
# vectorizing the sums), with 1 at a time 1.6 and 66.
GROUP = SLOTS // 2

# how far beyond its cutoff the bound of a pair holds
_BEYOND = 1.001

_NO_REACH = Reach()

CONVENTIONS = ("r2 <", "r2 <=", "r <", "r <=")


@dataclass(frozen=True)
class PairDecider:
    """Rule for pairs inside the cutoff: `r2 < r_cut²`, `r2 <= r_cut²`, `r < r_cut` or `r <= r_cut`."""

    r_cut: tuple[float, ...]  # cutoff of each pair type, length
    compare: str = "r2 <"  # quantity and comparison, one of "r2 <", "r2 <=", "r <", "r <="
    dtype: str = "float64"  # the dtype in which the quantity is computed and compared
    reach: Reach = _NO_REACH  # what a displacement is made of; sets the rounding bound
    # dtype of the positions; where it is the wider one, their rounding is part of the bound
    state: str = "float64"

    def __post_init__(self):
        expect_known("convention", [self.compare], CONVENTIONS, where="cutoff.compare")

    @property
    def convention(self) -> PairDecider:
        """The decision rule without radii and error bounds, as static data."""
        return replace(self, r_cut=(), reach=_NO_REACH, state="float64")

    @property
    def space(self) -> str:
        """The quantity compared with the threshold: "r" (distance) or "r2" (squared distance)."""
        return self.compare.split()[0]

    @property
    def thresholds(self) -> tuple[Threshold, ...]:
        """Thresholds (r_cut or its square) by pair type, in the dtype of the comparison."""
        scalar = np.dtype(self.dtype).type
        comparison = self.compare.split()[1]
        values = [scalar(r) * scalar(r) if self.space == "r2" else scalar(r) for r in self.r_cut]
        return tuple(Threshold(float(value), comparison, self.space) for value in values)

    @property
    def exact_thresholds(self) -> tuple[float, ...]:
        """Thresholds by pair type in double precision, before rounding."""
        return tuple(threshold.value for threshold in replace(self, dtype="float64").thresholds)

    @cached_property
    def bounds(self) -> tuple[float, ...]:
        """Bounds on |computed margin - exact margin| by pair type, in units of r or r².

        The exact margin follows from stored positions, without rounding. For the error analysis, see
        numerics.rounding. The error bound holds for distances up to 1.001 r_cut. For longer distances, the
        decision is right, or |margin| is below the bound. If coordinates exceed `reach`, `bounds_at` gives
        valid bounds.
        """
        return tuple(float(bound) for bound in self._bounds(None))

    @cached_property
    def grows(self) -> bool:
        """True if rounding bounds may increase with the magnitude of positions."""
        narrows = unit_roundoff(np.dtype(self.state)) < unit_roundoff(np.dtype(self.dtype))
        return narrows and len(self.reach.lattice) < 3

    def bounds_at(self, x: Float[np.ndarray, "rows 3 atoms"]) -> Float[np.ndarray, "rows types"]:
        """Return error bounds of margins for several states. Coordinates beyond `reach` have larger bounds.

        The rounding error of a position increases with its magnitude. Positions are not wrapped along
        nonperiodic axes.

        Args:
            x: wrapped positions of each state, in the dtype of the state, length.
        """
        bounds = np.tile(np.array(self.bounds), (len(x), 1))
        if self.grows and x.size:
            seen = np.maximum(x.max(axis=2), -x.min(axis=2)).astype(np.float64)
            left = (seen > self.reach.coordinate).any(axis=1)
            if left.any():
                with np.errstate(over="ignore"):
                    bounds[left] = np.stack(self._bounds(seen[left]), axis=-1)
        return bounds

    def _bounds(self, seen: Float[np.ndarray, "rows 3"] | None) -> list:
        """Return error bounds of margins for coordinates up to max(`reach`, `seen`)."""
        bound = squared_distance_bound if self.space == "r2" else distance_bound
        given = self.reach, np.dtype(self.dtype), np.dtype(self.state), seen
        return [
            bound(_BEYOND * r, *given) + abs(held.value - exact)
            for r, held, exact in zip(self.r_cut, self.thresholds, self.exact_thresholds, strict=True)
        ]

    def values(self) -> jax.Array:
        """Return the thresholds in the dtype of the decision, shape (types,)."""
        return jax.device_put(np.array([t.value for t in self.thresholds], np.dtype(self.dtype)))

    def quantity(self, dx, dy, dz, zero: jax.Array) -> jax.Array:
        """Return r or r² inside jit, with the same bits as `host_quantity`."""
        r2 = squared_norm(dx, dy, dz, zero)
        return root(r2) if self.space == "r" else r2

    def host_quantity(self, dx, dy, dz) -> Float[np.ndarray, "..."]:
        """Return r or r² of displacements in the decision's dtype, on the host."""
        r2 = dx * dx + dy * dy + dz * dz
        return np.sqrt(r2) if self.space == "r" else r2

    def host_margin(self, displacement, kind) -> Float[np.ndarray, "..."]:
        """Return margins (threshold minus r or r²) on the host, with the same bits as in the decisions.

        Args:
            displacement: three components, in the dtype of the decision. kind: pair type of each pair.
        """
        thresholds = np.array([threshold.value for threshold in self.thresholds])
        return thresholds[kind] - self.host_quantity(*displacement).astype(np.float64)

    def inside(self, quantity, value):
        """Return True for pairs inside the cutoff, given r or r² and thresholds."""
        return quantity <= value if self.compare.endswith("<=") else quantity < value


class Tables(NamedTuple):
    """A neighbor list, stored as a pair table on the device."""

    # neighbor of each slot and atom in sorted labels, padded with the number of atoms, shape (slots/8, 8,
    # atoms)
    index: Int[Array, "words 8 atoms"]
    # pair type of each slot (None where there is only one), same shape
    types: UInt8[Array, "words 8 atoms"] | None
    order: Int[Array, "atoms"]  # sorted atom k is atom order[k], shape (atoms,)
    # of energies over a list: second atom, first atom and slot of each listed pair, padded with the number of
    # atoms, shape (3, edges); of those that take dense lists the neighbors of each atom, (atoms, slots)
    edges: Int[Array, "first second"] | None = None

    def groups(self) -> tuple[Int[Array, "groups 4 atoms"], UInt8[Array, "groups 4 atoms"] | None]:
        """Return neighbor indices and pair types in groups of GROUP entries."""
        atoms = self.index.shape[-1]
        types = None if self.types is None else self.types.reshape(-1, GROUP, atoms)
        return self.index.reshape(-1, GROUP, atoms), types


class Decisions(NamedTuple):
    """Decisions for all pairs of a neighbor list."""

    bits: UInt8[Array, "words atoms"]  # decisions, eight slots to a byte, shape (slots/8, atoms)
    # smallest |margin| of any listed pair, in the quantity's space. Only where it is within the rounding
    # bound can a decision be ambiguous, so the loop need not count those.
    nearest: Float[Array, ""]


def packed(halves: UInt8[Array, "groups atoms"]) -> UInt8[Array, "words atoms"]:
    """Pack cutoff decisions into bytes, two groups of neighbors per byte."""
    return halves[0::2] | (halves[1::2] << jnp.uint8(GROUP))


def halves_of(bits: UInt8[Array, "words atoms"]) -> UInt8[Array, "groups atoms"]:
    """Unpack each byte into the decisions of two groups of neighbors. Inverse of `packed`."""
    mask = jnp.uint8((1 << GROUP) - 1)
    return jnp.stack([bits & mask, bits >> jnp.uint8(GROUP)], axis=1).reshape(-1, bits.shape[-1])


def unpacked(half: UInt8[Array, "atoms"]) -> Bool[Array, "4 atoms"]:
    """Return the cutoff decisions of one group of neighbors as booleans."""
    # slot by slot: shifted all at once, by a vector, the loops that use them are not vectorized and take
    # twice the time
    return jnp.stack([half & jnp.uint8(1 << k) != 0 for k in range(GROUP)])


class SlotJudge:
    """Decisions on groups of neighbor slots inside jit, and the smallest |margin| of each atom.

    Args:
        decider: the comparison that defines a decision.
        thresholds: thresholds of the decider by pair type, in its dtype, shape (types,).
        cell: the box.
        zero: an integer zero whose value is unknown to XLA at compile time.
        positions: positions in sorted order, wrapped, shape (3, atoms).
    """

    def __init__(
        self,
        decider: PairDecider,
        thresholds: Float[Array, "types"],
        cell: Cell,
        zero: jax.Array,
        positions: Float[Array, "3 atoms"],
    ):
        dtype = np.dtype(decider.dtype)
        self.decider, self.zero = decider, zero
        self.cell = cell.astype(dtype)
        self.components = tuple(positions.astype(dtype))
        self.atoms = positions.shape[1]
        self.value = thresholds

    def start(self) -> jax.Array:
        """Return the initial value of the smallest |margin| of each atom."""
        return jnp.full(self.atoms, jnp.inf, self.value.dtype)

    def group(self, j, types):
        """Return displacement, compared quantity, decision and threshold for GROUP neighbors of every atom.

        Args:
            j: neighbors, shape (GROUP, atoms). types: their pair types, or None.
        """
        d = displacements(self.components, self.cell, j)
        quantity = self.decider.quantity(*d, self.zero)
        # padding repeats the last atom: it is outside of whatever there is, and near to nothing
        threshold = jnp.where(j < self.atoms, of_type(self.value, types), -jnp.inf)
        return d, quantity, self.decider.inside(quantity, threshold), threshold

    def tally(self, nearest, quantity, inside, threshold):
        """Return the decisions for a group of neighbors as bits, and each atom's smallest |margin|."""
        bits = jnp.zeros(self.atoms, jnp.uint8)
        margin = jnp.abs(threshold - quantity)
        for k in range(GROUP):
            bits = bits | (inside[k].astype(jnp.uint8) << jnp.uint8(k))
            nearest = jnp.minimum(nearest, margin[k])
        return bits, nearest

    def decide(self, tables: Tables) -> Decisions:
        """Return the decisions on all pairs of a neighbor list, without computing forces."""

        def block(nearest, listed):
            _, quantity, inside, threshold = self.group(*listed)
            bits, nearest = self.tally(nearest, quantity, inside, threshold)
            return nearest, bits

        nearest, halves = lax.scan(block, self.start(), tables.groups())
        return self.finish(nearest, halves)

    def finish(self, nearest, halves) -> Decisions:
        """Return the decisions for the neighbor list, two groups of neighbors per byte."""
        return Decisions(packed(halves), jnp.min(nearest, initial=jnp.inf).astype(jnp.float64))


def displacements(components, cell: Cell, j):
    """Return minimum-image vectors x_j - x_i by component. For empty slots, j is any valid index."""
    return cell.minimum_image(*(c.at[j].get(mode="promise_in_bounds") - c for c in components))


# --- what changed from one pass to the next ---------------------------------------------------------------


def zeros(shape: int | tuple[int, ...], dtype: Any) -> Array:
    """Return zeros on the device, without a compilation for each shape."""
    return jax.device_put(np.zeros(shape, dtype))


class Changes(NamedTuple):
    """Cutoff decisions that changed in several steps. Each changed pair is stored once."""

    # row, sorted atoms and whether inside now (plus 2 for each channel before), shape (room, 4)
    pairs: Int[Array, "room 4"]
    ends: Float[Array, "room 12"]  # positions of both atoms, then velocities, shape (room, 12)
    # of changes seen so, and seen from both ends; more of them than room are not noted. Then of the decisions
    # of the last row that are yes; shape (3,).
    count: Int[Array, "3"]

    @classmethod
    def empty(cls, room: int, dtype: np.dtype) -> Changes:
        """Return empty buffers with space for the given number of changed cutoff decisions."""
        return cls(zeros((room, 4), np.int32), zeros((room, 12), dtype), zeros(3, np.int64))

    def emptied(self) -> Changes:
        """Return the same buffers with zero changed decisions."""
        return self._replace(count=jnp.zeros_like(self.count))

    @property
    def found(self) -> int:
        """Number of changed decisions, also of those beyond the size of the buffers."""
        return int(np.asarray(self.count)[0])

    def cut(self) -> Changes:
        """Return buffers shortened to the number of changes, for a faster transfer to the host."""
        room = 1 << self.found.bit_length()
        if foreign.known() or room >= len(self.pairs):
            return self
        pairs, ends = _cut((self.pairs, self.ends), room)
        return self._replace(pairs=pairs, ends=ends)

    def noted(
        self,
        before: UInt8[Array, "words atoms"],
        bits: UInt8[Array, "words atoms"],
        tables: Tables,
        x: Float[Array, "3 atoms"],
        v: Float[Array, "3 atoms"],
        row: Int[Array, ""],
        most: int,
    ) -> tuple[Changes, UInt8[Array, "words atoms"]]:
        """Append changed decisions to the buffers. Return buffers and decisions, in the same memory.

        Args:
            most: largest number of changes recorded per step, on a device other than a CPU. If there are
                more, `count` exceeds the capacity.
        """
        if foreign.known() and x.dtype == np.float64:
            return self._noted_by_host(before, bits, tables, x, v, row)
        changed, index = before ^ bits, tables.index.astype(jnp.int32)
        per = len(index)
        index = jnp.tile(index, (len(bits) // per, 1, 1))
        slot, atom = jnp.arange(8, dtype=jnp.uint8)[None, :, None], jnp.arange(x.shape[1], dtype=jnp.int32)
        each = ((changed[:, None] >> slot) & jnp.uint8(1) == 1) & (atom < index)
        # counted, not added up from the changes: it is what they are held against
        both, inside = (jnp.sum(jnp.bitwise_count(one), dtype=jnp.int64) for one in (changed, bits))
        found = jnp.sum(each, dtype=jnp.int64)
        (at,) = jnp.nonzero(each.reshape(-1), size=most, fill_value=0)
        word, k, first = jnp.unravel_index(at, each.shape)
        second = index[word, k, first]
        now = (bits[word, first] >> k.astype(jnp.uint8)) & jnp.uint8(1)
        now = now.astype(jnp.int32) + 2 * (word // per).astype(jnp.int32)
        rows = jnp.full(most, row.astype(jnp.int32))
        pairs = jnp.stack([column.astype(jnp.int32) for column in (rows, first, second, now)], axis=1)
        ends = jnp.concatenate([x[:, first], x[:, second], v[:, first], v[:, second]]).T
        start = (self.count[0], jnp.zeros((), jnp.int64))
        # more than there may be is more than there is room for
        seen = jnp.where(found > most, found + len(self.pairs), found)
        made = Changes(
            lax.dynamic_update_slice(self.pairs, pairs, start),
            lax.dynamic_update_slice(self.ends, ends.astype(self.ends.dtype), start),
            jnp.stack([self.count[0] + seen, self.count[1] + both, inside]),
        )
        return made, bits

    def _noted_by_host(self, before, bits, tables: Tables, x, v, row):
        # written over, or XLA would copy the decisions of every step twice
        kept = (*self, before)
        shapes = [jax.ShapeDtypeStruct(part.shape, part.dtype) for part in kept]
        call = jax.ffi.ffi_call(_noting(), shapes, input_output_aliases={k: k for k in range(4)})
        index = tables.index.astype(jnp.int32)
        *made, held = call(*kept, bits, index, x, v, row.astype(jnp.int64))
        return Changes(*made), held


@partial(jax.jit, static_argnames="room")
def _cut(parts: tuple[Array, ...], room: int) -> tuple[Array, ...]:
    """Return arrays that contain only the first `room` rows of the given arrays."""
    return tuple(part[:room] for part in parts)


@cache
def _noting() -> str:
    """Register the function `_note` with XLA, and return its name."""
    made = cfunc(numba.types.intp(numba.types.intp), _note)
    return registered("mdnum_changes", made.ctypes, made)


def _note(frame):
    """Execute `Changes.noted` in a call from XLA; return 0 (no error)."""
    if not asked_to_run(frame):
        return 0
    operands, results = peek(frame, 9), peek(frame, 14)
    pairs_at, room, _ = buffer(results, 0)
    ends_at, _, _ = buffer(results, 1)
    count_at, _, _ = buffer(results, 2)
    before_at, words, atoms = buffer(results, 3)
    bits_at, _, _ = buffer(operands, 4)
    index_at, listed, _ = buffer(operands, 5)
    x_at, _, _ = buffer(operands, 6)
    v_at, _, _ = buffer(operands, 7)
    row_at, _, _ = buffer(operands, 8)
    note(
        carray(pointer(before_at), (words, atoms), np.uint8),
        carray(pointer(bits_at), (words, atoms), np.uint8),
        carray(pointer(index_at), (8 * listed, atoms), np.int32),
        carray(pointer(x_at), (3, atoms), np.float64),
        carray(pointer(v_at), (3, atoms), np.float64),
        peek(row_at, 0),
        carray(pointer(pairs_at), (room, 4), np.int32),
        carray(pointer(ends_at), (room, 12), np.float64),
        carray(pointer(count_at), (3,), np.int64),
    )
    return 0


# words of 64 bits that are gone through together
_TOGETHER = 128


@njit
def note(before, bits, index, x, v, row, pairs, ends, count):
    """Append the decisions that changed in a step. Changes beyond the capacity are only counted.

    The array of previous decisions is overwritten with the present decisions.

    Separate passes over blocks of 64 decisions find changes, look up neighbors and store rows. A single pass
    is slower: every change costs a mispredicted branch.
    """
    words, atoms = bits.shape
    size, flat = words * atoms, index.reshape(-1)
    whole = size // 8
    bytes_before, bytes_now = before.reshape(-1), bits.reshape(-1)
    ahead, now = bytes_before[: 8 * whole].view(np.uint64), bytes_now[: 8 * whole].view(np.uint64)
    places, changes = np.empty(_TOGETHER + 8, np.int64), np.empty(_TOGETHER + 8, np.uint64)
    most = 64 * (_TOGETHER + 1)
    firsts, slots, values = np.empty(most, np.int32), np.empty(most, np.int64), np.empty(most, np.int32)
    inside, begun, found = 0, count[0], count[0]
    # the word of the list, where its bytes begin, and what its channel adds to a decision
    word, begin, channel = 0, 0, 0
    for start in range(0, whole + 1, _TOGETHER):
        # the words with a change, and the bytes behind the last word
        n, end = 0, min(start + _TOGETHER, whole)
        for k in range(start, end):
            inside += np.int64(bits_set(now[k]))
            places[n], changes[n] = 8 * k, now[k] ^ ahead[k]
            ahead[k] = now[k]
            n += np.int64(changes[n] != 0)
        if start + _TOGETHER > whole:
            for k in range(8 * whole, size):
                inside += np.int64(bits_set(np.uint64(bytes_now[k])))
                places[n], changes[n] = k, np.uint64(bytes_now[k] ^ bytes_before[k])
                bytes_before[k] = bytes_now[k]
                n += np.int64(changes[n] != 0)
        # their bits: atom, place in the list and decision
        m = 0
        for k in range(n):
            changed = changes[k]
            while changed:
                bit = np.int64(lowest_bit(changed))
                changed &= changed - np.uint64(1)
                place = places[k] + (bit >> 3)
                while place >= begin + atoms:
                    word, begin = word + 1, begin + atoms
                    if 8 * word == len(index):
                        word, channel = 0, channel + 2
                firsts[m], slots[m] = place - begin, (8 * word + (bit & 7)) * atoms + place - begin
                values[m] = ((bytes_now[place] >> (bit & 7)) & 1) + channel
                m += 1
        count[1] += m
        for k in range(m):
            second = flat[slots[k]]
            # written wherever there is room and kept where it is seen from its first end, as half of them are
            if found < len(pairs):
                pairs[found, 0], pairs[found, 1] = row, firsts[k]
                pairs[found, 2], pairs[found, 3] = second, values[k]
            found += np.int64(second > firsts[k])
    for at in range(min(begun, len(pairs)), min(found, len(pairs))):
        first, second = pairs[at, 1], pairs[at, 2]
        for axis in range(3):
            ends[at, axis], ends[at, 3 + axis] = x[axis, first], x[axis, second]
            ends[at, 6 + axis], ends[at, 9 + axis] = v[axis, first], v[axis, second]
    count[0], count[2] = found, inside
