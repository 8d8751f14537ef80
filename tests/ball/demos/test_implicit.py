"""The implicit demonstration against closed forms, and its costs against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.demos import Demo, run
from mdnum.ball.gradients.cost import accuracy

# the whole demonstration is run
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("implicit")


def test_every_check_holds(demo: Demo) -> None:
    assert [check.what for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 8


def test_the_known_derivatives_by_tolerance(demo: Demo) -> None:
    np.testing.assert_allclose(demo.numbers["grad_k_unrolled"][:3], [-7.5e-2, -1.6e-3, -2.5e-5], rtol=0.015)
    assert demo.numbers["iterations"][:3] == [14, 30, 46]
    for tol, n, slope in zip(
        demo.numbers["tolerances"], demo.numbers["iterations"], demo.numbers["grad_k_unrolled"], strict=True
    ):
        assert n == int(np.ceil(np.log(tol / 0.45) / np.log(0.75)))
        np.testing.assert_allclose(slope, -0.45 * n * 0.75 ** (n - 1) / 2, rtol=1e-12)
    assert demo.numbers["grad_k_implicit"] == [0.0] * 6
    assert demo.numbers["depends_on_k"] is False


def test_the_tape_grows_by_a_number_per_ball_and_iteration(demo: Demo) -> None:
    rows = np.array(demo.tables[1].rows, float)
    per = np.diff(rows[:, 1]) / np.diff(rows[:, 0]) / 1000
    # at least the height of each ball before each iteration
    assert np.all(per >= 8)
    assert np.ptp(rows[:, 2]) == np.ptp(rows[:, 3]) == 0


def test_regularization_moves_the_derivative_as_an_eigenbasis_says() -> None:
    (found,) = accuracy([1e-13], [1e-3], condition=100.0, unknowns=30, seed=3)
    random = np.random.default_rng(3)
    basis, _ = np.linalg.qr(random.normal(size=(30, 30)))
    values = np.geomspace(0.01, 1.0, 30)
    parts = basis.T @ random.normal(size=30)
    # A c divided by A + 1e-3 loses 1e-3 / (a + 1e-3) of each eigenvector
    expected = np.linalg.norm(parts * 1e-3 / (values + 1e-3)) / np.linalg.norm(parts)
    np.testing.assert_allclose(found.error, expected, rtol=1e-9)
