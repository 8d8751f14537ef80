"""Pairs that turn back near the cutoff, and their effect on gradients.

A pair that turns back just outside its cutoff causes no flip. If the pair came slightly closer, it would
cross the cutoff twice at a low radial speed. A crossing contributes to the gradient in proportion to 1 /
radial speed. A pair that turns back just inside the cutoff has two crossings. A small perturbation can remove
both crossings. Therefore, all turning points near the cutoff are examined, also those between two steps.

Near the turning point the distance is r(t) = r_m + a (t - t_m)² / 2. A pair that passes the cutoff by a depth
d crosses the cutoff at speed sqrt(2 a d). Two crossings contribute 2 w / sqrt(2 a d), where w is the
contribution at unit speed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mdnum.gradients.adjoint import AdjointCarry
from mdnum.gradients.parameters import directions
from mdnum.gradients.tangents import StretchTangents
from mdnum.gradients.tape import Pace, TapeStretch, listed
from mdnum.md.cell import HostCell
from mdnum.systems.simulation import Simulation

#: Largest distance of a listed turning point from the cutoff, as a share of the cutoff; if distances change
#: by more than this at another time step, the runs are not comparable.
LOOK = 0.02
#: Number of rows that share one choice of pairs.
_BLOCK = 8
#: How many times shorter the steps are that tell where pairs turn around, and how far from there the exact
#: motion may take them, by how far that is from the run's own: a fifteenth of it where the error of flips
#: goes with the time step, and three times that is allowed for. A crossing adds the more the less deep it is,
#: without limit: of those within reach what counts is what one adds at this share of the reach.
FINER, REACH, SHALLOW = 16, 0.2, 0.01
#: Number of turning points, in the order of their steps, over which the typical change of a distance is
#: computed.
_NEIGHBORS = 20


#: Columns of the table of turning points: integers, vectors and numbers; the last ones are added later.
_WHOLE, _VECTORS = ("step", "row", "i", "j", "a", "b", "kind"), ("normal", "images")
_LATER = ("weight", "shift", "finer")
_NUMBERS = ("gap", "bend", "side", "unseen", "part", "before", "after", *_LATER)


@dataclass(frozen=True)
class Turns:
    """Table of turning points of pair distances near the cutoff.

    Attributes:
        table: one row per turning point, in the order of steps, with the columns
            step: the step after the turning point. row: row of this step in its stretch of steps.
            i, j: the pair, i < j. a, b: the pair in the order of the neighbor list. kind: pair type.
            gap: distance to the cutoff, length; negative if the pair passed the cutoff.
            side: 1 for a minimum of the distance, -1 for a maximum.
            bend: magnitude of the second time derivative of the distance, length per internal time².
            unseen: whether the pair passed the cutoff only between two steps, without a recorded flip.
            weight: derivative of the loss with respect to the cutoff of one crossing, times radial speed.
            moved: distance by which the cutoff moves ahead of the pair, per unit of each parameter entry;
            NaN before the tangents have been computed.
            shift: largest change of the distance in other runs (another time step, another rounding),
            length; 0 before any other run. finer: change of the distance with shorter time steps.
            normal: unit vector from a to b. images: lattice vectors from wrapped to nearest image of b.
            part: time between the two steps, as a fraction. before, after: distances at the two steps.
    """

    table: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.table["step"])

    @property
    def gap(self) -> Float[np.ndarray, "turns"]:
        """Distance from the turning point to r_cut. Negative if the pair crossed r_cut."""
        return self.table["gap"] + self.table["side"] * self.table["finer"]

    @property
    def reach(self) -> Float[np.ndarray, "turns"]:
        """Uncertainty of the pair distance at each turning point, from a run with shorter time steps."""
        if not len(self):
            return np.zeros(0)
        shift = self.table["shift"]
        sums = np.concatenate([[0.0], np.cumsum(np.square(shift))])
        last = np.clip(np.arange(len(self)) + _NEIGHBORS // 2, min(_NEIGHBORS, len(self)), len(self))
        first = np.maximum(last - _NEIGHBORS, 0)
        typical = np.sqrt((sums[last] - sums[first]) / (last - first))
        return REACH * np.maximum(shift, typical)

    @property
    def within(self) -> np.ndarray:
        """True if a distance equals the cutoff within its error, or a crossing was not recorded."""
        return (np.abs(self.gap) <= self.reach) | self.table["unseen"]

    @property
    def term(self) -> Float[np.ndarray, "turns columns"]:
        """Largest possible contribution of the two crossings at each turning point. If a distance equals the
        cutoff within its uncertainty, the pair is assumed to pass the cutoff by 1 % of the uncertainty. For
        other pairs, the result is the change of the contribution when the time step is shortened.
        """
        bend, reach = self.table["bend"], self.reach

        def added(gap):
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.where(gap < 0, 1 / np.sqrt(2 * bend * np.abs(gap)), 0.0)

        own = np.where(self.table["unseen"], 0.0, added(self.table["gap"]))
        times = np.where(np.abs(self.gap) <= reach, added(-SHALLOW * reach), np.abs(own - added(self.gap)))
        terms = np.abs(2 * self.table["weight"][:, None] * self.table["moved"])
        # what is not known weighs, but not where nothing is to be known
        return np.where(times[:, None] == 0, 0.0, terms * times[:, None])

    def heaviest(
        self, words: tuple[str, ...], named: Callable[[Any], dict[str, Any]], most: int = 10
    ) -> list[dict[str, Any]]:
        """Return the turning points with the largest contributions, as plain values.

        Args:
            named: returns further columns for a kind of decision.
        """
        kept = np.flatnonzero(self.term.any(axis=1))
        term, reach, table, gap = self.term, self.reach, self.table, self.gap
        share = term[kept] / np.maximum(term.max(axis=0, initial=0.0), 1e-300)
        order = kept[np.argsort(-share.max(axis=1, initial=0.0), kind="stable")][:most]
        return [
            {
                "step": int(table["step"][k]), "i": int(table["i"][k]), "j": int(table["j"][k]),
                **named(table["kind"][k]), "gap": float(gap[k]), "reach": float(reach[k]),
                "term": {word: float(value) for word, value in zip(words, term[k], strict=True)},
            }
            for k in order
        ]  # fmt: skip


@dataclass
class Near:
    """Collector of turning points near the cutoff in a reverse pass."""

    simulation: Simulation
    pace: Pace  # how often the loss looks
    rows: int = 0  # of the longest stretch
    #: Tables by the first step of their stretch, last stretch first.
    _found: dict[int, dict[str, np.ndarray]] = field(default_factory=dict)
    #: Distance by which the cutoff moves ahead of the pair at each flip, for each stretch, first stretch
    #: first.
    moved: list[np.ndarray] = field(default_factory=list)

    @property
    def jumps(self) -> bool:
        """True if the force or energy of a pair jumps at the cutoff."""
        return self.simulation.pairwise and bool(np.any(np.asarray(self.simulation.jumps())))

    def reverse(self, stretch: TapeStretch, trace: AdjointCarry) -> None:
        """Find turning points in a stretch of steps, with their weights."""
        if not self.jumps:
            return
        simulation = self.simulation
        self.rows = max(self.rows, len(stretch.x))
        self._found[stretch.first] = found = turning(simulation, stretch)
        row, a, b = found["row"], found["a"], found["b"]
        half = 0.5 * float(simulation.integrator.timestep)
        masses = simulation.masses[stretch.table.order]
        onto_x, onto_v = (np.asarray(part) for part in (trace.x, trace.v))

        def impulse(atom):
            return (onto_v[row, :, atom] + half * onto_x[row, :, atom]) / masses[atom][:, None]

        along = np.sum(found["normal"] * (impulse(b) - impulse(a)), axis=1)
        by_energy, by_virial = (np.asarray(part)[row] for part in trace.frame)
        timestep, share = simulation.integrator.timestep, np.zeros(len(row))
        for step in np.unique(found["step"][(by_energy != 0) | (by_virial != 0)]):
            share[found["step"] == step] = float(self.pace.share(jnp.asarray(step), timestep))
        channel = found["kind"] // simulation.pair_types
        energy, force = simulation.jumps_of(found["i"] + channel * simulation.atoms, found["j"])
        radius = np.asarray(simulation.decider.r_cut)[found["kind"]]
        seen = share * (by_energy * energy + by_virial * force * radius)
        found["weight"] = force * along + seen

    def tangents(self, part: StretchTangents) -> None:
        """Compute how each parameter changes r_cut - r at turning points."""
        simulation, stretch = self.simulation, part.stretch
        if part.dr is not None and part.dr_cut is not None:
            self.moved.append(part.dr_cut - part.dr)
        found = self._found.get(stretch.first)
        if found is None:
            return
        along = directions(simulation, part.columns)
        matrix, row = np.asarray(along.matrix), found["row"]
        x, v = part.x, part.v
        assert x is not None and v is not None
        late = (1 - found["part"]) * float(simulation.integrator.timestep)

        def moved(atom):
            rows = x[row, :, :, atom] - late[:, None, None] * v[row, :, :, atom]
            images = stretch.images[row, :, atom].astype(np.float64)
            return rows - np.einsum("cab,ra->rcb", matrix, images)

        apart = moved(found["b"]) - moved(found["a"])
        apart = apart + np.einsum("cab,ra->rcb", matrix, found["images"])
        dr = np.einsum("rcb,rb->rc", apart, found["normal"])
        found["moved"] = np.asarray(along.r_cut).T[found["kind"]] - dr

    def compared(self, stretch: TapeStretch, per: int) -> None:
        """Compare turning points with those of a run with `per` times as many steps."""
        cell, place = HostCell(self.simulation.cell), stretch.table.place
        for found in self._found.values():
            for earlier, name in ((1, "before"), (0, "after")):
                row = per * (found["step"] - earlier) - stretch.first
                here = np.flatnonzero((row >= 0) & (row < stretch.rows))
                if not len(here):
                    continue
                a, b = (
                    stretch.x[row[here], :, place[found[label][here]]].astype(np.float64) for label in "ij"
                )
                r = np.linalg.norm(np.stack(cell.displacement(a, b), axis=1), axis=1)
                further = r - found[name][here]
                found["shift"][here] = np.maximum(found["shift"][here], np.abs(further))
                if per == FINER:
                    part = found["part"][here]
                    found["finer"][here] += (1 - part if earlier else part) * further

    def turns(self, columns: int) -> Turns:
        """Return all turning points that were found, in the order of their steps."""
        rows = [
            # where no tangents have been, how far the cutoff moves is not known
            found | {"moved": found.get("moved", np.full((len(found["step"]), columns), np.nan))}
            for found in reversed(self._found.values())
        ]
        table = _joined(rows, moved=np.zeros((0, columns)))
        order = np.argsort(table["step"], kind="stable")
        return Turns({name: column[order] for name, column in table.items()})


def _joined(rows: list[dict[str, np.ndarray]], **more: np.ndarray) -> dict[str, np.ndarray]:
    """Concatenate tables of turning points. Without tables, the result is empty."""
    empty = {name: np.zeros(0, np.int64) for name in _WHOLE}
    empty |= {name: np.zeros((0, 3)) for name in _VECTORS} | {name: np.zeros(0) for name in _NUMBERS}
    empty |= more
    table = {name: np.concatenate([row[name] for row in rows] or [none]) for name, none in empty.items()}
    return table | {"unseen": table["unseen"].astype(bool)}


def hermite(
    r0: np.ndarray, s0: np.ndarray, r1: np.ndarray, s1: np.ndarray, time: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the extremum of the cubic polynomial that interpolates a pair distance over time.

    Args:
        r0, s0, r1, s1: distance and its rate at the two ends. time: between the ends.

    Returns:
        the position between the ends (0 to 1), the distance there, and its second derivative by time.

    Error: of the distance, r'''' time⁴ / 384.
    """
    first, last = time * s0, time * s1
    square, cube = 3 * (r1 - r0) - 2 * first - last, first + last - 2 * (r1 - r0)
    u = first / (first - last)
    for _ in range(4):
        slope, bend = first + u * (2 * square + 3 * u * cube), 2 * square + 6 * u * cube
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.clip(np.where(bend != 0, u - slope / bend, u), 0.0, 1.0)
    return u, r0 + u * (first + u * (square + u * cube)), (2 * square + 6 * u * cube) / time**2


def turning(simulation: Simulation, stretch: TapeStretch) -> dict[str, np.ndarray]:
    """Find turning points near the cutoff in a stretch of steps.

    Returns:
        the table of `Turns`, with weights and shifts still 0, and without the column `moved`.
    """
    order = stretch.table.order
    i, j, kind = listed(simulation, stretch.table)
    radius = np.asarray(simulation.decider.r_cut, np.float64)[kind]
    time = float(simulation.integrator.timestep)
    cell = HostCell(simulation.cell)

    def apart(x, i, j):
        return np.stack(cell.displacement(x[:, i].T, x[:, j].T), axis=1)

    rows: list[dict[str, np.ndarray]] = []
    for low in range(0, stretch.rows, _BLOCK):
        high = min(low + _BLOCK, stretch.rows)
        v = stretch.v[low:high].astype(np.float64)
        fastest = float(np.sqrt(np.max(np.sum(v * v, axis=1), initial=0.0)))
        x = [stretch.x_before if low == 0 else stretch.x[low - 1], *stretch.x[low:high]]
        far = np.linalg.norm(apart(x[1].astype(np.float64), i, j), axis=1)
        # nobody outruns twice the fastest atom of the block
        near = np.abs(far - radius) < LOOK * radius + 2.5 * fastest * time * (high - low)
        a, b, cut, which = i[near], j[near], radius[near], kind[near]
        before = None
        for row in range(low - 1, high):
            if row < 0 and stretch.first == 0:
                continue
            d = apart(x[row - low + 1].astype(np.float64), a, b)
            r = np.linalg.norm(d, axis=1)
            rate = None
            if row >= 0:
                u = stretch.v[row].astype(np.float64)
                rate = np.sum(d * (u[:, b] - u[:, a]).T, axis=1) / r
            if before is not None:
                assert rate is not None
                r0, s0, d0 = before
                # of the step before the stretch the velocities are gone
                s0 = 2 * (r - r0) / time - rate if s0 is None else s0
                turned = np.flatnonzero(
                    (s0 * rate < 0) & (np.minimum(abs(r0 - cut), abs(r - cut)) < LOOK * cut)
                )
                if len(turned):
                    part, there, bend = hermite(r0[turned], s0[turned], r[turned], rate[turned], time)
                    middle = d0[turned] + d[turned]
                    side, ends = np.sign(bend), np.stack([r0[turned], r[turned]]) - cut[turned]
                    gap = side * (there - cut[turned])
                    raw = (stretch.x[row][:, b[turned]] - stretch.x[row][:, a[turned]]).T.astype(np.float64)
                    names = {"step": stretch.first + row, "row": row, **dict.fromkeys(_LATER, 0.0)}
                    rows.append(
                        {name: np.full(len(turned), value) for name, value in names.items()}
                        | {
                            "i": order[a[turned]], "j": order[b[turned]], "a": a[turned], "b": b[turned],
                            "kind": which[turned], "gap": gap, "bend": np.abs(bend), "side": side,
                            "unseen": (gap < 0) & (side * ends > 0).all(axis=0),
                            "normal": middle / np.linalg.norm(middle, axis=1, keepdims=True),
                            "images": d[turned] - raw, "part": part, "before": r0[turned], "after": r[turned],
                        }
                    )  # fmt: skip
            before = (r, rate, d)
    table = _joined(rows)
    return table | {"images": np.rint(table["images"] @ np.asarray(simulation.cell.inverse, np.float64))}
