"""From packed decisions to ledger rows: which pair flipped when, by how much, and what it did."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mdnum.errors import MdnumError
from mdnum.md.cell import HostCell, displacement, nearest_image
from mdnum.md.decide import Changes
from mdnum.md.neighbors import PairTable
from mdnum.numerics import Ledger, changes_in_time, count_set, sort_rows
from mdnum.rollout.engine import Segment
from mdnum.systems.build import Simulation


@numba.njit(cache=True, nogil=True)
def _mixed(key):
    """A well-mixed 64-bit number for a key (the finalizer of splitmix64)."""
    z = np.uint64(key) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def fingerprint_of_bits(bits, index, order):
    """Number and mixed sum of the keys of all pairs inside; the same for every list that decides alike."""
    count, total = 0, np.uint64(0)
    atoms = order.shape[0]
    for w in range(bits.shape[0]):
        for c in range(bits.shape[1]):
            byte = bits[w, c]
            if byte:
                i = order[c]
                for k in range(8):
                    if (byte >> k) & 1:
                        j = order[index[8 * w + k, c]]
                        if i < j:
                            count += 1
                            total += _mixed(i * atoms + j)
    return count, total


@numba.njit(cache=True, nogil=True)
def _fingerprint_of_keys(keys):
    total = np.uint64(0)
    for key in keys:
        total += _mixed(key)
    return len(keys), total


@numba.njit(cache=True, nogil=True)
def _from_first_end(row, slot, column, values, index):
    """The changes seen from the atom that is sorted first, as `Changes.pairs`.

    There are as many as from the other end; more of either are counted and not noted.
    """
    kept, room = 0, row.shape[0] // 2
    pairs = np.empty((room + 1, 4), np.int32)
    for q in range(row.shape[0]):
        c = column[q]
        n = index[slot[q], c]
        # written always and kept where c < n: half of the branches would be mispredicted
        at = min(kept, room)
        pairs[at, 0], pairs[at, 1], pairs[at, 2], pairs[at, 3] = row[q], c, n, values[q]
        kept += np.int64(c < n)
    return kept, pairs[:room]


@numba.njit(cache=True, nogil=True)
def _ends(x, v, pairs):
    """Positions and velocities of both atoms, as `Changes.ends`."""
    ends = np.empty((pairs.shape[0], 12), x.dtype)
    for f in range(pairs.shape[0]):
        r, a, b = pairs[f, 0], pairs[f, 1], pairs[f, 2]
        for axis in range(3):
            ends[f, axis], ends[f, 3 + axis] = x[r, axis, a], x[r, axis, b]
            ends[f, 6 + axis], ends[f, 9 + axis] = v[r, axis, a], v[r, axis, b]
    return ends


# atoms in one place have no radial speed: not a number, as in numpy
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _measure(ends, chosen, row, entered, kind, by_type, bounds, root, narrow, lattice):
    """Margin, bound, energy jump, distance, radial speed and force jump of each flip, shape (6, flips).

    Args:
        ends: of changes, of which some are chosen.
        by_type: thresholds, energy and force jumps, shape (3, types). bounds: shape (rows, types).
        root: whether distances are compared, not their squares.
        narrow, lattice: of the cell in the dtype of the decision, and in float64.
    """
    out = np.empty((6, row.shape[0]))
    small, wide = narrow[0].dtype.type, np.float64
    for f in range(row.shape[0]):
        r, k, at = row[f], kind[f], ends[chosen[f]]
        x0, y0, z0, x1, y1, z1 = at[0], at[1], at[2], at[3], at[4], at[5]
        dx, dy, dz = nearest_image(lattice, wide(x1) - wide(x0), wide(y1) - wide(y0), wide(z1) - wide(z0))
        r2 = dx * dx + dy * dy + dz * dz
        distance = np.sqrt(r2)
        quantity = distance if root else r2
        if narrow[0].itemsize < 8:
            sx, sy, sz = nearest_image(
                narrow, small(x1) - small(x0), small(y1) - small(y0), small(z1) - small(z0)
            )
            short = sx * sx + sy * sy + sz * sz
            quantity = wide(np.sqrt(short) if root else short)
        u0, u1, u2 = at[9] - at[6], at[10] - at[7], at[11] - at[8]
        approach = wide(u0) * dx + wide(u1) * dy + wide(u2) * dz
        sign = 1.0 if entered[f] else -1.0
        out[0, f], out[1, f], out[2, f] = by_type[0, k] - quantity, bounds[r, k], sign * by_type[1, k]
        out[3, f], out[4, f], out[5, f] = distance, approach / distance, sign * by_type[2, k]
    return out


_ONE_END = "a flip was recorded from one end only"


def _noted(segment: Segment, changes: Changes) -> tuple[np.ndarray, np.ndarray]:
    """Pairs and ends of the changes in a segment's rows."""
    found, both = np.asarray(changes.count).tolist()
    pairs, ends = changes.first(min(found, len(changes.pairs)))
    if 2 * found != both:
        raise MdnumError(_ONE_END, remedy="Report this as a bug")
    kept = np.searchsorted(pairs[:, 0], segment.rows)
    return pairs[:kept], ends[:kept]


class AmbiguousPairs(NamedTuple):
    """Pair decisions that another legitimate rounding could have made otherwise, a row each.

    Attributes:
        step: of the decision.
        i, j: the pair, i < j.
        margin, bound: of the decision, and on the rounding error of its quantity; |margin| <= bound.
    """

    step: Int[np.ndarray, "rows"]
    i: Int[np.ndarray, "rows"]
    j: Int[np.ndarray, "rows"]
    margin: Float[np.ndarray, "rows"]
    bound: Float[np.ndarray, "rows"]

    def where(self, chosen) -> AmbiguousPairs:
        """Some of the rows: a mask, a slice or indices."""
        return AmbiguousPairs(*(column[chosen] for column in self))

    @classmethod
    def joined(cls, parts: list[AmbiguousPairs]) -> AmbiguousPairs:
        """The rows of several, one after the other."""
        whole, real = np.zeros(0, np.int64), np.zeros(0)
        parts = [cls(whole, whole, whole, real, real), *parts]
        step, i, j, margin, bound = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return cls(step, i, j, margin, bound)


class PairRecorder:
    """Writes the `pair` channel of a simulation.

    A flip is a difference between what the program acted on at two steps, also where a new list came in
    between: one that a spent list had missed enters when the new list finds it, one that has flown beyond the
    new list leaves.

    Args:
        simulation: the system as objects.
        held: keys of the pairs that the list before the first one counted as inside, where a run goes on
            with a new list.
    """

    def __init__(self, simulation: Simulation, held: Int[np.ndarray, "pairs"] | None = None):
        self.simulation = simulation
        self._held_keys = held
        # the list that has ended, its last decisions and how many are yes
        self._held_segment: tuple[PairTable, UInt8[Array | np.ndarray, "words atoms"], int] | None = None
        self.missed = 0
        decider = simulation.decider
        self._cell, self._decision_cell = HostCell(simulation.cell), HostCell(simulation.cell, decider.dtype)
        self._inclusive = decider.compare.endswith("<=")
        thresholds = np.array([threshold.value for threshold in decider.thresholds])
        self._by_type = np.stack([thresholds, *simulation.jumps()])

    def inside(self, bits: UInt8[np.ndarray, "words atoms"]) -> int:
        """Number of pairs inside; a full list holds each twice."""
        return self._once(int(count_set(bits)))

    def _once(self, both: int) -> int:
        """Pairs, of which both ends were counted."""
        if both % 2:
            raise MdnumError(
                "a pair was decided differently from its two ends", remedy="Report this as a bug"
            )
        return both // 2

    def counts(self, segment: Segment) -> Int[np.ndarray, "rows"]:
        """Pairs inside at every step of a segment."""
        if segment.record.changes is None:
            return np.array([self.inside(bits) for bits in segment.rows_of("bits")], np.int64)
        return np.array([self._once(int(both)) for both in segment.rows_of("inside")], np.int64)

    def bounds(self, segment: Segment) -> Float[np.ndarray, "rows types"]:
        """Bounds on the rounding error of margins at every step of a segment, in the quantity's space."""
        decider = self.simulation.decider
        if not decider.grows:
            return np.tile(np.array(decider.bounds), (segment.rows, 1))
        return decider.bounds_at(segment.rows_of("x"))

    def ambiguous(self, segment: Segment) -> Int[np.ndarray, "rows"]:
        """Pairs whose decision another legitimate rounding could have changed, at every step of a segment."""
        return np.bincount(self.doubtful(segment).step - segment.first, minlength=segment.rows)

    def doubtful(self, segment: Segment) -> AmbiguousPairs:
        """The pairs that `ambiguous` counts, in the order of their steps."""
        parts: list[AmbiguousPairs] = []
        bounds, table = self.bounds(segment), segment.table
        # almost always no pair comes that close; where one does, the host looks again
        close = np.flatnonzero(segment.rows_of("nearest") <= bounds.max(axis=1))
        if len(close):
            slot, first = np.nonzero(table.index < self.simulation.atoms)
            second = table.index[slot, first]
            i, j = table.order[first], table.order[second]
            once = i < j
            first, second, i, j = first[once], second[once], i[once], j[once]
        for row in close:
            x = segment.rows_of("x")[row]
            kind = self.simulation.type_of(i, j)
            d = self._decision_cell.displacement(x[:, first].T, x[:, second].T)
            margin = self.simulation.decider.host_margin(d, kind)
            bound = bounds[row][kind]
            at = np.flatnonzero(np.abs(margin) <= bound)
            at = at[sort_rows(np.zeros(len(at), np.int64), np.stack([i[at], j[at]], axis=1))]
            step = np.full(len(at), segment.first + row, np.int64)
            parts.append(
                AmbiguousPairs(step, i[at].astype(np.int64), j[at].astype(np.int64), margin[at], bound[at])
            )
        return AmbiguousPairs.joined(parts)

    def flips(self, segment: Segment) -> Ledger:
        """The flips of a segment, sorted by step, i and j (user's labels, i < j).

        Distance, margin and radial speed are those of the step of the flip, the margin with the bits that the
        decision was made with.

        Raises:
            MdnumError: a flip was recorded from one end only, or a margin contradicts its decision: the
                compiled program and the host would disagree about arithmetic.
        """
        table, changes = segment.table, segment.record.changes
        replaced = self._replace(segment)
        if changes is not None and replaced is None:
            pairs, ends = _noted(segment, changes)
        else:
            bits = segment.rows_of("bits")
            changed = changes_in_time(np.asarray(segment.before) if replaced is None else bits[0], bits)
            found, pairs = _from_first_end(*changed, table.index)
            if 2 * found != len(changed[0]):
                raise MdnumError(_ONE_END, remedy="Report this as a bug")
            if replaced is not None:
                keys, now = replaced
                atoms = np.argsort(table.order)[np.stack(np.divmod(keys, self.simulation.atoms))]
                added = np.stack([np.zeros(len(keys), np.int64), *atoms, now], axis=1).astype(np.int32)
                pairs = np.concatenate([added, pairs])
            ends = _ends(segment.rows_of("x"), segment.rows_of("v"), pairs)
        if segment.closes:
            if segment.held is None:
                bits = np.array(segment.rows_of("bits")[-1])
                self._held_segment = table, bits, count_set(bits)
            else:
                self._held_segment = table, segment.held, int(segment.rows_of("inside")[-1])
            self._held_keys = None
        i, j = table.order[pairs[:, 1]], table.order[pairs[:, 2]]
        labels = np.stack([np.minimum(i, j), np.maximum(i, j)], axis=1)
        order = sort_rows(pairs[:, 0], labels)
        return self._ledger(segment, ends, order, pairs[order, 0], pairs[order, 3], labels[order])

    def held(self) -> Int[np.ndarray, "pairs"] | None:
        """Keys of the pairs inside at the last step, where a list has ended with it."""
        if self._held_segment is not None:
            table, bits, _ = self._held_segment
            self._held_keys = _keys(self.simulation, table, np.asarray(bits))
        return self._held_keys

    def _cannot_differ(self, segment: Segment) -> bool:
        """Whether the two lists hold the same pairs inside for certain."""
        rule = self.simulation.rule
        if self._held_segment is None or not rule.safe:
            return False
        return 2 * float(segment.leap) < rule.skin and self._held_segment[2] == int(segment.inside)

    def _replace(self, segment: Segment) -> tuple[np.ndarray, np.ndarray] | None:
        """Where a new list and the one before it disagree on the step before: the flips between the two."""
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

    def _ledger(self, segment: Segment, ends, chosen, row, entered, labels) -> Ledger:
        entered = entered.astype(bool)
        kind = self.simulation.type_of(labels[:, 0], labels[:, 1])
        measured = _measure(
            ends, chosen, row, entered, kind, self._by_type, self.bounds(segment),
            self.simulation.decider.space == "r", self._decision_cell.lattice, self._cell.lattice,
        )  # fmt: skip
        margin, bound, jump, distance, speed, force_jump = measured
        if not np.array_equal(margin >= 0 if self._inclusive else margin > 0, entered):
            raise MdnumError(
                "a recorded margin contradicts its decision",
                remedy="Run `mdnum doctor`; the compiled arithmetic is not the one expected",
            )
        # user units of time: the ledger is for people
        speed = speed * self.simulation.units.time_factor
        extra = {"distance": distance, "radial_speed": speed, "force_jump": force_jump}
        step = segment.first + row.astype(np.int64)
        return Ledger("pair", step, labels.astype(np.int64), entered, margin, bound, jump, extra)


def flip_columns(ledger: Ledger) -> dict[str, np.ndarray]:
    """The rows of a pair ledger as the columns of flips.parquet."""
    return {
        "step": ledger.step,
        "i": ledger.subject[:, 0],
        "j": ledger.subject[:, 1],
        "entered": ledger.entered,
        "distance": ledger.extra["distance"],
        "margin": ledger.margin,
        "radial_speed": ledger.extra["radial_speed"],
        "energy_jump": ledger.jump,
        "force_jump": ledger.extra["force_jump"],
        "bound": ledger.bound,
        "ambiguous": ledger.ambiguous,
    }


def pair_keys(
    i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"], atoms: int
) -> Int[np.ndarray, "pairs"]:
    """One sorted integer for each pair i < j."""
    return np.sort(i.astype(np.int64) * atoms + j)


def _keys(simulation: Simulation, table: PairTable, bits: UInt8[np.ndarray, "words atoms"]):
    """Sorted keys of the pairs inside."""
    keys = np.empty(count_set(bits), np.int64)
    return keys[: _write_keys(bits, table.index, table.order, np.argsort(table.order), keys)].copy()


@numba.njit(cache=True, nogil=True)
def _write_keys(bits, index, order, place, keys):
    """Keys atom after atom, each with its neighbors in order; returns how many there are."""
    atoms, at = order.shape[0], 0
    for i in range(atoms):
        begin, c = at, place[i]
        for w in range(bits.shape[0]):
            byte = bits[w, c]
            for k in range(8):
                if (byte >> k) & 1 and order[index[8 * w + k, c]] > i:
                    key = i * atoms + order[index[8 * w + k, c]]
                    q = at
                    while q > begin and keys[q - 1] > key:
                        keys[q] = keys[q - 1]
                        q -= 1
                    keys[q] = key
                    at += 1
    return at


def decided_pairs(simulation: Simulation, segment: Segment, row: int) -> Int[np.ndarray, "pairs"]:
    """Keys of the pairs that the program counted as inside at a row of a segment."""
    return _keys(simulation, segment.table, segment.rows_of("bits")[row])


def true_pairs(simulation: Simulation, wrapped: Float[np.ndarray, "atoms 3"]) -> Int[np.ndarray, "pairs"]:
    """Keys of all pairs inside, from a fresh search; same convention and bits as the program's."""
    decider = simulation.decider
    table = simulation.verlet_list(skin=0.0).build(np.asarray(wrapped, np.float64), simulation.cell)
    slot, column = np.nonzero(table.index < simulation.atoms)
    i, j = table.order[column], table.order[table.index[slot, column]]
    keep = i < j
    i, j = i[keep], j[keep]
    d = displacement(simulation.cell, wrapped[i], wrapped[j], np.dtype(decider.dtype))
    margin = decider.host_margin(d, simulation.type_of(i, j))
    inside = margin >= 0 if decider.compare.endswith("<=") else margin > 0
    return pair_keys(i[inside], j[inside], simulation.atoms)
