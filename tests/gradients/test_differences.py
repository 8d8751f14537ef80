"""Differences, means over replicas, another precision and another program, against what they must be."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from ase.build import bulk
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients.differences import (
    Ensemble,
    FiniteDifferences,
    Replicas,
    ShadowDifferences,
    SmoothedDifferences,
    choose_step,
    noise_of,
    replica,
    richardson,
)
from mdnum.gradients.losses import Custom, MeanSquaredDisplacement, MeanTemperature
from mdnum.gradients.problem import Gradient, Method, Problem
from mdnum.gradients.recorded import EventAware, Surrogate, Symmetric
from mdnum.systems import build

# so short that the force jumps by 0.8
HARD = {"kind": "hard", "radius": 1.6}


@dataclass(frozen=True)
class Noisy(Method):
    """A made-up gradient: 1, and the number of steps more or less, in turns."""

    calls: list[int] = field(default_factory=list)

    name = "noisy"
    description = "one plus noise"

    def differentiate(self, problem, names, progress) -> Gradient:
        self.calls.append(problem.steps)
        noise = problem.steps * (-1) ** len(self.calls)
        return self.result(0.0, {name: np.asarray(1.0 + noise) for name in names})


@pytest.fixture(scope="module")
def hard():
    return build(make(crystal(), LENNARD_JONES, HARD))


def test_replicas_differ_in_velocities_of_one_temperature(hard):
    starts = [replica(hard, seed) for seed in range(30)]
    again = replica(hard, 3)
    assert np.array_equal(again.velocities, starts[3].velocities)
    kinetic = [float(np.sum(one.velocities**2)) / (3 * one.atoms - 3) for one in starts]
    assert np.mean(kinetic) == pytest.approx(1.0, abs=3 * np.sqrt(2 / (3 * 108 * 30)))
    assert len({float(one.velocities[0, 0]) for one in starts}) == 30
    assert np.abs(np.sum(starts[0].velocities, axis=0)).max() < 1e-12
    assert not np.array_equal(replica(hard, 3, settle=5).positions, hard.positions)
    with pytest.raises(InputError, match="at least 2"):
        Replicas(1)


def test_the_horizon_of_noise_is_where_the_error_passes_the_mean(hard):
    """Eight values of one plus and minus T: mean 1, standard error T / sqrt(7)."""
    problem = Problem(hard, Custom(see=lambda frame, *_: frame.potential), 16)
    found = Ensemble(Noisy(), Replicas(8), halvings=4)(problem, ("sigma",))
    assert float(found.gradient["potential.sigma"]) == 1.0
    assert found.details["error"]["potential.sigma"] == pytest.approx(16 / np.sqrt(7))
    rows = found.details["horizons"]
    assert [row["steps"] for row in rows] == [1, 2, 4, 8, 16]
    assert [row["error"] for row in rows] == pytest.approx([row["steps"] / np.sqrt(7) for row in rows])
    # sqrt(7) lies between 2 and 4
    assert found.details["horizon of noise"]["potential.sigma"] == 4
    with pytest.raises(InputError, match="of its own"):
        Ensemble()(problem, ("v0",))


@pytest.mark.nightly
def test_wide_differences_of_a_melt_agree_with_the_flow_and_not_with_the_steps():
    """How hot a crystal has become while it melts: replica by replica, what the flips add is some standard
    errors of the difference, and with it nothing is missing. By the radius, plain is exactly 0."""
    atoms = bulk("Ar", "sc", a=0.8442 ** (-1 / 3), cubic=True).repeat(5)
    atoms.set_masses([1.0] * len(atoms))
    problem = Problem(build(make(atoms, LENNARD_JONES, HARD)), MeanTemperature(first=80), 80)
    starts, names = Replicas(5), ("potential.sigma", "cutoff.radius")
    wide = SmoothedDifferences(0.002, 2, starts)(problem, names)
    assert min(wide.details["moved"].values()) > 0.2
    plain, aware = (
        Ensemble(method, starts, halvings=0)(problem, names) for method in (Symmetric(), EventAware())
    )

    def apart(found: Gradient, name: str) -> tuple[float, float]:
        difference = np.array(found.details["each"][name]) - np.array(wide.details["each"][name])
        return abs(difference.mean()), difference.std(ddof=1) / np.sqrt(len(difference))

    for name in names:
        mean, error = apart(plain, name)
        assert mean > 4 * error, name
        near, noise = apart(aware, name)
        assert near < 2 * noise and near < mean / 3, name
    assert float(plain.gradient["cutoff.radius"]) == 0.0


def by_sigma(method: Method, problem: Problem) -> float:
    return float(method(problem, ("sigma",)).gradient["potential.sigma"])


@pytest.mark.slow
def test_the_shadow_of_a_narrow_run_has_the_derivative_of_a_wide_one(smooth):
    cutoff = {"kind": "quintic", "radius": 2.2, "onset": 1.8}
    narrow = dict.fromkeys(("state", "force", "decision", "accumulate"), "float32")
    problem = Problem(
        build(make(crystal(), LENNARD_JONES, cutoff, precision=narrow)), MeanSquaredDisplacement(), 30
    )
    true = by_sigma(Symmetric(), replace(problem, simulation=smooth))
    assert by_sigma(ShadowDifferences(levels=2), problem) == pytest.approx(true, rel=1e-6)
    # the narrow run's own differences are noise of a rounding over the step
    assert by_sigma(FiniteDifferences(levels=2), problem) != pytest.approx(true, rel=1e-4)
    with pytest.raises(InputError, match="no wider format"):
        ShadowDifferences()(replace(problem, simulation=smooth), ("sigma",))


@pytest.mark.slow
def test_a_surrogate_is_the_gradient_of_the_switched_system(hard):
    problem = Problem(hard, MeanSquaredDisplacement(), 20)
    found = Surrogate(onset=0.8)(problem, ("sigma",))
    switched = build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 1.6, "onset": 1.28}))
    twin = replace(problem, simulation=switched)
    assert found.value == pytest.approx(twin.value(), rel=1e-12)
    assert found.value != pytest.approx(problem.value(), rel=1e-6)
    own = by_sigma(Symmetric(), twin)
    assert float(found.gradient["potential.sigma"]) == pytest.approx(own, rel=1e-10)
    assert "switched cutoff" in found.notes["potential.sigma"]
    with pytest.raises(InputError, match="no force jump"):
        Surrogate()(twin, ("sigma",))


# --- noise and steps, on functions whose noise and derivatives are known ----------------------------


@pytest.mark.parametrize("noise", [1e-12, 1e-6])
@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_the_noise_of_many_draws_is_found_within_a_factor_of_a_few(noise, slope):
    rng = np.random.default_rng(1)
    line = 2.0 + slope * np.arange(7) * 1e-14
    found = [noise_of(line + noise * rng.standard_normal(7)) for _ in range(300)]
    assert noise / 4 < np.quantile(found, 0.05) < np.quantile(found, 0.95) < 4 * noise
    # without noise there is none
    assert noise_of(np.full(7, 1.25)) == 0


@pytest.mark.parametrize("stiffness", [1.0, 1e3, 1e5])
@pytest.mark.parametrize("noise", [1e-15, 1e-9])
def test_the_step_shrinks_to_where_the_function_is_straight(stiffness, noise):
    """exp(k (q - 1)): the step that balances noise and truncation goes with one over k."""
    rng = np.random.default_rng(2)

    def f(q: float) -> float:
        # too wide a step ends in infinity, as a run may
        with np.errstate(over="ignore"):
            return float(np.exp(stiffness * (q - 1.0)) + noise * rng.standard_normal())

    chosen = choose_step(f, 1.0, 1e-2, 64 * 2.2e-16)
    # the argument is rounded too
    least = max(noise, 2.2e-16, stiffness * 1.1e-16)
    best = (3 * least) ** (1 / 3) / stiffness
    assert min(best, 1e-2) / 20 < chosen.size <= 1e-2
    assert chosen.size < 20 * best or chosen.size == 1e-2
    found = richardson(f, 1.0, 2 * chosen.size, 3)
    # a few times the error that no choice of a step with three values on each side avoids
    assert abs(found.value - stiffness) < 30 * stiffness * least ** (2 / 3)
