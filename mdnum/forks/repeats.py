"""A pair of runs again from perturbed starts: what the flips are worth, more than once.

Each repeat is B from a start of its own, free and under A's decisions; both are compared with the same A.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mdnum.forks.twin import Twin
from mdnum.rollout.compared import Apart
from mdnum.rollout.engine import Segment, Start, first_state
from mdnum.rollout.frame import Frame
from mdnum.rollout.handed import Handed
from mdnum.rollout.lockstep import Counterfactual, apart, lockstep
from mdnum.rollout.tracks import Track
from mdnum.systems.build import Simulation

#: A perturbation is at most so many tolerances: a choice that changes everything at once still leaves room.
_LARGEST = 1e-3
#: A choice's own perturbation is measured over so many steps.
_FIRST = 100


def perturbed(twin: Twin, tolerance: float, count: int, seed: int) -> list[Start]:
    """Starts of B, displaced by as much as the choice separates the runs in their first 100 steps.

    Args:
        twin: the pair.
        tolerance: of the split, length; a displacement is a thousandth of it at most.
        count: how many starts; the first ones do not depend on it.
        seed: of the displacements.
    """
    size = min(seed_size(twin, _FIRST), _LARGEST * tolerance)
    return nudged(twin.b, twin.start_b or first_state(twin.b), size, count, seed)


def repeat(
    twin: Twin, starts: Sequence[Start], last: int, tolerance: float, guard: float
) -> list[tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]]:
    """Separations from A of B from each start, free and under A's decisions.

    Args:
        twin: the pair.
        starts: of B.
        last: last step; it ends earlier where every run has split.
        tolerance: of the split, length.
        guard: length; a run under A's decisions ends where one of them is further than this from its cutoff.

    Returns:
        For each start both at each step from 0 on, length; NaN after a run was ended.
    """
    a, b = twin.a, twin.b
    frame = twin.frame or Frame.same(a.atoms)
    handed = [Counterfactual(Handed(b, a, start, frame), guard) for start in starts]

    def listen(segment: Segment) -> None:
        for run in handed:
            run(segment)

    leader = Track(a, last, twin.start_a, flips=False, listener=listen)
    free = [Track(b, last, start, frame, flips=False) for start in starts]
    cell = Apart(a.cell)
    parts: list[tuple[list[np.ndarray], list[np.ndarray]]] = [([], []) for _ in starts]
    while leader.segment() is not None:
        end = leader.ready
        rows, _ = leader.until(end)
        for (own, told), run, under in zip(parts, free, handed, strict=True):
            own.append(apart(cell, rows, run.until(end)[0]))
            told.append(apart(cell, rows, under.until(end)[0]))
        if all(any((part > tolerance).any() for part in one) for pair in parts for one in pair):
            break
    return [(np.concatenate(own), np.concatenate(told)) for own, told in parts]


def seed_size(twin: Twin, steps: int = _FIRST) -> float:
    """The largest separation of a pair within its first steps, length: how much the choice perturbs a run.

    A smaller perturbation would leave the rounding errors of both runs the same, and their splits with them.
    """
    largest = 0.0
    for stretch in lockstep(
        twin.a,
        twin.b,
        steps,
        start_a=twin.start_a,
        start_b=twin.start_b,
        frame=twin.frame,
        handed=False,
    ):
        largest = max(largest, float(np.nanmax(stretch.separation["B"], initial=0.0)))
    return largest


def nudged(simulation: Simulation, start: Start, size: float, count: int, seed: int) -> list[Start]:
    """Starts whose atoms are displaced at random, the furthest by about a given length.

    At least an ulp: a smaller displacement would be lost in the first addition.
    """
    rng = np.random.default_rng(seed)
    x = np.asarray(start.state.x)
    ulp = float(np.spacing(np.abs(x).max().astype(x.dtype)))
    starts = []
    for _ in range(count):
        noise = rng.standard_normal(x.shape)
        noise *= max(size, ulp) / np.sqrt((noise**2).sum(axis=0)).max()
        moved = (x.astype(np.float64) + noise).astype(x.dtype)
        state = start.state._replace(x=jnp.asarray(moved), x_before=jnp.asarray(moved))
        starts.append(replace(start, state=state, reference=moved.T.astype(np.float64)))
    return starts
