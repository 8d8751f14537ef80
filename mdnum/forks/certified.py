"""How far the decisions of two runs can be trusted: each by itself, and one against the other.

Three dates. Up to its *certified horizon* no decision of a run was within its rounding bound: in exact
arithmetic, from the same states, every one would have come out the same. Up to the end of their *protection*
the pair of atoms next to its cutoff was further from it than the separation of the runs can have moved it. As
long as both hold, no decision can differ. And where one program is the wider one in every role, the other
agrees with it on every decision up to the *shadow horizon*.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.forks.pair import Fork
from mdnum.md.decide import PairDecider
from mdnum.numerics.rounding import unit_roundoff
from mdnum.program import Twin
from mdnum.systems.build import Simulation

ROLES = ("state", "force", "decision", "accumulate")


@dataclass(frozen=True)
class Horizon:
    """Decisions of one run against their own rounding.

    Attributes:
        step: the last one before the first ambiguous decision; the last one followed where there is none,
            -1 where the start is ambiguous.
        decisions: ambiguous ones, a step's pair counted at each step.
        steps: at which there are any.
        complete: whether the list is certain to hold every pair; where not, the horizon is of listed pairs.
    """

    step: int
    decisions: int
    steps: int
    complete: bool


@dataclass(frozen=True)
class Certified:
    """The three dates of a pair of runs.

    Attributes:
        horizon: by run, "A" and "B"; nothing for many-body potentials, which decide inside their energy
            function, without a rounding bound.
        protected: the last step up to which every pair was further from its cutoff than twice the separation
            of the runs and what their cutoffs differ by; -1 where it is not so at the first step. None for
            many-body potentials.
        shadow: the wider of the two programs, "A" or "B"; None where neither is.
        shadow_step: the last step up to which they decided alike; None without a shadow.
    """

    horizon: Mapping[str, Horizon]
    protected: int | None
    shadow: str | None
    shadow_step: int | None


def certified(fork: Fork) -> Certified:
    """The dates of a pair that was followed."""
    twin = fork.twin
    last = fork.steps
    if twin.a.imposable or twin.b.imposable:
        return Certified({}, None, None, None)
    runs = (("A", twin.a.simulation), ("B", twin.b.simulation))
    horizon = {name: _horizon(run, fork.series[f"ambiguous {name}"]) for name, run in runs}
    away, needed = protection(fork)
    bare = np.flatnonzero(~(away > needed))
    shadow = wider(twin)
    agreed = last if fork.dates.fork is None else fork.dates.fork - 1
    return Certified(
        horizon, int(bare[0]) - 1 if len(bare) else last, shadow, None if shadow is None else agreed
    )


def _horizon(run: Simulation, ambiguous: Float[np.ndarray, "steps"]) -> Horizon:
    at = np.flatnonzero(ambiguous > 0)
    seen = np.flatnonzero(np.isfinite(ambiguous))
    last = int(seen[-1]) if len(seen) else -1
    return Horizon(int(at[0]) - 1 if len(at) else last, int(np.nansum(ambiguous)), len(at), run.rule.safe)


def protection(fork: Fork) -> tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]:
    """How far the nearest pair is from its cutoff at each step, and how far it would have to be, length.

    Two atoms may each be off by the separation, so their distance by twice that. Margins are those of the run
    whose own rounding is smaller, which is allowed for.
    """
    deciders = {"A": fork.twin.a.simulation.decider, "B": fork.twin.b.simulation.decider}
    a, b = deciders.values()
    cutoffs = float(np.max(np.abs(_cutoffs(a) - _cutoffs(b)))) if len(a.r_cut) == len(b.r_cut) else np.inf
    finer = min(deciders, key=lambda name: np.nanmax(fork.series[f"bound {name}"]))
    rest = cutoffs + fork.series[f"bound {finer}"]
    return fork.series[f"nearest {finer}"], 2.0 * fork.series["B"] + rest


def _cutoffs(decider: PairDecider) -> Float[np.ndarray, "types"]:
    """What is compared with, in the program's dtype, as a distance."""
    values = np.array([threshold.value for threshold in decider.thresholds])
    return np.sqrt(values) if decider.space == "r2" else values


def wider(twin: Twin) -> str | None:
    """The program that has at least the other's precision in every role and more in one; None for neither.

    Only of programs that are otherwise the same: what another time step decides differently is no rounding.
    """
    a, b = twin.a.simulation, twin.b.simulation
    if twin.a.begin is not None or twin.b.begin is not None or _but_for_roles(a) != _but_for_roles(b):
        return None
    if not (np.array_equal(a.positions, b.positions) and np.array_equal(a.velocities, b.velocities)):
        return None
    # a smaller roundoff is a wider float
    first, second = (np.array([unit_roundoff(run.policy.dtype(role)) for role in ROLES]) for run in (a, b))
    if (first == second).all():
        return None
    return "A" if (first <= second).all() else "B" if (second <= first).all() else None


def _but_for_roles(run: Simulation) -> tuple[Any, ...]:
    """What must be the same in a program and its shadow."""
    spec = run.system.spec.model_dump(mode="json")
    spec["precision"] = {key: value for key, value in spec["precision"].items() if key not in ROLES}
    return spec, run.rule, run.builder, repr(run.reduction)
