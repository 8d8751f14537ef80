"""Horizons read off one reverse pass, against runs that start where the horizon says."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from small_systems import LENNARD_JONES, crystal, make

from mdnum.gradients import Problem
from mdnum.gradients.diagnose.growth import growth, growth_rate
from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.parameters import with_values
from mdnum.gradients.problem import Gradient
from mdnum.gradients.recorded import Symmetric
from mdnum.rollout.engine import Engine, Start
from mdnum.systems import build

STEPS = 120


@pytest.fixture(scope="module")
def problem():
    simulation = build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}))
    way = np.random.default_rng(5).standard_normal((3, simulation.atoms))
    return Problem(simulation, FinalProjection(direction=jnp.asarray(way)), STEPS)


@pytest.fixture(scope="module")
def grown(problem):
    return growth(problem, ("sigma", "temperature", "v0"), saltation=False)


@pytest.mark.slow
def test_each_row_is_the_gradient_of_a_run_that_starts_there(problem, grown):
    simulation, horizon = problem.simulation, 50
    step = STEPS - horizon
    *_, segment = Engine(simulation, step - 1).segments()
    state = segment.state
    assert int(state.step) == step
    start = Start(state, np.asarray(state.x, np.float64).T.copy(), built=step)

    def loss(sigma: float) -> float:
        *_, end = Engine(with_values(simulation, {"potential.sigma": sigma}), STEPS, start=start).segments()
        row = end.rows - 1
        whole = end.unsorted("x", row) + end.unsorted("images", row) @ np.asarray(simulation.cell.matrix)
        return float(np.sum(whole.T * problem.loss.direction) / simulation.atoms)

    h = 1e-6
    slope = (loss(1 + h) - loss(1 - h)) / (2 * h)
    assert grown.table["gradient.potential.sigma"][horizon] == pytest.approx(slope, rel=1e-6)


@pytest.mark.slow
def test_the_last_row_is_the_gradient_of_the_run(problem, grown):
    whole: Gradient = Symmetric()(problem, ("sigma", "temperature", "v0"))
    for name in ("potential.sigma", "dynamics.temperature"):
        assert grown.table[f"gradient.{name}"][-1] == pytest.approx(float(whole.gradient[name]), rel=1e-12)
    norm = np.linalg.norm(whole.gradient["initial.velocities"])
    assert grown.table["onto_velocities"][-1] == pytest.approx(norm, rel=1e-12)
    assert grown.table["step"][-1] == 0 and {len(column) for column in grown.table.values()} == {STEPS + 1}


def test_a_rate_is_told_where_growth_is_exponential_alone():
    h = np.arange(400)
    noise = np.exp(0.1 * np.random.default_rng(0).standard_normal(400))
    rate, error, grows = growth_rate(np.exp(0.02 * h) * noise)
    assert grows and abs(rate - 0.02) < 4 * error < 0.01
    assert not growth_rate((1 + h) * noise)[2]
    assert np.isnan(growth_rate(np.exp(h[:50]))[0])
    broken = np.exp(0.02 * h)
    broken[300:] = np.inf
    assert np.isnan(growth_rate(broken)[0])


@pytest.mark.slow
def test_a_horizon_without_an_effect_is_said_to_have_none(problem):
    still = replace(problem, loss=FinalProjection(direction=jnp.zeros(3)))
    found = growth(still, ("sigma",), saltation=False)
    assert not found.size.any() and found.gain == 1.0
