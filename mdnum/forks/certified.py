"""Certify the decisions of a run, and that another run makes the same decisions.

Up to the *certified horizon*, every decision margin of a run exceeded its rounding bound. Exact arithmetic
would give the same decisions for the same states. Up to the end of *protection*, |distance - cutoff| of every
pair exceeded the possible difference between its distances in the two runs. Up to the earlier of both steps,
the decisions of the runs agree. Up to the *shadow horizon*, decisions agree if one program is at least as
precise as the other in every role.

Decisions are certified only for the actual states of the run. A run with correct decisions may have left the
exact trajectory earlier (`forks.exact.certify` finds the step).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.forks.pair import Fork
from mdnum.forks.worlds import ROLES
from mdnum.md.cell import Cell
from mdnum.md.decide import PairDecider
from mdnum.numerics.rounding import unit_roundoff
from mdnum.program import Twin
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import PairRecorder
from mdnum.systems.describe import program
from mdnum.systems.simulation import Simulation

#: Largest number of ambiguous decisions that are listed; the count includes all.
LISTED = 10_000
#: Number of binary digits after the point of the square root of an exact squared distance.
_ROOT_BITS = 400


# --- a pair of runs -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Horizon:
    """Last step before a run's first ambiguous decision, and the number of such decisions."""

    # the last one before the first ambiguous decision; the last one followed where there is none, -1 where
    # the start is ambiguous
    step: int
    decisions: int  # ambiguous ones, a step's pair counted at each step
    steps: int  # at which there are any
    # whether the list is certain to hold every pair; where not, the horizon is of listed pairs
    complete: bool


@dataclass(frozen=True)
class Certified:
    """Certified horizons, end of protection and shadow horizon of a pair of runs."""

    # by run, "A" and "B"; nothing for many-body potentials, which decide inside their energy function,
    # without a rounding bound
    horizon: Mapping[str, Horizon]
    # the last step up to which every pair was further from its cutoff than twice the separation of the runs
    # and what their cutoffs differ by; -1 where it is not so at the first step. None for many-body potentials
    protected: int | None
    shadow: str | None  # the wider of the two programs, "A" or "B"; None where neither is
    shadow_step: int | None  # the last step up to which they decided alike; None without a shadow


def certified(fork: Fork) -> Certified:
    """Compute the certified horizons, the end of protection and the shadow horizon."""
    twin, last = fork.twin, fork.steps
    if twin.a.imposable or twin.b.imposable:
        return Certified({}, None, None, None)
    runs = {"A": twin.a.simulation, "B": twin.b.simulation}
    horizon = {name: _horizon(run, fork.series[f"ambiguous {name}"]) for name, run in runs.items()}
    away, needed = protection(fork)
    bare = np.flatnonzero(~(away > needed))
    shadow = wider(twin)
    agreed = last if fork.dates.fork is None else fork.dates.fork - 1
    protected = int(bare[0]) - 1 if len(bare) else last
    return Certified(horizon, protected, shadow, None if shadow is None else agreed)


def _horizon(run: Simulation, ambiguous: Float[np.ndarray, "steps"]) -> Horizon:
    at = np.flatnonzero(ambiguous > 0)
    seen = np.flatnonzero(np.isfinite(ambiguous))
    last = int(seen[-1]) if len(seen) else -1
    return Horizon(int(at[0]) - 1 if len(at) else last, int(np.nansum(ambiguous)), len(at), run.rule.safe)


def protection(fork: Fork) -> tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]:
    """Return the smallest |pair distance - cutoff| of each step, and the bound above which decisions agree.

    If positions differ by at most d between the runs, a pair distance differs by at most 2 d. Pair distances
    are taken from the run with the smaller rounding error. The rounding error of the distances is added to
    the bound.
    """
    deciders = {"A": fork.twin.a.simulation.decider, "B": fork.twin.b.simulation.decider}
    a, b = deciders.values()
    cutoffs = float(np.max(np.abs(_cutoffs(a) - _cutoffs(b)))) if len(a.r_cut) == len(b.r_cut) else np.inf
    finer = min(deciders, key=lambda name: np.nanmax(fork.series[f"bound {name}"]))
    rest = cutoffs + fork.series[f"bound {finer}"]
    return fork.series[f"nearest {finer}"], 2.0 * fork.series["B"] + rest


def _cutoffs(decider: PairDecider) -> Float[np.ndarray, "types"]:
    """Return the decision thresholds as distances, in the dtype of the program."""
    values = np.array([threshold.value for threshold in decider.thresholds])
    return np.sqrt(values) if decider.space == "r2" else values


def wider(twin: Twin) -> str | None:
    """Return the program that is more precise in some role and less precise in none, or None.

    The programs may differ only in precision. A different time step has effects beyond rounding.
    """
    a, b = twin.a.simulation, twin.b.simulation
    if twin.a.begin is not None or twin.b.begin is not None or _but_for_roles(a) != _but_for_roles(b):
        return None
    if not (np.array_equal(a.positions, b.positions) and np.array_equal(a.velocities, b.velocities)):
        return None
    # a smaller roundoff is a wider float
    dtypes = ([run.policy.dtype(role) for role in ROLES["md"]] for run in (a, b))
    first, second = (np.array([unit_roundoff(dtype) for dtype in each]) for each in dtypes)
    if (first == second).all():
        return None
    return "A" if (first <= second).all() else "B" if (second <= first).all() else None


def _but_for_roles(run: Simulation) -> tuple[Any, ...]:
    """Return all properties of a program except the precision of each role."""
    tables = program(run)
    tables["precision"] = {key: value for key, value in tables["precision"].items() if key not in ROLES["md"]}
    return tables, repr(run.reduction)


# --- one run, its ambiguous decisions in exact arithmetic ------------------------------------------------


@dataclass(frozen=True)
class AmbiguousDecision:
    """A decision with a margin that is smaller than its rounding bound."""

    # step, i, j: which decision; i < j
    step: int
    i: int
    j: int
    inside: bool  # as the program decided
    margin: float  # threshold - quantity as it computed it, in the quantity's space
    bound: float  # on the rounding error of that margin
    exact: float  # the margin of the same state without any rounding
    wrong: bool  # whether the exact margin asks for the other decision


@dataclass(frozen=True)
class CertifiedHorizon:
    """The steps at which all decisions of a run are certain for its own states."""

    # first step with an ambiguous decision; every decision before it would have come out the same in exact
    # arithmetic from the same states. None where there is none
    horizon: int | None
    # first step with a decision that exact arithmetic decides otherwise; None where there is none
    wrong: int | None
    total: int  # ambiguous decisions
    decisions: tuple[AmbiguousDecision, ...]  # the first of them


def certified_horizon(simulation: Simulation, steps: int) -> CertifiedHorizon:
    """Compare every margin of a run with its rounding bound. Repeat ambiguous decisions in exact arithmetic.

    Raises:
        InputError: the rule for rebuilding neighbor lists may miss pairs.
    """
    if not simulation.rule.safe:
        raise InputError(
            "the neighbor list is not checked at every step, so it may lack pairs that are inside the cutoff",
            remedy="Set neighbors.rebuild.every = 1 and neighbors.rebuild.check = true",
            where="neighbors.rebuild",
        )
    decider, recorder = simulation.decider, PairRecorder(simulation)
    found: list[AmbiguousDecision] = []
    for segment in Engine(simulation, steps).segments():
        for step, i, j, margin, bound in zip(*vars(recorder.doubtful(segment)).values(), strict=True):
            x = segment.unsorted("x", int(step) - segment.first)
            kind = int(simulation.type_of(np.array([i]), np.array([j]))[0])
            cell = segment.cell_of(int(step) - segment.first)
            exact, inside = exact_margin(decider, cell, x[i], x[j], kind)
            decided = bool(decider.inside(-margin, 0.0))
            where = int(step), int(i), int(j), decided
            found.append(
                AmbiguousDecision(*where, float(margin), float(bound), float(exact), decided != inside)
            )
    wrong = next((one.step for one in found if one.wrong), None)
    return CertifiedHorizon(found[0].step if found else None, wrong, len(found), tuple(found[:LISTED]))


def exact_margin(
    decider: PairDecider,
    cell: Cell,
    start: Float[np.ndarray, "3"],
    end: Float[np.ndarray, "3"],
    kind: int = 0,
) -> tuple[Fraction, bool]:
    """Compute the margin of a pair without rounding errors, and its decision.

    The positions are the floating-point numbers of the state, taken as exact. The threshold and the lattice
    vectors are in double precision, even if the run uses another dtype. The margin, as a distance, is
    accurate to 400 bits. The decision is exact.

    Args:
        start, end: positions of the two atoms, length.
        kind: pair type.
    """
    matrix = np.asarray(cell.matrix, np.float64)
    inverse = [[Fraction(float(c)) for c in row] for row in np.asarray(cell.inverse)]
    d = [Fraction(float(b)) - Fraction(float(a)) for a, b in zip(start, end, strict=True)]
    n = [round(sum((d[c] * inverse[c][k] for c in range(3)), start=Fraction(0))) for k in range(3)]
    for k in range(3):
        if cell.pbc[k]:
            d = [d[c] - n[k] * Fraction(float(matrix[k, c])) for c in range(3)]
    squared = sum((c * c for c in d), start=Fraction(0))
    value = Fraction(decider.exact_thresholds[kind])
    against = value * value if decider.space == "r" else value
    inside = squared <= against if decider.compare.endswith("<=") else squared < against
    quantity = _root(squared) if decider.space == "r" else squared
    return value - quantity, inside


def _root(x: Fraction) -> Fraction:
    scaled = (x.numerator << (2 * _ROOT_BITS)) // x.denominator
    return Fraction(math.isqrt(scaled), 1 << _ROOT_BITS)
