"""Noise and steps of differences, on functions whose noise and derivatives are known."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.gradients.differences import choose_step, noise_of, richardson


@pytest.mark.parametrize("noise", [1e-12, 1e-6])
@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_the_noise_of_many_draws_is_found_within_a_factor_of_a_few(noise, slope):
    rng = np.random.default_rng(1)
    found = [
        noise_of(2.0 + slope * np.arange(7) * 1e-14 + noise * rng.standard_normal(7)) for _ in range(300)
    ]
    assert np.quantile(found, 0.05) > noise / 4
    assert np.quantile(found, 0.95) < 4 * noise


def test_without_noise_there_is_none():
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
