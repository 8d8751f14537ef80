"""From a ball's system file to objects: a world, a start, a loss, and the same for every variant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.ball import limits, step, stopping
from mdnum.ball.problem import BallLoss, BallProblem, FinalHeight, MeanHeight, ResidualPenetration
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.numerics import neighbor, reductions
from mdnum.numerics.roles import RolePrecision
from mdnum.systems import ball, ball_checks
from mdnum.systems.ball_system import BallSystem
from mdnum.systems.load import load

_INTEGRATORS: Mapping[str, Any] = {
    "explicit-euler": step.ExplicitEuler,
    "semi-implicit-euler": step.SemiImplicitEuler,
    "velocity-verlet": step.BallVerlet,
    "event-located": step.EventLocated,
}
_RULES: Mapping[str, Any] = {
    "sum": stopping.GlobalSum,
    "relative": stopping.Relative,
    "per-instance": stopping.PerInstance,
    "maximum": stopping.Maximum,
}


@dataclass(frozen=True)
class BallVariant:
    """The problem with some keys of its file changed.

    Attributes:
        name: what the file calls it.
        changes: dotted keys to values.
        problem: what comes of them.
    """

    name: str
    changes: Mapping[str, Any]
    problem: BallProblem


@dataclass(frozen=True)
class BallSimulation:
    """A ball's system as objects.

    Attributes:
        system: what the file says.
        problem: world, start, steps and loss.
        variants: the same with some keys changed.
    """

    system: BallSystem
    problem: BallProblem
    variants: tuple[BallVariant, ...]


def build_ball(
    system: BallSystem | str | Path,
    overrides: Mapping[str, Any] | None = None,
    steps: int | None = None,
) -> BallSimulation:
    """The objects of a ball's system.

    Args:
        system: a loaded system, or a name or path to load.
        overrides: as for `load`, where a name or path is given.
        steps: instead of the file's.

    Raises:
        InputError: the file cannot be run.
    """
    if not isinstance(system, BallSystem):
        system = load(system, overrides, world="ball")
    variants = tuple(
        BallVariant(variant.name, variant.changes, problem(variant.spec, steps, f"variant {variant.name!r}"))
        for variant in system.variants
    )
    return BallSimulation(system, problem(system.spec, steps, system.name), variants)


def problem(spec: ball.BallSpec, steps: int | None = None, where: str = "system") -> BallProblem:
    """World, start, steps and loss of the tables of a file.

    Args:
        spec: checked tables.
        steps: instead of the file's.
        where: what to blame.

    Raises:
        InputError: a number that the world refuses.
    """
    steps = spec.integrator.steps if steps is None else steps
    precision = spec.precision
    policy = RolePrecision(
        precision.state,
        precision.arithmetic,
        precision.decision,
        precision.accumulate,
        precision.loss,
        precision.rounding,
        precision.seed,
    )
    try:
        world = World.create(
            _contact(spec),
            _integrator(spec),
            gravity=spec.flight.gravity,
            control=control(spec.flight.control, spec.integrator.timestep, steps),
            policy=policy,
            hysteresis=spec.contact.hysteresis,
        )
    except InputError as error:
        raise InputError(error.message, remedy=error.remedy, where=error.where or where) from None
    y0, v0 = start(spec)
    return BallProblem(world, y0, v0, steps, _loss(spec.loss))


def start(spec: ball.BallSpec) -> tuple[Float[np.ndarray, "balls"], Float[np.ndarray, "balls"]]:
    """Heights (m) and velocities (m/s) of the balls at step 0, float64; numbers of the state's dtype come
    out of the rounding that a world does.
    """
    given, count = spec.start, ball_checks.balls(spec)
    if given.boundary is not None:
        return _on_the_boundary(spec, given.boundary), np.zeros(count)
    height = np.asarray(given.height, np.float64)
    if given.spread_ulps:
        dtype = limits.DTYPES[spec.precision.state]
        height = np.array([float(neighbor(height, n * given.spread_ulps, dtype)) for n in range(count)])
    elif given.spread:
        height = np.linspace(float(height) - given.spread, float(height) + given.spread, count)
    velocity = np.asarray(given.velocity, np.float64)
    return np.broadcast_to(height, count).copy(), np.broadcast_to(velocity, count).copy()


def _on_the_boundary(spec: ball.BallSpec, boundary: ball.BoundaryTable) -> Float[np.ndarray, "balls"]:
    """One penetration an ulp short of the tolerance, and the ulp in equal parts."""
    assert spec.stop is not None and not isinstance(spec.stop, ball.FixedRule)
    tol = spec.stop.tol
    below = float(np.nextafter(np.asarray(tol, limits.DTYPES[boundary.format]), 0))
    share = (tol - below) / boundary.terms
    return -np.array([below, *[share] * boundary.terms])


def control(table: ball.Control, h: float, steps: int) -> Float[np.ndarray, "steps"] | None:
    """The acceleration that is added in each step, m/s²; None for none.

    Args:
        table: of the file.
        h: time step, s.
        steps: how many; a longer run than the file's keeps the last value.
    """
    match table:
        case ball.ConstantControl():
            return np.full(steps, table.value)
        case ball.SineControl():
            time = np.arange(steps) * h
            return table.amplitude * np.sin(2 * np.pi * time / table.period + table.phase)
        case ball.ValuesControl():
            return np.asarray(table.values, np.float64)[:steps]
        case _:
            return None


def _contact(spec: ball.BallSpec) -> Any:
    match table := spec.contact:
        case ball.PenaltyContact():
            return step.Penalty(table.k, table.damping, table.eps, smooth=table.eps > 0)
        case ball.ProjectionContact():
            return step.Projection(table.k, table.alpha, stop_rule(spec), table.restitution)
        case ball.ImpactContact():
            return step.Impact(table.restitution, table.rest_speed)


def _integrator(spec: ball.BallSpec) -> Any:
    table = spec.integrator
    if table.kind != "implicit-midpoint":
        return _INTEGRATORS[table.kind](table.timestep)
    if isinstance(spec.contact, ball.PenaltyContact):
        return step.ImplicitMidpoint(table.timestep, stop_rule(spec))
    # without a contact force a step is a formula, and nothing is solved
    return step.ImplicitMidpoint(table.timestep)


def stop_rule(spec: ball.BallSpec) -> Any:
    """The stopping rule of the file as an object."""
    table = spec.stop
    assert table is not None
    if isinstance(table, ball.FixedRule):
        return stopping.FixedCount(table.count)
    options = {}
    if table.rule in ("sum", "relative"):
        options["reduction"] = reductions.parse(spec.precision.reduction)
    rule = _RULES[table.rule](table.tol, table.max_iter, **options)
    return rule if table.enter is None else stopping.HysteresisStop(rule, table.enter)


def _loss(table: ball.LossTable) -> BallLoss:
    if table.kind == "mean-height":
        return MeanHeight()
    if table.kind == "residual-penetration":
        return ResidualPenetration()
    return FinalHeight(table.target)
