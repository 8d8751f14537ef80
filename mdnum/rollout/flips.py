"""Table of flips: atoms, step, distance from the cutoff and energy jump."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from mdnum.bits import digit_order
from mdnum.compiled import njit
from mdnum.errors import MdnumError
from mdnum.md.cell import Cell, box_of, displacement, nearest_image, stacked
from mdnum.md.decide import Changes, note
from mdnum.md.ledger import Columns, FlipTable
from mdnum.md.neighbors import PairTable
from mdnum.md.potentials import pair_type
from mdnum.numerics import count_set
from mdnum.rollout.engine import Segment
from mdnum.systems.simulation import Simulation


@njit
def _mixed(key):
    """Return a 64-bit hash of an integer key (the finalizer of splitmix64)."""
    z = np.uint64(key) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit
def fingerprint_of_bits(bits, index, order):
    """Count and hash the pairs inside the cutoff. The order of the list has no effect."""
    count, total = 0, np.uint64(0)
    atoms, listed = order.shape[0], index.shape[0] // 8
    for w in range(bits.shape[0]):
        channel, own = w // listed, w % listed
        for c in range(bits.shape[1]):
            byte = bits[w, c]
            if byte:
                i = order[c]
                for k in range(8):
                    if (byte >> k) & 1:
                        j = order[index[8 * own + k, c]]
                        if i < j:
                            count += 1
                            total += _mixed((channel * atoms + i) * atoms + j)
    return count, total


@njit
def _fingerprint_of_keys(keys):
    total = np.uint64(0)
    for key in keys:
        total += _mixed(key)
    return len(keys), total


@njit
def _note_rows(before, rows, index, x, v, pairs, ends, count):
    """Record the changes of cutoff decisions between time steps with the same neighbor list."""
    held = before.copy()
    for r in range(len(rows)):
        note(held, rows[r], index, x[r], v[r], r, pairs, ends, count)


# atoms in one place have no radial speed: not a number, as in numpy
@njit(error_model="numpy")
def _columns(pairs, ends, labels, species, kinds, by_type, bounds, rule, boxes, narrow, back, first, factor):
    """Compute the columns of the table of flips. Check the distances against the decisions.

    Args:
        labels: labels of the sorted atoms. species: species by label. kinds: pair type of two species.
        by_type: thresholds, energy and force jumps, shape (3, types). bounds: shape (rows, types).
        rule: whether distances are compared rather than their squares; and whether a margin of 0 is inside.
        boxes, narrow: `stacked` in float64, and in float32 if decisions are made in single precision.
        back: deformation from each row's box to the previous row's, shape (rows, 3, 3); no rows if the box is
            fixed.
        first: step of the first row. factor: factor that converts velocities to the units of the ledger.

    Returns:
        step, labels, shape (2, flips), and decision; then margin, bound, energy jump, distance, radial speed,
        force jump and the change of the distance due to the box, shape (7, flips).
    """
    flips, (root, inclusive) = len(pairs), rule
    i, j = np.empty(flips, np.int64), np.empty(flips, np.int64)
    atoms, room, place = len(labels), np.empty((4, flips), np.int64), np.empty_like(i)
    types = len(kinds) * (len(kinds) + 1) // 2
    many = atoms * (bounds.shape[1] // types)
    for q in range(flips):
        one, other = labels[pairs[q, 1]], labels[pairs[q, 2]]
        i[q], j[q] = min(one, other), max(one, other)
        # the channel of a decision counts as one of its first atom
        i[q] += pairs[q, 3] // 2 * atoms
        room[0, q] = (pairs[q, 0] * many + i[q]) * atoms + j[q]
    order = digit_order(room, flips, len(bounds) * many * atoms)
    for f in range(flips):
        place[order[f]] = f
    step, subject = np.empty(flips, np.int64), np.empty((2, flips), np.int64)
    entered, out, contradicted = np.empty(flips, np.bool_), np.zeros((7, flips)), False
    small, wide = np.float32, np.float64
    # as they were noted: they come from further away than their places, which are near one another
    for q in range(flips):
        f = place[q]
        row, now = pairs[q, 0], pairs[q, 3] % 2 != 0
        k = kinds[species[i[q] % atoms], species[j[q]]] if len(kinds) > 1 else np.int64(0)
        k += pairs[q, 3] // 2 * types
        x0, y0, z0, x1, y1, z1 = ends[q, 0], ends[q, 1], ends[q, 2], ends[q, 3], ends[q, 4], ends[q, 5]
        box = box_of(boxes, row)
        dx, dy, dz = nearest_image(box, wide(x1) - wide(x0), wide(y1) - wide(y0), wide(z1) - wide(z0))
        r2 = dx * dx + dy * dy + dz * dz
        distance = np.sqrt(r2)
        quantity = distance if root else r2
        if narrow is not None:
            near = box_of(narrow, row)
            sx, sy, sz = nearest_image(
                near, small(x1) - small(x0), small(y1) - small(y0), small(z1) - small(z0)
            )
            short = sx * sx + sy * sy + sz * sz
            quantity = wide(np.sqrt(short) if root else short)
        u0, u1, u2 = ends[q, 9] - ends[q, 6], ends[q, 10] - ends[q, 7], ends[q, 11] - ends[q, 8]
        approach = wide(u0) * dx + wide(u1) * dy + wide(u2) * dz
        sign, margin = 1.0 if now else -1.0, by_type[0, k] - quantity
        contradicted |= now != (margin >= 0 if inclusive else margin > 0)
        step[f], subject[0, f], subject[1, f], entered[f] = first + row, i[q], j[q], now
        out[0, f], out[1, f], out[2, f] = margin, bounds[row, k], sign * by_type[1, k]
        out[3, f], out[4, f], out[5, f] = distance, approach / distance * factor, sign * by_type[2, k]
        if len(back):
            b = back[row]
            x = dx * b[0, 0] + dy * b[1, 0] + dz * b[2, 0]
            y = dx * b[0, 1] + dy * b[1, 1] + dz * b[2, 1]
            z = dx * b[0, 2] + dy * b[1, 2] + dz * b[2, 2]
            out[6, f] = distance - np.sqrt(x * x + y * y + z * z)
    return step, subject, entered, out, contradicted


def _back(segment: Segment) -> Float[np.ndarray, "rows 3 3"]:
    """Return the deformation from each step's box to the previous box. Empty for a fixed box."""
    if not segment.cells:
        return np.empty((0, 3, 3))
    before = jax.tree.map(np.asarray, segment.start.cells[1]), *segment.cells[:-1]
    return np.array([now.deformation(then) for then, now in zip(before, segment.cells, strict=True)])


def _noted(before, bits, index, x, v) -> Changes:
    """Return the changes of cutoff decisions between steps with the same neighbor list."""
    room = len(bits) * max(64, bits.shape[2] // 4)
    while True:
        made = np.empty((room, 4), np.int32), np.empty((room, 12), x.dtype), np.zeros(3, np.int64)
        _note_rows(before, bits, index, x, v, *made)
        if made[2][0] <= room:
            return Changes(*made)  # type: ignore[arg-type]
        room = int(made[2][0])


@dataclass(frozen=True)
class AmbiguousPairs(Columns):
    """Pairs whose cutoff decision could be reversed by rounding errors. Each row is a pair at a step."""

    step: Int[np.ndarray, "rows"]  # of the decision
    # i, j: the pair, i < j
    i: Int[np.ndarray, "rows"]
    j: Int[np.ndarray, "rows"]
    # margin, bound: of the decision, and on the rounding error of its quantity; |margin| <= bound
    margin: Float[np.ndarray, "rows"]
    bound: Float[np.ndarray, "rows"]


class PairRecorder:
    """Recorder of all flips (pairs that cross the cutoff) in a simulation.

    A flip is a change of a pair's decision between two consecutive steps. The neighbor list may be rebuilt in
    between. The flip of a pair that the old list lacks is recorded with the new list. A pair outside the new
    neighbor list counts as outside the cutoff.

    Args:
        simulation: the system as objects.
        held: keys of the pairs inside the cutoff in the previous list, if a run continues with a new list.
    """

    def __init__(self, simulation: Simulation, held: Int[np.ndarray, "pairs"] | None = None):
        self.simulation = simulation
        self._held_keys = held
        # the list that has ended, its last decisions and how many are yes
        self._held_segment: tuple[PairTable, UInt8[Array | np.ndarray, "words atoms"], int] | None = None
        self.missed = 0
        decider = simulation.decider
        self._one_box = self._stacked([simulation.cell])
        self._rule = decider.space == "r", decider.compare.endswith("<=")
        types = len(simulation.symbols) if simulation.pair_types > 1 else 1
        self._kinds = pair_type(np.arange(types)[:, None], np.arange(types), types)
        self._species = simulation.species if types > 1 else np.zeros(simulation.atoms, np.int64)
        thresholds = np.array([threshold.value for threshold in decider.thresholds])
        self._by_type = np.stack([thresholds, *simulation.jumps()])

    def inside(self, bits: UInt8[np.ndarray, "words atoms"]) -> int:
        """Return the number of pairs inside the cutoff. A pair listed twice counts once."""
        return self._once(int(count_set(bits)))

    def _once(self, both: int) -> int:
        """Return half of a count in which each pair occurs twice. Raise an error if it is odd."""
        if both % 2:
            raise MdnumError(
                "a pair is inside the cutoff for only one of its two atoms", remedy="Report this as a bug"
            )
        return both // 2

    def counts(self, segment: Segment) -> Int[np.ndarray, "rows"]:
        """Return the number of pairs inside the cutoff at every step."""
        if segment.changes is None:
            return np.array([self.inside(bits) for bits in segment.rows_of("bits")], np.int64)
        return np.array([self._once(int(both)) for both in segment.rows_of("inside")], np.int64)

    def _stacked(self, cells: Sequence[Cell]) -> tuple[Any, Any]:
        """Return boxes in float64 and, if it differs, in the dtype of cutoff decisions."""
        dtype = self.simulation.decider.dtype
        return stacked(cells), None if dtype == "float64" else stacked(cells, dtype)

    def bounds(self, segment: Segment) -> Float[np.ndarray, "rows types"]:
        """Bounds on the rounding error of r or r² at each step."""
        decider = self.simulation.decider
        if not decider.grows and not segment.cells:
            return np.repeat([decider.bounds], segment.rows, axis=0)
        x = segment.rows_of("x") if decider.grows else np.empty((segment.rows, 3, 0))
        if not segment.cells:
            return decider.bounds_at(x)
        each = [self.simulation.in_row(cell).decider for cell in segment.cells]
        return np.concatenate([one.bounds_at(x[[row]]) for row, one in enumerate(each)])

    def ambiguous(self, segment: Segment) -> Int[np.ndarray, "rows"]:
        """Number of pairs at each step whose decision could be reversed by rounding errors."""
        return np.bincount(self.doubtful(segment).step - segment.first, minlength=segment.rows)

    def doubtful(self, segment: Segment) -> AmbiguousPairs:
        """Return the pairs whose decision could be reversed by rounding errors, sorted by step."""
        parts = [AmbiguousPairs.none()]
        bounds, table, dtype = self.bounds(segment), segment.table, np.dtype(self.simulation.decider.dtype)
        # almost always no pair comes that close; where one does, the host looks again
        close = np.flatnonzero(segment.rows_of("nearest") <= bounds.max(axis=1))
        if len(close):
            first, second, i, j = table.listed(self.simulation.channels)
        for row in close:
            x = segment.rows_of("x")[row]
            kind = self.simulation.type_of(i, j)
            d = displacement(segment.cell_of(int(row)), x[:, first].T, x[:, second].T, dtype)
            margin = self.simulation.decider.host_margin(d, kind)
            bound = bounds[row][kind]
            at = np.flatnonzero(np.abs(margin) <= bound)
            at = at[np.lexsort((j[at], i[at]))]
            step = np.full(len(at), segment.first + row, np.int64)
            parts.append(
                AmbiguousPairs(step, i[at].astype(np.int64), j[at].astype(np.int64), margin[at], bound[at])
            )
        return AmbiguousPairs.concatenate(parts)

    def flips(self, segment: Segment) -> FlipTable:
        """Return a segment's flips sorted by step, i and j. Atom labels are the user's (see `type_of`).

        Distance, margin and radial speed refer to the step of the flip. The margin (threshold minus r or r²)
        equals that of the run, bit for bit.

        Raises:
            MdnumError: a flip was recorded for only one atom of a pair, or a margin contradicts its decision
                because compiled arithmetic differs from numpy.
        """
        table, changes = segment.table, segment.changes
        replaced = self._replace(segment)
        if changes is None or replaced is not None:
            bits, x, v = (segment.rows_of(name) for name in ("bits", "x", "v"))
            before = np.asarray(segment.before) if replaced is None else bits[0]
            changes = _noted(before, bits, table.index, x, v)
        found, both, _ = np.asarray(changes.count).tolist()
        if 2 * found != both:
            raise MdnumError(
                "a flip was recorded for only one of the two atoms of a pair", remedy="Report this as a bug"
            )
        pairs, ends = np.asarray(changes.pairs), np.asarray(changes.ends)
        kept = np.searchsorted(pairs[:found, 0], segment.rows)
        pairs, ends = pairs[:kept], ends[:kept]
        if replaced is not None:
            keys, now = replaced
            i, j = np.divmod(keys, self.simulation.atoms)
            channel, i = np.divmod(i, self.simulation.atoms)
            a, b = table.place[np.stack([i, j])]
            added = np.stack([np.zeros(len(keys), np.int64), a, b, now + 2 * channel], axis=1).astype(
                np.int32
            )
            pairs = np.concatenate([added, pairs])
            ends = np.concatenate([np.concatenate([x[0][:, a], x[0][:, b], v[0][:, a], v[0][:, b]]).T, ends])
        if segment.closes:
            if segment.held is None:
                bits = np.array(segment.rows_of("bits")[-1])
                self._held_segment = table, bits, count_set(bits)
            else:
                self._held_segment = table, segment.held, int(segment.rows_of("inside")[-1])
            self._held_keys = None
        step, (i, j), entered, numbers, contradicted = _columns(
            pairs, ends, table.order, self._species, self._kinds, self._by_type, self.bounds(segment),
            self._rule, *(self._stacked(segment.cells) if segment.cells else self._one_box),
            _back(segment), segment.first,
            # user units of time: the ledger is for people
            self.simulation.units.time_factor,
        )  # fmt: skip
        if contradicted:
            raise MdnumError(
                "the recorded margin of a pair decision contradicts the decision",
                remedy="Run `mdnum doctor`: the compiled code probably computes with unexpected rounding",
            )
        margin, bound, jump, distance, speed, force_jump, by_box = numbers
        if self.simulation.pairwise and self.simulation.model.weights:
            # in the compiled loop each kind of pair has one jump
            sign = np.where(entered, 1.0, -1.0)
            jump, force_jump = (sign * one for one in self.simulation.jumps_of(i, j))
        return FlipTable(
            i=i, j=j, rank=np.zeros(len(i), np.int32), entered=entered, distance=distance,
            margin=margin, bound=bound, ambiguous=np.abs(margin) <= bound, decided_by="program",
            step=step, radial_speed=speed, energy_jump=jump, force_jump=force_jump,
            by_box=by_box if segment.cells else None,
        )  # fmt: skip

    def caused_by_box(self, ledger: FlipTable) -> Bool[np.ndarray, "flips"]:
        """Return a mask of the flips that a change of the box caused."""
        root, inclusive = self._rule
        # the same margin, at the distance in that box
        change = ledger.by_box if root else ledger.by_box * (2 * ledger.distance - ledger.by_box)
        margin = ledger.margin + change
        return (margin >= 0 if inclusive else margin > 0) != ledger.entered

    def held(self) -> Int[np.ndarray, "pairs"] | None:
        """Return keys of the pairs inside the cutoff at the last step of the previous list."""
        if self._held_segment is not None:
            table, bits, _ = self._held_segment
            self._held_keys = _keys(self.simulation, table, np.asarray(bits))
        return self._held_keys

    def _cannot_differ(self, segment: Segment) -> bool:
        """Return True if old and new neighbor list must have the same pairs inside the cutoff."""
        rule = self.simulation.rule
        if self._held_segment is None or not rule.safe:
            return False
        return 2 * float(segment.leap) < rule.skin and self._held_segment[2] == int(segment.inside)

    def _replace(self, segment: Segment) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the pairs that are inside the cutoff in only one of two neighbor lists."""
        self.missed = 0
        if not segment.opens or (self._held_segment is None and self._held_keys is None):
            return None
        if self._cannot_differ(segment):
            return None
        before = np.asarray(segment.before)
        if self._held_segment is not None:
            table, bits, _ = self._held_segment
            old = fingerprint_of_bits(np.asarray(bits), table.index, table.order)
        else:
            old = _fingerprint_of_keys(self._held_keys)
        if old == fingerprint_of_bits(before, segment.table.index, segment.table.order):
            return None
        held = self.held()
        assert held is not None
        now = _keys(self.simulation, segment.table, segment.rows_of("bits")[0])
        looked_back = _keys(self.simulation, segment.table, before)
        self.missed = len(np.setdiff1d(looked_back, held, assume_unique=True))
        keys = np.setxor1d(held, now, assume_unique=True)
        return keys, np.isin(keys, now, assume_unique=True)


def pair_keys(
    i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"], atoms: int
) -> Int[np.ndarray, "pairs"]:
    """Return sorted integer keys of pairs i < j. `Simulation.type_of` explains the argument i."""
    return np.sort(i.astype(np.int64) * atoms + j)


def _keys(simulation: Simulation, table: PairTable, bits: UInt8[np.ndarray, "words atoms"]):
    """Return sorted integer keys of all pairs inside the cutoff."""
    keys = np.empty(count_set(bits), np.int64)
    return keys[: _write_keys(bits, table.index, table.order, table.place, keys)].copy()


@njit
def _write_keys(bits, index, order, place, keys):
    """Write the keys of all pairs inside the cutoff in ascending order. Return their number."""
    atoms, listed, at = order.shape[0], index.shape[0] // 8, 0
    # the channel of a decision counts as one of its first atom
    for first in range(atoms * (bits.shape[0] // listed)):
        i, words = first % atoms, first // atoms * listed
        begin, c = at, place[i]
        for w in range(listed):
            byte = bits[words + w, c]
            for k in range(8):
                if (byte >> k) & 1 and order[index[8 * w + k, c]] > i:
                    key = first * atoms + order[index[8 * w + k, c]]
                    q = at
                    while q > begin and keys[q - 1] > key:
                        keys[q] = keys[q - 1]
                        q -= 1
                    keys[q] = key
                    at += 1
    return at


def decided_pairs(simulation: Simulation, segment: Segment, row: int) -> Int[np.ndarray, "pairs"]:
    """Return integer keys of the pairs inside the cutoff at one step of a run."""
    return _keys(simulation, segment.table, bits_of(segment, row))


def bits_of(segment: Segment, row: int) -> UInt8[np.ndarray, "words atoms"]:
    """Return the packed cutoff decisions at one step of a segment."""
    if row == segment.rows - 1 and segment.held is not None and segment.closes != "blow-up":
        return np.asarray(segment.held)
    return segment.rows_of("bits")[row]


def true_pairs(simulation: Simulation, wrapped: Float[np.ndarray, "atoms 3"]) -> Int[np.ndarray, "pairs"]:
    """Return keys of all pairs inside the cutoff, from a new search with the run's arithmetic."""
    decider = simulation.decider
    table = simulation.verlet_list(skin=0.0).build(np.asarray(wrapped, np.float64), simulation.cell)
    _, _, i, j = table.listed(simulation.channels)
    d = displacement(simulation.cell, wrapped[i % simulation.atoms], wrapped[j], np.dtype(decider.dtype))
    margin = decider.host_margin(d, simulation.type_of(i, j))
    inside = margin >= 0 if decider.compare.endswith("<=") else margin > 0
    return pair_keys(i[inside], j[inside], simulation.atoms)
