"""Derivatives of rollouts against finite differences of the same program, and against themselves."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum import ball

HEIGHTS = np.linspace(0.9, 1.1, 5)
CASES = {
    "penalty": (
        ball.Penalty(1e3, damping=0.3),
        ball.SemiImplicitEuler(2e-3),
        ("k", "damping", "gravity", "h"),
    ),
    "verlet": (ball.Penalty(1e3), ball.BallVerlet(2e-3), ("k", "gravity", "h")),
    "smooth": (ball.Penalty(1e3, eps=0.01, smooth=True), ball.BallVerlet(2e-3), ("k", "eps")),
    "midpoint": (ball.Penalty(1e3, damping=0.3), ball.ImplicitMidpoint(2e-3), ("k", "damping", "h")),
    "smooth midpoint": (
        ball.Penalty(1e3, eps=0.01, smooth=True),
        ball.ImplicitMidpoint(2e-3, ball.Maximum(1e-14, 50)),
        ("k", "eps"),
    ),
    "located": (ball.Impact(0.8), ball.EventLocated(0.02), ("restitution", "gravity", "h")),
    "naive": (ball.Impact(0.8), ball.SemiImplicitEuler(2e-3), ("restitution", "gravity")),
}  # fmt: skip


def difference(problem, name, step):
    value = np.asarray(problem.values([name])[name], np.float64)
    up, down = (problem.value({name: value + sign * step}) for sign in (1, -1))
    return (up - down) / (2 * step)


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=[pytest.mark.nightly] * (x in ("verlet", "smooth midpoint"))) for x in CASES],
)
def test_gradients_match_finite_differences_between_events(name):
    contact, integrator, names = CASES[name]
    world = ball.World.create(contact, integrator)
    steps = 400 if not isinstance(integrator, ball.EventLocated) else 60
    problem = ball.BallProblem(world, HEIGHTS, 0.0, steps, ball.MeanHeight())
    value, slopes = problem.value_and_grad([*names, "y0", "v0"])
    assert value == problem.value()
    for parameter, slope in slopes.items():
        scale = max(1e-3, abs(float(world.value(parameter)))) if parameter in names else 1.0
        seen = difference(problem, parameter, 1e-7 * scale)
        assert slope == pytest.approx(seen, rel=2e-4, abs=1e-7), parameter


def projected(rule):
    world = ball.World.create(ball.Projection(0.5, 0.5, rule), ball.SemiImplicitEuler(2e-3))
    return ball.BallProblem(world, HEIGHTS, 0.0, 700, ball.ResidualPenetration(1))


@pytest.mark.parametrize(
    "rule",
    [
        ball.GlobalSum(1e-4),
        ball.PerInstance(1e-4),
        pytest.param(ball.FixedCount(12), marks=pytest.mark.nightly),
    ],
)
def test_projection_gradients_go_through_the_iterations_that_ran(rule):
    problem = projected(rule)
    _, slopes = problem.value_and_grad(["k", "alpha", "gravity"])
    assert slopes["k"] < 0
    for parameter, slope in slopes.items():
        assert slope == pytest.approx(difference(problem, parameter, 1e-8), rel=1e-4)


def test_the_unrolled_derivative_is_an_artifact_of_the_tolerance():
    for tol, slope in ((1e-2, -7.5e-2), (1e-4, -1.6e-3), (1e-6, -2.5e-5)):
        world = ball.World.create(
            ball.Projection(0.5, 0.5, ball.GlobalSum(tol)), ball.SemiImplicitEuler(0.1), gravity=0.0
        )
        problem = ball.BallProblem(world, -0.45, 0.0, 1, ball.ResidualPenetration(1))
        value, slopes = problem.value_and_grad(["k"])
        n = int(problem.run().iterations[0])
        # n iterations leave p0 (1 - alpha k)^n
        assert value == pytest.approx(0.45 * 0.75**n, rel=1e-13)
        assert slopes["k"] == pytest.approx(-0.45 * n * 0.5 * 0.75 ** (n - 1), rel=1e-12)
        assert slopes["k"] == pytest.approx(slope, rel=0.02)


@eqx.filter_jit
def both_modes(at, world):
    """Gradients of the final height by reverse mode, and by forward mode."""

    def loss(at):
        return ball.loss_of(world.with_values(at), jnp.asarray(HEIGHTS), 0.0, 120, ball.FinalHeight())

    return jax.grad(loss)(at), jax.jacfwd(loss)(at)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(x, marks=[pytest.mark.nightly] * (x not in ("penalty", "smooth midpoint", "located")))
        for x in CASES
    ],
)
def test_forward_and_reverse_mode_agree(name):
    contact, integrator, names = CASES[name]
    world = ball.World.create(contact, integrator)
    reverse, forward = both_modes({name: world.value(name) for name in names}, world)
    for name in names:
        assert float(forward[name]) == pytest.approx(float(reverse[name]), rel=1e-10, abs=1e-14)


def test_imposed_decisions_pin_the_program():
    problem, names = projected(ball.GlobalSum(1e-4)), ["k", "alpha", "gravity"]
    own = jax.tree.map(jnp.asarray, problem.run().decisions())
    assert problem.value_and_grad(names) == problem.value_and_grad(names, own)
