"""The iteration-boundary demonstration: the last bit against a loop in plain floats."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.demos import Demo, run


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("iteration-boundary")


def project(k: float) -> tuple[int, float, float]:
    """Iterations, what is left and its derivative by k, in the order of the product alpha k first."""
    p, it, slope, gain = 0.45, 0, 0.0, 0.5 * k
    while p >= 1e-4:
        slope = slope * (1 - gain) - 0.5 * p
        p, it = p - gain * p, it + 1
    return it, p, slope


def test_every_check_holds(demo: Demo) -> None:
    assert [check.what for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 7


def test_the_boundary_near_one_half_to_the_last_bit(demo: Demo) -> None:
    numbers = demo.numbers
    assert numbers["k_above"] == 0.5035674359581247 == np.nextafter(numbers["k_below"], 1)
    sides = [project(numbers[key]) for key in ("k_below", "k_above")]
    assert numbers["iterations"] == [it for it, _, _ in sides] == [30, 29]
    assert numbers["loss"] == [p for _, p, _ in sides]
    np.testing.assert_allclose(numbers["loss"], [7.48e-5, 1.00e-4], rtol=1e-3)
    np.testing.assert_allclose(numbers["gradient"], [slope for _, _, slope in sides], rtol=1e-12)
    np.testing.assert_allclose(numbers["gradient"], [-1.50e-3, -1.94e-3], rtol=2e-3)
    assert 40 <= numbers["evaluations"] <= 52


def test_every_row_of_the_table_is_a_boundary_of_the_loop(demo: Demo) -> None:
    assert len(demo.tables[0].rows) == demo.numbers["boundaries"] >= 3
    for row in demo.tables[0].rows:
        below = float(row[0])
        assert project(below)[0] == row[1]
        assert project(float(np.nextafter(below, 1)))[0] == row[2]


def test_the_derivatives_do_not_add_up_to_the_change_of_the_loss(demo: Demo) -> None:
    assert demo.numbers["mean_gradient"] < -1.4e-3
    assert abs(demo.numbers["secant"]) < 0.5 * abs(demo.numbers["mean_gradient"])
