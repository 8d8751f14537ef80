"""The stopping-precision demonstration, pinned by exact rationals and by loops in numpy's own dtypes."""

from __future__ import annotations

from fractions import Fraction

import ml_dtypes
import numpy as np
import pytest

from mdnum.ball.demos import Demo, run
from mdnum.ball.demos.stopping_precision import boundary_batch, policies, problem
from mdnum.errors import InputError
from mdnum.precision.reductions import Exact

# the whole demonstration is run
pytestmark = pytest.mark.slow

KINDS = {"bfloat16": ml_dtypes.bfloat16, "float16": np.float16}


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("stopping-precision")


def first_step(depths: np.ndarray, tol: float, state, sums) -> tuple[int, float]:
    """Iterations of a step and the sum it started from, rounded after every operation."""
    y = [-state(d) for d in depths]
    it, start = 0, None
    while True:
        total = sums(0)
        for one in y:
            total = sums(total + sums(-one))
        start = total if start is None else start
        if total < sums(tol) or it == 25:
            return it, float(start)
        y = [state(one + state(state(0.25) * -one)) for one in y]
        it += 1


def test_every_check_holds(demo: Demo) -> None:
    assert [check.what for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 10


@pytest.mark.parametrize("dtype", KINDS)
def test_iterations_and_sums_are_those_of_a_loop(demo: Demo, dtype: str) -> None:
    tol, depths = boundary_batch(dtype)
    assert sum(Fraction(float(d)) for d in depths) == Fraction(tol)
    low, wide = KINDS[dtype], np.float32
    for (name, row), (state, sums) in zip(
        demo.data[dtype].items(), ((wide, wide), (low, low), (low, wide)), strict=True
    ):
        count, start = first_step(depths, tol, state, sums)
        assert row["iterations"] == [count, 0, 0, 0], name
        assert row["penetration_before"][0] == start, name
    assert [row["iterations"][0] for row in demo.data[dtype].values()] == [1, 0, 1]


def test_the_known_derivatives(demo: Demo) -> None:
    known = {"bfloat16": [-8.198e-8, 0.0, -8.196e-8], "float16": [-8.324e-8, 0.0, -1.192e-7]}
    for dtype, slopes in known.items():
        np.testing.assert_allclose(demo.numbers["grad_k"][dtype], slopes, rtol=1e-3)
        # 2 p1 dp1/dk over nine balls, p1 = 3/4 p0, dp1/dk = -p0/2
        _, depths = boundary_batch(dtype)
        exact = sum(Fraction(float(d)) ** 2 for d in depths) * Fraction(-3, 4) / 9
        np.testing.assert_allclose(demo.numbers["grad_k_exact"][dtype], float(exact), rtol=1e-15)
    assert demo.numbers["grad_k"]["float16"][2] == -(2.0**-23)
    np.testing.assert_allclose(
        demo.numbers["grad_k_scaled"], demo.numbers["grad_k_exact"]["float16"], rtol=1e-3
    )
    assert 0.42 < demo.numbers["error_unscaled"] < 0.44


def test_losses_and_moves_are_those_of_a_loop_in_float32_of_the_narrow_positions(demo: Demo) -> None:
    fragile = {"bfloat16": 1.0930185823099237e-07, "float16": 1.1098907748419151e-07}
    for dtype, low in KINDS.items():
        _, depths = boundary_batch(dtype)
        for row, state in zip(demo.data[dtype].values(), (np.float32, low, low), strict=True):
            start = np.array([state(-d) for d in depths])
            moved = row["iterations"] == [1, 0, 0, 0]
            y = np.array([state(one + state(state(0.25) * -one)) for one in start]) if moved else start
            np.testing.assert_allclose(row["loss"], np.mean(y.astype(np.float32) ** 2), rtol=2e-7)
            # what is left below the floor is set to 0 at the end of a step
            assert row["largest_move"] == [float(depths[0]), 0.0, 0.0, 0.0]
            assert row["first_contact"] == 1
        assert demo.numbers["loss"][dtype][1] == fragile[dtype]


def test_only_the_fragile_runs_do_not_depend_on_the_gain(demo: Demo) -> None:
    assert demo.numbers["depends_on_k"] == {dtype: [True, False, True] for dtype in KINDS}
    for dtype in KINDS:
        says = [row["says"] for row in demo.data[dtype].values()]
        assert says[1] == "the loop ended before k was used: the loss does not depend on k"
        assert says[0] == says[2] == "the loss depends on k"


def test_an_exact_sum_mends_the_fragile_run_only_as_far_as_its_dtype() -> None:
    # the exact sum is the tolerance, and the tolerance is a number of the narrow dtype
    for dtype in KINDS:
        mended = problem(dtype, policies(dtype)[f"{dtype}, fragile sum"], Exact()).run()
        assert mended.iterations.tolist() == [1, 0, 0, 0]


def test_a_batch_that_a_dtype_cannot_hold_is_refused() -> None:
    with pytest.raises(InputError, match="is no float16"):
        boundary_batch("float16", tol=6e-5)
    with pytest.raises(InputError, match="is no bfloat16"):
        boundary_batch("bfloat16", small=7)
