"""The solver demonstration, against conjugate gradients written out in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.demos import Demo, run
from mdnum.ball.demos.tf32_in_solver import CAP, EASY, HARD, TOL, system

# the whole demonstration is run
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("tf32-in-solver")


def ten_bits(x):
    bits = x.view(np.uint32).astype(np.uint64)
    return ((bits + 0xFFF + ((bits >> 13) & 1)) & ~np.uint64(0x1FFF)).astype(np.uint32).view(np.float32)


def conjugate_gradients(matrix, b, rounded):
    a, b = matrix.astype(np.float32), b.astype(np.float32)
    x, r, p, rr = np.zeros_like(b), b, b, np.dot(b, b)
    limit = np.float32(TOL) ** 2 * rr
    for count in range(CAP + 1):
        if rr <= limit or count == CAP:
            gap = b - matrix @ x.astype(float)
            return count, np.linalg.norm(gap) / np.linalg.norm(b)
        q = (ten_bits(a) @ ten_bits(p)) if rounded else a @ p
        step = rr / np.dot(p, q)
        x, r = x + step * p, r - step * q
        rr, old = np.dot(r, r), rr
        p = r + (rr / old) * p
    raise AssertionError


def test_every_check_holds(demo: Demo):
    assert [(check.what, check.seen) for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 8


def test_the_numbers_are_those_of_a_plain_implementation(demo: Demo):
    # sums of 50 products in another order: counts wander, orders of magnitude do not
    for name, rounded in (("float32", False), ("tf32", True)):
        count, true = conjugate_gradients(*system(HARD), rounded)
        assert demo.numbers[f"iterations_{name}"] == pytest.approx(count, rel=0.15)
        assert demo.numbers[f"true_residual_{name}"] == pytest.approx(true, rel=1.0)
    assert 0.05 < demo.numbers["true_residual_tf32"] < 0.2
    assert 5e-5 < demo.numbers["true_residual_float32"] < 5e-4
    assert demo.numbers["recurrence_residual_tf32"] <= TOL
    for name, rounded in (("float32", False), ("tf32", True)):
        easy = conjugate_gradients(*system(EASY), rounded)[0]
        assert demo.numbers["iterations_at_condition_100"][name] == pytest.approx(easy, abs=4)


def test_the_column_depends_on_the_format(demo: Demo):
    inner = demo.numbers["column_inner_iterations"]
    assert inner["tf32"] > 1.1 * inner["float32"]
    assert inner["bfloat16"] > 1.5 * inner["float32"]
    first = demo.numbers["first_contact_that_differs"]
    assert first["float64"] is None and first["float32"] is None
    assert first["bfloat16"] < first["tf32"]
