"""The saltation demonstration against a plain loop over the impacts and one over the steps."""

from __future__ import annotations

import math

import pytest

from mdnum.ball import demos

# the whole demonstration is run
pytestmark = pytest.mark.slow

G, E, TIME = 9.81, 0.8, 2.0


def exact(y0: float) -> float:
    """Derivative of the height at 2 s by y0: each impact's time and speed, and their derivatives, in turn."""
    speed = math.sqrt(2 * G * y0)
    by_speed = G / speed
    time, by_time = speed / G, by_speed / G
    while True:
        speed, by_speed = E * speed, E * by_speed
        if time + 2 * speed / G > TIME:
            break
        time, by_time = time + 2 * speed / G, by_time + 2 * by_speed / G
    tau = TIME - time
    return by_speed * tau - (speed - G * tau) * by_time


def corrected(count: int) -> float:
    """The same by steps of semi-implicit Euler from 1 m, with the saltation matrix written out."""
    h = TIME / count
    y, v, dy, dv = 1.0, 0.0, 1.0, 0.0
    for _ in range(count):
        v = v - h * G
        y, dy = y + h * v, dy + h * dv
        if y < 0:
            y, dy, dv = 0.0, -E * dy, -(1 + E) * G / v * dy - E * dv
            v = -E * v
    return dy


def test_the_derivative_is_zero_by_steps_and_restored_by_saltation():
    demo = demos.run("saltation")
    assert demo.ok, [check for check in demo.checks if not check.ok]
    numbers = demo.numbers
    assert numbers["exact"] == pytest.approx(exact(1.0), rel=1e-13)
    assert round(numbers["exact"], 5) == 0.42661
    assert set(numbers["by_steps"].values()) == {0.0}
    for h, count in (("0.01", 200), ("0.001", 2000), ("0.0001", 20_000)):
        known = abs(corrected(count) - exact(1.0))
        assert numbers["saltation_error"][h] == pytest.approx(known, rel=1e-6)
    assert [float(f"{numbers['saltation_error'][h]:.2g}") for h in ("0.01", "0.001", "0.0001")] == [
        0.39,
        0.0099,
        0.0014,
    ]
    assert numbers["time_of_impact_error"] < 2e-14
