"""The landscapes of the smoothing demonstration against a plain numpy loop over the same starts."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball import demos

# the whole demonstration is run
pytestmark = pytest.mark.slow

G, K, H, STEPS = 9.81, 3000.0, 0.01, 200
STARTS = np.linspace(0.9, 1.1, 1001)


def heights(eps: float, starts: np.ndarray) -> np.ndarray:
    """Heights after 2 s by semi-implicit Euler on a floor of this width."""
    y, v = starts.copy(), np.zeros_like(starts)
    for _ in range(STEPS):
        depth = eps * np.logaddexp(0, -y / eps) if eps else np.maximum(-y, 0)
        v = v + H * (K * depth - G)
        y = y + H * v
    return y


def test_the_landscape_is_that_of_a_plain_loop():
    demo = demos.run("smoothing-width")
    assert [check.what for check in demo.checks if not check.ok] == []
    numbers = demo.data
    exact = demo.plots[0].series[-1]
    # the exact motion from 1 m: the fall, a contact of the closed-form length, and so on, by fine steps
    y, v, h = 1.0, 0.0, 1e-5
    for _ in range(200_000):
        v = v + h * (K * max(-y, 0.0) - G)
        y = y + h * v
    target = y
    assert exact.y.min() < 1e-12
    for eps in (0.003, 0.01, 0.03, 0.1):
        loss = (heights(eps, STARTS) - target) ** 2
        best = STARTS[np.argmin(loss)]
        # the target of the loop is off by its own step
        assert numbers["minimizer_shift"][f"{eps:g}"] == pytest.approx(best - 1, abs=4e-4)
        minima = int(np.sum((loss[1:-1] < loss[:-2]) & (loss[1:-1] <= loss[2:])))
        assert abs(numbers["minima"][f"{eps:g}"] - minima) <= 0.1 * minima
        slope = (heights(eps, STARTS + 1e-7) - heights(eps, STARTS - 1e-7)) / 2e-7
        line = demo.plots[1].series
        shown = {series.label: series.y for series in line}
        if f"width {eps:g} m" in shown:
            np.testing.assert_allclose(shown[f"width {eps:g} m"], slope, rtol=1e-5, atol=1e-5)
    assert demo.numbers["minima_hard"] == numbers["minima"]["0"] > 20
    assert numbers["minima"]["0.03"] == 1
    assert numbers["gradient_error"]["0.03"] < 0.01 < 10 < numbers["gradient_error"]["0"]
    assert abs(numbers["minimizer_shift"]["0.1"]) == pytest.approx(0.032, abs=1e-3)
