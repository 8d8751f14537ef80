"""Conversion of a bouncing ball's system file to model, initial state and loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.ball import limits, step, stopping
from mdnum.ball.problem import BallProblem, FinalHeight, MeanHeight, ResidualPenetration
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.numerics import check_not_forked, neighbor, reductions
from mdnum.numerics.roles import RolePrecision
from mdnum.systems import ball
from mdnum.systems.load import BallSystem, load

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
    """A bouncing-ball problem with changed keys of the system file."""

    name: str  # what the file calls it
    changes: Mapping[str, Any]  # dotted keys to values
    problem: BallProblem  # what comes of them


@dataclass(frozen=True)
class BallSimulation:
    """The objects of a bouncing-ball system: the problem and its variants."""

    system: BallSystem  # what the file says
    problem: BallProblem  # world, start, steps and loss
    variants: tuple[BallVariant, ...]  # the same with some keys changed


def build_ball(
    system: BallSystem | str | Path,
    overrides: Mapping[str, Any] | None = None,
    steps: int | None = None,
) -> BallSimulation:
    """Build the objects of a bouncing-ball system.

    Args:
        system: a loaded system, or a name or path to load.
        overrides: overrides as for `load`, if a name or path is given.
        steps: number of steps; default the number in the file.

    Raises:
        InputError: the file cannot be run.
    """
    check_not_forked()
    if not isinstance(system, BallSystem):
        system = load(system, overrides, world="ball")
    variants = tuple(
        BallVariant(name, system.spec.variants[name], problem(spec, steps, f"variant {name!r}"))
        for name, spec in system.variants.items()
    )
    return BallSimulation(system, problem(system.spec, steps, system.name), variants)


def problem(spec: ball.BallSpec, steps: int | None = None, where: str = "system") -> BallProblem:
    """Create the model, the initial state, the number of steps and the loss of a system file.

    Raises:
        InputError: a number is outside the range that the model allows.
    """
    steps = spec.integrator.steps if steps is None else steps
    try:
        world = World.create(
            _contact(spec),
            _integrator(spec),
            gravity=spec.flight.gravity,
            control=_control(spec.flight.control, spec.integrator.timestep, steps),
            policy=RolePrecision(**spec.precision.model_dump(exclude={"reduction"})),
            hysteresis=spec.contact.hysteresis,
        )
    except InputError as error:
        raise InputError(error.message, remedy=error.remedy, where=error.where or where) from None
    y0, v0 = start(spec)
    losses = {"mean-height": MeanHeight(), "residual-penetration": ResidualPenetration()}
    loss = losses.get(spec.loss.kind) or FinalHeight(spec.loss.target)
    return BallProblem(world, y0, v0, steps, loss)


def start(spec: ball.BallSpec) -> tuple[Float[np.ndarray, "balls"], Float[np.ndarray, "balls"]]:
    """Return heights (m) and velocities (m/s) at step 0, in float64."""
    given, count = spec.start, spec.balls
    if given.boundary is not None:
        # one penetration an ulp short of the tolerance, and the ulp in equal parts
        assert spec.stop is not None and not isinstance(spec.stop, ball.FixedRule)
        tol, terms = spec.stop.tol, given.boundary.terms
        below = float(np.nextafter(np.asarray(tol, limits.DTYPES[given.boundary.format]), 0))
        return -np.array([below, *[(tol - below) / terms] * terms]), np.zeros(count)
    height = np.asarray(given.height, np.float64)
    if given.spread_ulps:
        dtype = limits.DTYPES[spec.precision.state]
        height = np.array([float(neighbor(height, n * given.spread_ulps, dtype)) for n in range(count)])
    elif given.spread:
        height = np.linspace(float(height) - given.spread, float(height) + given.spread, count)
    velocity = np.asarray(given.velocity, np.float64)
    return np.broadcast_to(height, count).copy(), np.broadcast_to(velocity, count).copy()


def _control(table: ball.Control, h: float, steps: int) -> Float[np.ndarray, "steps"] | None:
    """Return the acceleration in each time step besides gravity, m/s². None if only gravity acts."""
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
            return step.Projection(table.k, table.alpha, _stop_rule(spec), table.restitution)
        case ball.ImpactContact():
            return step.Impact(table.restitution, table.rest_speed)


def _integrator(spec: ball.BallSpec) -> Any:
    table = spec.integrator
    if table.kind != "implicit-midpoint":
        return _INTEGRATORS[table.kind](table.timestep)
    if isinstance(spec.contact, ball.PenaltyContact):
        return step.ImplicitMidpoint(table.timestep, _stop_rule(spec))
    # without a contact force a step is a formula, and nothing is solved
    return step.ImplicitMidpoint(table.timestep)


def _stop_rule(spec: ball.BallSpec) -> Any:
    table = spec.stop
    assert table is not None
    if isinstance(table, ball.FixedRule):
        return stopping.FixedCount(table.count)
    summed = isinstance(table, ball.SumRule | ball.RelativeRule)
    options = {"reduction": reductions.parse(spec.precision.reduction)} if summed else {}
    rule = _RULES[table.rule](table.tol, table.max_iter, **options)
    return rule if table.enter is None else stopping.HysteresisStop(rule, table.enter)
