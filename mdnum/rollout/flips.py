"""From packed decisions to ledger rows: which pair flipped when, by how much, and what it did."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8

from mdnum.errors import MdnumError
from mdnum.events import Ledger, changed_bits, count_set, sort_rows
from mdnum.md.cell import displacement
from mdnum.rollout.engine import Segment
from mdnum.systems.build import Simulation


class PairRecorder:
    """Writes the `pair` channel of a simulation.

    Args:
        simulation: the system as objects.
    """

    def __init__(self, simulation: Simulation):
        self.simulation = simulation
        decider = simulation.decider
        self._dtype = np.dtype(decider.dtype)
        self._inclusive = decider.compare.endswith("<=")
        self._thresholds = np.array([t.value for t in decider.thresholds])
        self._bounds = np.array(decider.bounds)
        self._energy_jumps, self._force_jumps = simulation.jumps()

    def inside(self, bits: UInt8[np.ndarray, "words atoms"]) -> int:
        """Number of pairs inside; a full list holds each twice."""
        both = int(count_set(bits))
        if both % 2:
            raise MdnumError(
                "a pair was decided differently from its two ends", remedy="Report this as a bug"
            )
        return both // 2

    def counts(self, segment: Segment) -> Int[np.ndarray, "rows"]:
        """Pairs inside at every step of a segment."""
        return np.array([self.inside(bits) for bits in segment.rows_of("bits")], np.int64)

    def ambiguous(self, segment: Segment) -> Int[np.ndarray, "rows"]:
        """Pairs whose decision another legitimate rounding could have changed, at every step of a segment."""
        counts = np.zeros(segment.rows, np.int64)
        bounds = self._bounds
        # almost always no pair comes that close; where one does, the host looks again
        for row in np.flatnonzero(segment.rows_of("nearest") <= bounds.max()):
            table, x = segment.table, segment.rows_of("x")[row]
            slot, first = np.nonzero(table.index < self.simulation.atoms)
            second = table.index[slot, first]
            i, j = table.order[first], table.order[second]
            _, margin = self._margins(x[:, first].T, x[:, second].T, i, j)
            kind = self.simulation.type_of(i, j)
            counts[row] = int(np.sum((np.abs(margin) <= bounds[kind]) & (i < j)))
        return counts

    def _margins(self, start, end, i, j):
        """Pair types and margins of pairs at given positions, with the bits of the program's decision."""
        kind = self.simulation.type_of(i, j)
        d = displacement(self.simulation.cell, start, end, self._dtype)
        quantity = self.simulation.decider.host_quantity(*d).astype(np.float64)
        return kind, self._thresholds[kind] - quantity

    def flips(self, segment: Segment) -> Ledger:
        """The flips of a segment, sorted by step, i and j (user's labels, i < j).

        Distance, margin and radial speed are those of the step of the flip, the margin with the bits that the
        decision was made with.

        Raises:
            MdnumError: a flip was recorded from one end only, or a margin contradicts its decision: the
                compiled program and the host would disagree about arithmetic.
        """
        bits = segment.rows_of("bits")
        before = segment.before
        assert before is not None
        found = [
            (row, *changed_bits(bits[row - 1] if row else before, bits[row])) for row in range(segment.rows)
        ]
        row = np.concatenate([np.full(len(slots), r, np.int64) for r, slots, _, _ in found])
        slot = np.concatenate([slots for _, slots, _, _ in found])
        column = np.concatenate([columns for _, _, columns, _ in found])
        entered = np.concatenate([values for _, _, _, values in found]).astype(bool)
        neighbor = segment.table.index[slot, column].astype(np.int64)
        i, j = segment.table.order[column], segment.table.order[neighbor]
        keep = i < j
        if 2 * int(keep.sum()) != len(keep):
            raise MdnumError("a flip was recorded from one end only", remedy="Report this as a bug")
        row, column, neighbor, entered, i, j = (a[keep] for a in (row, column, neighbor, entered, i, j))
        return self._ledger(segment, row, column, neighbor, entered, np.stack([i, j], axis=1))

    def _ledger(self, segment: Segment, row, first, second, entered, labels) -> Ledger:
        simulation = self.simulation
        x, v = segment.rows_of("x"), segment.rows_of("v")
        start, end = x[row, :, first], x[row, :, second]
        kind, margin = self._margins(start, end, labels[:, 0], labels[:, 1])
        if not np.array_equal(margin >= 0 if self._inclusive else margin > 0, entered):
            raise MdnumError(
                "a recorded margin contradicts its decision",
                remedy="Run `mdnum doctor`; the compiled arithmetic is not the one expected",
            )
        d = np.stack(displacement(simulation.cell, start, end), axis=1)
        distance = np.sqrt(np.sum(d * d, axis=1))
        approach = np.sum((v[row, :, second] - v[row, :, first]).astype(np.float64) * d, axis=1)
        sign = np.where(entered, 1.0, -1.0)
        step = segment.first + row
        order = sort_rows(step, labels)
        with np.errstate(invalid="ignore", divide="ignore"):
            extra = {
                "distance": distance[order],
                # user units of time: the ledger is for people
                "radial_speed": (approach / distance)[order] * simulation.units.time_factor,
                "force_jump": (sign * self._force_jumps[kind])[order],
            }
        return Ledger(
            "pair",
            step[order],
            labels[order],
            entered[order],
            margin[order],
            self._bounds[kind][order],
            (sign * self._energy_jumps[kind])[order],
            extra,
        )


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


def decided_pairs(simulation: Simulation, segment: Segment, row: int) -> Int[np.ndarray, "pairs"]:
    """Keys of the pairs that the program counted as inside at a row of a segment."""
    i, j, _ = simulation.inside(
        segment.unsorted("x", row).astype(np.float64), segment.table, segment.rows_of("bits")[row]
    )
    return pair_keys(i, j, simulation.atoms)


def true_pairs(simulation: Simulation, wrapped: Float[np.ndarray, "atoms 3"]) -> Int[np.ndarray, "pairs"]:
    """Keys of all pairs inside, from a fresh search; same convention and bits as the program's."""
    decider = simulation.decider
    table = simulation.verlet_list(skin=0.0).build(np.asarray(wrapped, np.float64), simulation.cell)
    slot, column = np.nonzero(table.index < simulation.atoms)
    i, j = table.order[column], table.order[table.index[slot, column]]
    keep = i < j
    i, j = i[keep], j[keep]
    d = displacement(simulation.cell, wrapped[i], wrapped[j], np.dtype(decider.dtype))
    values = np.array([t.value for t in decider.thresholds], np.dtype(decider.dtype))
    inside = decider.inside(decider.host_quantity(*d), values[simulation.type_of(i, j)])
    return pair_keys(i[inside], j[inside], simulation.atoms)
