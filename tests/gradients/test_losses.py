"""Losses against numpy and scipy on the stored trajectory, and their derivatives against differences."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from ase.neighborlist import neighbor_list
from scipy.integrate import trapezoid
from scipy.interpolate import BSpline
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients.differences import FiniteDifferences
from mdnum.gradients.losses import (
    Custom,
    EinsteinDiffusion,
    FinalProjection,
    GreenKuboDiffusion,
    MeanPressure,
    RadialDistribution,
    VelocityAutocorrelation,
)
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import Symmetric
from mdnum.gradients.tape import pace_of
from mdnum.rollout.engine import Engine, unwrapped
from mdnum.systems import build

STEPS, BINS, R_MAX = 40, 24, 2.4
RDF = RadialDistribution(r_max=R_MAX, bins=BINS, every=10)
EINSTEIN = EinsteinDiffusion(every=5, first=10)
GREEN_KUBO = GreenKuboDiffusion(every=2, until=STEPS)


@pytest.fixture(scope="module")
def run(smooth):
    """A short run of 108 atoms with every position and velocity kept."""
    simulation, x, v = smooth, [], []
    for segment in Engine(simulation, STEPS).segments():
        for row in range(segment.rows):
            wrapped, images = segment.unsorted("x", row), segment.unsorted("images", row)
            x.append(unwrapped(np.asarray(simulation.cell.matrix), wrapped, images))
            v.append(segment.unsorted("v", row))
    return SimpleNamespace(simulation=simulation, x=np.stack(x), v=np.stack(v))


@pytest.mark.parametrize(("first", "every", "steps"), [(0, 7, 28), (5, 3, 29), (10, 5, 40), (12, 4, 48)])
def test_a_frame_is_shared_by_the_steps_since_the_frame_before(first, every, steps):
    """And the first one by the same number of steps before it, so that shares add up to the frames."""
    pace = pace_of(EinsteinDiffusion(every=every, first=first), steps)
    found = np.array(
        [0.004 * pace.share(jnp.int64(step), jnp.float64(0.004)) for step in range(-9, steps + 1)]
    )
    frames = range(first, steps + 1, every)
    expected = [any(0 <= frame - step < every for frame in frames) / every for step in range(-9, steps + 1)]
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    assert found.sum() == pytest.approx(len(frames), rel=1e-13)


def test_a_loss_of_one_frame_has_no_pace():
    for loss in (FinalProjection(), MeanPressure(every=50, first=3)):
        pace = pace_of(loss, 30)
        assert not any(float(pace.share(jnp.int64(step), jnp.float64(0.004))) for step in range(31))


def g_of_r(run) -> np.ndarray:
    """g(r) of the frames that RDF looks at, from ASE's distances and scipy's B-splines."""
    atoms = run.simulation.structure.copy()
    width = R_MAX / BINS
    centers = width * (np.arange(BINS) + 0.5)
    fine = np.linspace(-2 * width, 2 * width, 2001)
    hat = BSpline.basis_element(width * np.arange(-2.0, 3.0), extrapolate=False)
    shells = np.array(
        [trapezoid(np.nan_to_num(hat(fine)) * 4 * np.pi * (c + fine) ** 2, fine) for c in centers]
    )
    found = np.zeros(BINS)
    for x in run.x[::10]:
        atoms.positions = x
        distance = neighbor_list("d", atoms, R_MAX + 2 * width)
        counts = np.array([np.nansum(hat(distance - center)) for center in centers])
        found += counts * atoms.get_volume() / shells
    return found / len(run.x[::10]) / (len(atoms) * (len(atoms) - 1))


def test_g_of_r_is_that_of_all_distances(run):
    expected = g_of_r(run)
    assert expected.max() > 2 and expected[3] == 0
    target = Problem(run.simulation, replace(RDF, target=jnp.asarray(expected)), STEPS)
    assert target.value() < 1e-12
    weights = np.random.default_rng(0).standard_normal(BINS)
    projected = Problem(run.simulation, replace(RDF, weights=jnp.asarray(weights)), STEPS)
    assert projected.value() == pytest.approx(weights @ expected, rel=1e-6)


def test_diffusion_is_slope_and_integral(run):
    dt = run.simulation.timestep
    time = dt * np.arange(STEPS + 1)
    msd = np.mean(np.sum((run.x - run.x[0]) ** 2, axis=2), axis=1)
    slope = np.polyfit(time[10::5], msd[10::5], 1)[0]
    assert Problem(run.simulation, EINSTEIN, STEPS).value() == pytest.approx(slope / 6, rel=1e-9)
    vacf = np.mean(np.sum(run.v * run.v[0], axis=2), axis=1)
    integral = trapezoid(vacf[::2], time[::2]) / 3
    assert Problem(run.simulation, GREEN_KUBO, STEPS).value() == pytest.approx(integral, rel=1e-12)
    last = Problem(run.simulation, VelocityAutocorrelation(), STEPS).value()
    assert last == pytest.approx(vacf[-1], rel=1e-12)


def test_diffusion_is_told_per_unit_of_time():
    """In metal units the internal time is not a picosecond."""
    weak = LENNARD_JONES | {"epsilon": 1e-9}
    simulation = build(make(crystal(), weak, {"kind": "hard", "radius": 2.2}, units="metal"))
    moving = replace(simulation, velocities=np.tile([0.01, 0.0, 0.0], (simulation.atoms, 1)))
    problem = Problem(moving, GreenKuboDiffusion(until=1), 1)
    speed = 0.01 * simulation.units.time_factor
    dt = simulation.timestep
    assert problem.value() == pytest.approx(speed**2 * dt / 3, rel=1e-3)
    assert Problem(moving, EinsteinDiffusion(), 1).value() == pytest.approx(speed**2 * dt / 6, rel=1e-3)


@pytest.mark.slow
def test_derivatives_are_those_of_differences(run):
    """All three at once, with weights that no symmetry cancels: one reverse pass to compile."""
    rdf = replace(RDF, weights=jnp.asarray(np.random.default_rng(1).standard_normal(BINS)))
    losses, frames = (rdf, EINSTEIN, GREEN_KUBO), (STEPS // 2 + 1, STEPS // 2 + 1, 1)

    def see(*frame):
        return tuple(loss.observe(*frame) for loss in losses)

    def conclude(total, _):
        return sum(loss.value(*given) for loss, *given in zip(losses, total, frames, strict=True))

    problem = Problem(run.simulation, Custom(see=see, conclude=conclude, every=2), STEPS)
    names = ("sigma", "timestep", "scale")
    ours = Symmetric()(problem, names)
    theirs = FiniteDifferences(relative=1e-4, levels=3)(problem, names)
    for name, value in theirs.gradient.items():
        assert float(ours.gradient[name]) == pytest.approx(float(value), rel=1e-6), name


def test_what_has_no_meaning_is_refused(run):
    well = build("pair/leaving-well")
    for simulation, loss, steps, text in (
        (run.simulation, RadialDistribution(r_max=2.7), STEPS, "beyond half .*r_max"),
        (run.simulation, GreenKuboDiffusion(until=50), STEPS, "ends at step 50"),
        (run.simulation, EinsteinDiffusion(first=40), STEPS, "two frames"),
        (well, MeanPressure(), 10, "no volume"),
    ):
        with pytest.raises(InputError, match=text):
            Problem(simulation, loss, steps)
    with pytest.raises(InputError, match=r"expected \(24,\)"):
        replace(RDF, target=jnp.ones(3))
