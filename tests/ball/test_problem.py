"""Derivatives of rollouts against finite differences of the same program."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum import ball

HEIGHTS = np.linspace(0.9, 1.1, 5)
EULER, VERLET = ball.SemiImplicitEuler(2e-3), ball.BallVerlet(2e-3)
SMOOTH, DAMPED = ball.Penalty(1e3, eps=0.01, smooth=True), ball.Penalty(1e3, damping=0.3)
START, PROJECTED = ("y0", "v0"), ("k", "alpha", "gravity")


def projection(rule):
    return ball.Projection(0.5, 0.5, rule)


CASES = {
    "penalty": (DAMPED, EULER, ("k", "damping", "gravity", "h", *START)),
    "verlet": (ball.Penalty(1e3), VERLET, ("k", "gravity", "h", *START)),
    "smooth": (SMOOTH, VERLET, ("k", "eps", *START)),
    "midpoint": (DAMPED, ball.ImplicitMidpoint(2e-3), ("k", "damping", "h", *START)),
    "smooth midpoint": (
        SMOOTH, ball.ImplicitMidpoint(2e-3, ball.Maximum(1e-14, 50)), ("k", "eps", *START)
    ),
    "located": (ball.Impact(0.8), ball.EventLocated(0.02), ("restitution", "gravity", "h", *START)),
    "naive": (ball.Impact(0.8), EULER, ("restitution", "gravity", *START)),
    "global sum": (projection(ball.GlobalSum(1e-4)), EULER, PROJECTED),
    "per instance": (projection(ball.PerInstance(1e-4)), EULER, PROJECTED),
    "fixed": (projection(ball.FixedCount(12)), EULER, PROJECTED),
}  # fmt: skip
NIGHTLY = ("verlet", "smooth midpoint", "fixed")


def problem_of(name: str) -> ball.BallProblem:
    contact, integrator, _ = CASES[name]
    steps, loss = 60 if name == "located" else 400, ball.MeanHeight()
    if isinstance(contact, ball.Projection):
        steps, loss = 700, ball.ResidualPenetration(1)
    return ball.BallProblem(ball.World.create(contact, integrator), HEIGHTS, 0.0, steps, loss)


@pytest.mark.parametrize(
    "case", [pytest.param(x, marks=[pytest.mark.nightly] * (x in NIGHTLY)) for x in CASES]
)
def test_gradients_match_finite_differences_between_events(case):
    problem, names = problem_of(case), CASES[case][2]
    value, slopes = problem.value_and_grad(names)
    assert value == problem.value()
    for name, slope in slopes.items():
        here = np.asarray(problem.values([name])[name], np.float64)
        scale = 0.1 if names == PROJECTED else 1.0 if name in START else max(1e-3, abs(float(here)))
        step = 1e-7 * scale
        up, down = (problem.value({name: here + shift}) for shift in (step, -step))
        assert slope == pytest.approx((up - down) / (2 * step), rel=2e-4, abs=1e-7), name
    # more gain leaves less penetration
    assert names != PROJECTED or slopes["k"] < 0


def test_imposed_decisions_pin_the_program():
    problem = problem_of("global sum")
    own = jax.tree.map(jnp.asarray, problem.run().decisions())
    assert problem.value_and_grad(PROJECTED) == problem.value_and_grad(PROJECTED, own)
