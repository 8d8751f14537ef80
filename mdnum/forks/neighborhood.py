"""Where the atoms of both runs are at the fork, around the pair that was decided differently."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mdnum.forks.pair import Fork
from mdnum.md.cell import HostCell
from mdnum.rollout.engine import Start
from mdnum.rollout.frame import Frame
from mdnum.rollout.tracks import Track
from mdnum.systems.build import Simulation

#: How far around the pair atoms are shown, in its cutoffs.
REACH = 1.25


@dataclass(frozen=True)
class Neighborhood:
    """Atoms around the deciding pair, at the fork.

    Attributes:
        atoms: labels of A; the pair first, the others by their distance from its middle, shape (near,).
        positions: in A, from the middle of the pair, length, shape (near, 3).
        moved: B's positions minus A's, length, shape (near, 3).
        margins: of the deciding pair in A and in B, as each program computes it, in the quantity's space.
        bounds: on the rounding errors of these.
    """

    atoms: Int[np.ndarray, "near"]
    positions: Float[np.ndarray, "near 3"]
    moved: Float[np.ndarray, "near 3"]
    margins: tuple[float, float]
    bounds: tuple[float, float]


def neighborhood(fork: Fork, reach: float = REACH) -> Neighborhood | None:
    """Follows both runs once more, up to the fork, and looks around the pair; None where there is no fork.

    Args:
        reach: radius, in cutoffs of A.
    """
    if fork.decision is None:
        return None
    twin, decision = fork.twin, fork.decision
    x_a = positions_at(twin.a, decision.step, fork.asked, twin.start_a)
    x_b = positions_at(twin.b, decision.step, fork.asked, twin.start_b, twin.frame)
    if x_a is None or x_b is None:
        return None
    cell = HostCell(twin.a.cell)
    i, j = decision.i, decision.j
    across = np.stack(cell.displacement(x_a[[i]], x_a[[j]]), axis=-1)[0]
    from_i = np.stack(cell.displacement(np.broadcast_to(x_a[i], x_a.shape), x_a), axis=-1)
    # the nearest image of i may be another than that of the middle, so both ends are asked
    from_j = np.stack(cell.displacement(np.broadcast_to(x_a[j], x_a.shape), x_a), axis=-1)
    from_middle = from_i - across / 2
    other = from_j + across / 2
    nearer = (other**2).sum(axis=1) < (from_middle**2).sum(axis=1)
    from_middle[nearer] = other[nearer]
    distance = np.sqrt((from_middle**2).sum(axis=1))
    distance[[i, j]] = -1.0
    order = np.argsort(distance, kind="stable")
    chosen = order[distance[order] <= reach * twin.a.r_cut]
    chosen = np.concatenate([[i, j], chosen[(chosen != i) & (chosen != j)]])
    moved = np.stack(cell.displacement(x_a[chosen], x_b[chosen]), axis=-1)
    margins = _margin(twin.a, twin.a, x_a, i, j), _margin(twin.a, twin.b, x_b, i, j)
    kind = int(twin.a.type_of(np.array([i]), np.array([j]))[0])
    frame = twin.frame or Frame.same(twin.b.atoms)
    own = x_a.T[None], frame.inverse.positions(x_b.T[None])
    a, b = (float(run.decider.bounds_at(x)[0, kind]) for run, x in zip((twin.a, twin.b), own, strict=True))
    return Neighborhood(chosen, from_middle[chosen], moved, margins, (a, b))


def _margin(labels: Simulation, run: Simulation, x: Float[np.ndarray, "atoms 3"], i: int, j: int) -> float:
    """Threshold minus quantity of a pair, in the dtype in which a run decides."""
    kind = int(labels.type_of(np.array([i]), np.array([j]))[0])
    quantity = run.decider.host_quantity(*HostCell(run.cell, run.decider.dtype).displacement(x[[i]], x[[j]]))
    return run.decider.thresholds[kind].value - float(quantity[0])


def positions_at(
    simulation: Simulation, step: int, last: int, start: Start | None = None, frame: Frame | None = None
) -> Float[np.ndarray, "atoms 3"] | None:
    """Wrapped positions of a run at a step; None where it ended before.

    Args:
        last: last step of the run: the same as the first time, so that no program is compiled anew.
        frame: how its atoms and axes are those of the first run.
    """
    track = Track(simulation, last, start, frame, flips=False)
    while track.segment() is not None:
        rows, _ = track.until(track.ready)
        if rows is not None and rows.first + len(rows) > step:
            return np.ascontiguousarray(rows.x[step - rows.first].T)
    return None
