"""Pair potentials against their definitions in arbitrary precision."""

from __future__ import annotations

import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.md.potentials import LennardJones, Morse, SoftSphere, pair_type


def lennard_jones(r, sigma, epsilon):
    return 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6)


def morse(r, depth, alpha, r0):
    return depth * ((1 - mpmath.exp(-alpha * (r - r0))) ** 2 - 1)


def soft_sphere(r, sigma, epsilon, alpha):
    return epsilon / alpha * (1 - r / sigma) ** alpha if r < sigma else mpmath.mpf(0)


CASES = {
    "argon": (LennardJones, lennard_jones, {"sigma": 3.405, "epsilon": 0.0103235}, (2.9, 12.0)),
    "reduced": (LennardJones, lennard_jones, {"sigma": 1.0, "epsilon": 1.0}, (0.8, 4.0)),
    "copper": (Morse, morse, {"depth": 0.3429, "alpha": 1.3588, "r0": 2.866}, (1.8, 7.0)),
    "harmonic": (SoftSphere, soft_sphere, {"sigma": 1.3, "epsilon": 2.0, "alpha": 2.0}, (0.2, 2.0)),
    "hertz": (SoftSphere, soft_sphere, {"sigma": 1.3, "epsilon": 2.0, "alpha": 2.5}, (0.2, 2.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_energy_and_slope_are_those_of_the_definition(case):
    kind, definition, constants, (low, high) = CASES[case]
    potential = kind(**{name: jnp.asarray([value]) for name, value in constants.items()}).of(None)
    r = np.linspace(low, high, 60)
    energy, slope = potential.evaluate(jnp.asarray(r * r))
    with mpmath.workdps(40):
        exact = {name: mpmath.mpf(value) for name, value in constants.items()}
        for k in range(len(r)):
            at = mpmath.sqrt(mpmath.mpf(float(r[k] * r[k])))
            value = definition(at, **exact)
            derivative = mpmath.diff(lambda x: definition(x, **exact), at) / (2 * at)
            # what cancels in the definition sets the scale: the well, not the value near a zero
            scale = abs(value) + max(exact.values()) * 1e-2
            assert abs(float(energy[k]) - value) < 1e-14 * scale * 10
            assert abs(float(slope[k]) - derivative) < 3e-13 * (
                abs(derivative) + abs(value) + mpmath.mpf(10) ** -3
            )


def test_soft_spheres_that_do_not_touch_feel_nothing_not_even_their_derivatives():
    import jax

    soft = SoftSphere(jnp.asarray([1.0]), jnp.asarray([1.0]), jnp.asarray([2.5])).of(None)
    for r2 in (1.0, 1.0000001, 4.0):
        energy, slope = soft.evaluate(jnp.asarray([r2]))
        assert float(energy[0]) == float(slope[0]) == 0.0
        curvature = jax.grad(lambda x: soft.evaluate(x)[1])(jnp.asarray(r2))
        assert np.isfinite(float(curvature))


@given(species=st.integers(1, 9))
def test_pair_types_count_the_upper_triangle_row_by_row(species):
    rows, columns = np.triu_indices(species)
    assert np.array_equal(pair_type(rows, columns, species), np.arange(len(rows)))
    assert np.array_equal(pair_type(columns, rows, species), np.arange(len(rows)))
