"""Horizons against runs that start there, counts of what a narrow type loses against casts to it, singular
values against those of a matrix of differences."""

from __future__ import annotations

from dataclasses import replace

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
    ScalingWatch,
    growth,
    growth_rate,
    spectrum,
)
from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.parameters import with_values
from mdnum.gradients.problem import Gradient
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
    h = np.arange(400.0)
    noise = 0.1 * np.random.default_rng(0).standard_normal(400)
    rate, error, grows = growth_rate(0.02 * h + noise)
    assert grows and abs(rate - 0.02) < 4 * error < 0.01
    assert not growth_rate(np.log(1 + h) + noise)[2]
    assert np.isnan(growth_rate(h[:50])[0])
    broken = 0.02 * h
    broken[300:] = np.inf
    assert np.isnan(growth_rate(broken)[0])


@pytest.mark.slow
def test_a_horizon_without_an_effect_is_said_to_have_none(problem):
    still = replace(problem, loss=FinalProjection(direction=jnp.zeros(3)))
    found = growth(still, ("sigma",), saltation=False)
    assert not found.table["size"].any() and found.gain == 1.0


# --- a narrow type -----------------------------------------------------------------------------------

TYPES = {"float16": np.float16, "bfloat16": ml_dtypes.bfloat16, "float32": np.float32}


def spans(low: float, high: float, steps: int = 20, numbers: int = 600) -> np.ndarray:
    """Cotangents whose sizes fall by a constant factor from step to step, and scatter by powers of two."""
    rng = np.random.default_rng(3)
    sizes = 2.0 ** np.linspace(high, low, steps + 1)
    values = sizes[:, None] * rng.standard_normal((steps + 1, numbers))
    values[:, ::50] = 0.0
    return values


def watched(values: np.ndarray, format: str) -> ScalingWatch:
    watch = ScalingWatch(len(values) - 1, format)
    for step, row in enumerate(values):
        watch.put(step, row)
    return watch


def cast(values: np.ndarray, format: str) -> tuple[np.ndarray, np.ndarray]:
    """Overflows and losses by horizon."""
    with np.errstate(over="ignore"):
        narrow = values.astype(TYPES[format]).astype(np.float64)
    lost = (narrow == 0) & (values != 0)
    return (~np.isfinite(narrow)).sum(axis=1)[::-1], lost.sum(axis=1)[::-1]


@pytest.mark.parametrize(
    ("format", "low", "high"), [("float16", -40, 20), ("bfloat16", -150, 130), ("float32", -155, 131)]
)
def test_counts_are_those_of_a_cast_with_and_without_the_scale(format, low, high):
    values = spans(low, high)
    found = watched(values, format).result()
    overflow, lost = cast(values, format)
    assert overflow.any() and lost.any()
    assert np.array_equal(found.table["overflow"], overflow) and np.array_equal(
        found.table["underflow"], lost
    )
    power = np.floor(np.log2(watched(values, format).format.largest / np.abs(values).max()))
    overflow, lost = cast(values * 2.0**power, format)
    assert not overflow.any() and not found.table["scaled_overflow"].any()
    assert np.array_equal(found.table["scaled_underflow"], lost)
    # one doubling more, and something overflows
    assert cast(values * 2.0 ** (power + 1), format)[0].any()
    assert not found.fits


def test_small_cotangents_fit_with_a_scale():
    found = watched(spans(-35, -25), "float16").result()
    assert found.table["underflow"].sum() > 1000 and found.table["scaled_underflow"].sum() < 30
    assert found.fits and found.scale >= 2.0**35
    assert {len(column) for column in found.table.values()} == {21}


def test_nothing_and_what_is_not_finite_have_no_scale():
    nothing = watched(np.zeros((3, 4)), "float16").result()
    assert np.isnan(nothing.scale) and not nothing.usable
    broken = np.ones((3, 4))
    broken[1, 2] = np.nan
    found = watched(broken, "float16").result()
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
    """The Jacobian by central differences of the state with which step T begins."""
    simulation = problem.simulation

    def end(flat: np.ndarray) -> np.ndarray:
        x, v = flat.reshape(2, 3, -1)
        moved = with_values(simulation, {"initial.positions": x.T, "initial.velocities": v.T / clock})
        *_, segment = Engine(moved, problem.steps - 1).segments()
        whole = np.asarray(segment.state.x) + np.asarray(simulation.cell.matrix).T @ np.asarray(
            segment.state.images
        )
        return np.concatenate([whole.ravel(), clock * np.asarray(segment.state.v).ravel()])

    start = np.concatenate([simulation.positions.T.ravel(), clock * simulation.velocities.T.ravel()])
    h, columns = 1e-6, []
    for k in range(len(start)):
        step = np.zeros_like(start)
        step[k] = h
        columns.append((end(start + step) - end(start - step)) / (2 * h))
    return np.stack(columns, axis=1)


@pytest.fixture(scope="module")
def dense(colliding):
    """Singular values of the matrix of differences."""
    clock = CLOCK_STEPS * float(colliding.simulation.integrator.timestep)
    return np.linalg.svd(matrix(colliding, clock), compute_uv=False)


@pytest.mark.slow
def test_singular_values_are_those_of_the_matrix_of_differences(colliding, dense):
    # as many vectors as coordinates: nothing is left to convergence
    found = spectrum(colliding, values=4, extra=20, rounds=1)
    assert dense[0] > 3
    np.testing.assert_allclose(np.exp(found.log_singular), dense[:4], rtol=1e-6)
    assert np.all(found.residual < 1e-9) and found.transposed < 1e-12
    np.testing.assert_allclose(found.exponents * colliding.steps, found.log_singular)


@pytest.mark.slow
def test_a_few_vectors_find_the_largest_within_their_residual(colliding, dense):
    found = spectrum(colliding, values=1, extra=3, rounds=4)
    assert abs(np.exp(found.log_singular[0]) / dense[0] - 1) < found.residual[0] < 0.1


@pytest.mark.slow
def test_energy_keeping_steps_come_in_pairs(colliding):
    """With unit masses every step is symplectic in (x, v): singular values of the map are s and 1/s."""
    tape = RunTape(colliding.simulation, colliding.loss, colliding.steps)
    identity = Jacobian(tape, 1.0).image(np.eye(24))
    sizes = np.linalg.svd(identity.basis @ identity.mixing, compute_uv=False) * np.exp(identity.log_scale)
    np.testing.assert_allclose(sizes * sizes[::-1], 1.0, rtol=1e-8)
    assert sizes[0] > 3


@pytest.mark.slow
def test_more_values_than_coordinates_are_refused(colliding):
    with pytest.raises(InputError, match="singular values"):
        spectrum(colliding, values=25)
