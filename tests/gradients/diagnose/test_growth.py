"""Horizons against runs that start there, counts of what a narrow type loses against casts to it, singular
values against those of a matrix of differences."""

from __future__ import annotations

import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from ase import Atoms
from small_systems import LENNARD_JONES, make

from mdnum.errors import InputError
from mdnum.gradients import Problem
from mdnum.gradients.diagnose.growth import (
    CLOCK_STEPS,
    Jacobian,
    Scaling,
    ScalingWatch,
    growth,
    growth_rate,
    spectrum,
)
from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.parameters import with_values
from mdnum.gradients.recorded import Symmetric
from mdnum.gradients.tape import RunTape
from mdnum.rollout.engine import Engine, Start
from mdnum.systems import build

STEPS = 120


@pytest.fixture(scope="module")
def problem(smooth):
    way = np.random.default_rng(5).standard_normal((3, smooth.atoms))
    return Problem(smooth, FinalProjection(direction=jnp.asarray(way)), STEPS)


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
    start = Start(state, state.x, built=step)

    def loss(sigma: float) -> float:
        *_, end = Engine(with_values(simulation, {"potential.sigma": sigma}), STEPS, start=start).segments()
        row = end.rows - 1
        whole = end.unsorted("x", row) + end.unsorted("images", row) @ np.asarray(simulation.cell.matrix)
        return float(np.sum(whole.T * problem.loss.direction) / simulation.atoms)

    h = 1e-6
    slope = (loss(1 + h) - loss(1 - h)) / (2 * h)
    assert grown.table["gradient.potential.sigma"][horizon] == pytest.approx(slope, rel=1e-6)
    # the last row is the gradient of the run
    whole = Symmetric()(problem, ("sigma", "temperature", "v0")).gradient
    for name in ("potential.sigma", "dynamics.temperature"):
        assert grown.table[f"gradient.{name}"][-1] == pytest.approx(float(whole[name]), rel=1e-12)
    norm = np.linalg.norm(whole["initial.velocities"])
    assert grown.table["onto_velocities"][-1] == pytest.approx(norm, rel=1e-12)
    assert grown.table["step"][-1] == 0 and {len(column) for column in grown.table.values()} == {STEPS + 1}


def test_a_rate_is_told_where_growth_is_exponential_alone():
    h = np.arange(400.0)
    noise = 0.1 * np.random.default_rng(0).standard_normal(400)
    rate, error, grows = growth_rate(0.02 * h + noise)
    assert grows and abs(rate - 0.02) < 4 * error < 0.01
    assert not growth_rate(np.log(1 + h) + noise)[2]
    assert np.isnan(growth_rate(h[:50])[0])
    broken = 0.02 * h
    broken[300:] = np.inf
    assert np.isnan(growth_rate(broken)[0])


# --- a narrow type -----------------------------------------------------------------------------------

TYPES = {"float16": np.float16, "bfloat16": ml_dtypes.bfloat16, "float32": np.float32}


def watched(values: np.ndarray, format: str) -> Scaling:
    watch = ScalingWatch(len(values) - 1, format)
    for step, row in enumerate(values):
        watch.put(step, row)
    return watch.result()


def cast(values: np.ndarray, format: str) -> tuple[np.ndarray, np.ndarray]:
    """Overflows and losses by horizon."""
    with np.errstate(over="ignore"):
        narrow = values.astype(TYPES[format]).astype(np.float64)
    lost = (narrow == 0) & (values != 0)
    return (~np.isfinite(narrow)).sum(axis=1)[::-1], lost.sum(axis=1)[::-1]


@pytest.mark.parametrize(
    ("format", "low", "high"),
    [("float16", -40, 20), ("bfloat16", -150, 130), ("float32", -155, 131), ("float16", -35, -25)],
)
def test_counts_are_those_of_a_cast_with_and_without_the_scale(format, low, high):
    # sizes that fall by a constant factor from step to step, and scatter by powers of two
    values = 2.0 ** np.linspace(high, low, 21)[:, None] * np.random.default_rng(3).standard_normal((21, 600))
    values[:, ::50] = 0.0
    found = watched(values, format)
    for scale, word in ((0, ""), (found.power, "scaled_")):
        overflow, lost = cast(values * 2.0**scale, format)
        assert np.array_equal(found.table[f"{word}overflow"], overflow)
        assert np.array_equal(found.table[f"{word}underflow"], lost)
    assert not overflow.any() and found.table["underflow"].any()
    # one doubling more, and something overflows
    assert cast(values * 2.0 ** (found.power + 1), format)[0].any()
    # what is small everywhere fits with a scale
    assert found.fits == (low == -35) and (found.scale >= 2.0**35) == found.fits
    assert {len(column) for column in found.table.values()} == {21}


def test_nothing_and_what_is_not_finite_have_no_scale():
    nothing = watched(np.zeros((3, 4)), "float16")
    assert np.isnan(nothing.scale) and not nothing.usable
    broken = np.ones((3, 4))
    broken[1, 2] = np.nan
    found = watched(broken, "float16")
    assert np.isnan(found.scale) and not found.fits and found.table["overflow"].tolist() == [0, 1, 0]
    with pytest.raises(InputError):
        ScalingWatch(3, "float17")


# --- singular values ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def colliding():
    """Four atoms that collide."""
    places = [[2, 2, 2], [3.2, 2.1, 2], [2, 3.2, 2.1], [3.1, 3.1, 2.9]]
    atoms = Atoms("Ar4", positions=places, cell=[6, 6, 6], pbc=True)
    atoms.set_array("masses", np.ones(4))
    simulation = build(make(atoms, LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}))
    return Problem(simulation, FinalProjection(), 60)


def matrix(problem: Problem, clock: float) -> np.ndarray:
    """The Jacobian: where 24 unit vectors go."""
    image = Jacobian(RunTape(problem.simulation, problem.loss, problem.steps), clock).image(np.eye(24))
    return image.basis @ image.mixing * np.exp(image.log_scale)


@pytest.mark.slow
def test_the_jacobian_is_that_of_differences_and_symplectic(colliding):
    simulation = colliding.simulation

    def end(flat: np.ndarray) -> np.ndarray:
        x, v = flat.reshape(2, 3, -1)
        moved = with_values(simulation, {"initial.positions": x.T, "initial.velocities": v.T})
        *_, segment = Engine(moved, colliding.steps - 1).segments()
        state = segment.state
        whole = np.asarray(state.x) + np.asarray(simulation.cell.matrix).T @ np.asarray(state.images)
        return np.concatenate([whole.ravel(), np.asarray(state.v).ravel()])

    start = np.concatenate([simulation.positions.T.ravel(), simulation.velocities.T.ravel()])
    jacobian = matrix(colliding, 1.0)
    for way in 1e-6 * np.random.default_rng(2).standard_normal((3, 24)):
        moved = (end(start + way) - end(start - way)) / 2
        np.testing.assert_allclose(jacobian @ way, moved, atol=1e-7 * np.abs(moved).max())
    # with unit masses every step is symplectic in (x, v): singular values of the map are s and 1/s
    sizes = np.linalg.svd(jacobian, compute_uv=False)
    np.testing.assert_allclose(sizes * sizes[::-1], 1.0, rtol=1e-8)


@pytest.mark.slow
def test_singular_values_are_those_of_the_matrix(colliding):
    clock = CLOCK_STEPS * float(colliding.simulation.integrator.timestep)
    dense = np.linalg.svd(matrix(colliding, clock), compute_uv=False)
    # as many vectors as coordinates: nothing is left to convergence
    found = spectrum(colliding, values=4, extra=20, rounds=1)
    assert dense[0] > 3
    np.testing.assert_allclose(np.exp(found.log_singular), dense[:4], rtol=1e-6)
    assert np.all(found.residual < 1e-9) and found.transposed < 1e-12
    np.testing.assert_allclose(found.exponents * colliding.steps, found.log_singular)
    # a few vectors find the largest within their residual
    found = spectrum(colliding, values=1, extra=3, rounds=4)
    assert abs(np.exp(found.log_singular[0]) / dense[0] - 1) < found.residual[0] < 0.1
    with pytest.raises(InputError, match="singular values"):
        spectrum(colliding, values=25)
