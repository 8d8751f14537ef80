"""The column of balls, against a dense Newton solve in numpy and against its closed-form rest."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.ball.column import Column, in_format, simulate_column
from mdnum.ball.conjugate import conjugate_gradients
from mdnum.ball.state import Reason
from mdnum.errors import InputError

H, G = 0.01, 9.81


def exact_step(q, v, k, h=H):
    """The minimum of a step by trying every set of contacts: the one that agrees with itself."""
    n = len(q)
    jacobian = np.eye(n) - np.eye(n, k=-1)
    free = q + h * v - h * h * G
    for flags in itertools.product([0.0, 1.0], repeat=n):
        active = np.diag(flags)
        new = np.linalg.solve(np.eye(n) + h * h * k * jacobian.T @ active @ jacobian, free)
        if np.array_equal(jacobian @ new < 0, np.array(flags) > 0):
            return new, (new - q) / h, np.array(flags) > 0
    raise AssertionError("no set of contacts agrees with itself")


def test_a_step_is_the_minimum_found_by_trying_all_sets_of_contacts():
    column = Column.create(6, "float64", k=1e6, tol=1e-13, inner_tol=1e-13)
    q = np.cumsum(np.random.default_rng(3).uniform(0, 2e-3, 6))
    run = simulate_column(column, column.start(q), 25)
    v = np.zeros(6)
    for step in range(25):
        q, v, contact = exact_step(q, v, 1e6)
        assert np.abs(run.q[step + 1] - q).max() < 1e-11
        assert np.array_equal(run.record.contact[step], contact)
    assert run.record.contact.any() and not run.record.contact.all()
    assert run.ended() == {"tolerance": 25}


@pytest.mark.parametrize("format,rel", [("float64", 1e-9), ("float32", 1e-2)])
def test_at_rest_each_spring_carries_what_is_above(format, rel):
    column = Column.create(12, format, k=1e6, tol=1e-7)
    run = simulate_column(column, column.start(0.0), 200)
    gaps = np.asarray(run.record.gap[-1])
    assert gaps == pytest.approx(-np.arange(12, 0, -1) * G / 1e6, rel=rel)
    assert run.record.contact[-1].all()


def test_the_inner_format_changes_how_long_it_takes():
    column = Column.create(32, "float32", k=1e7, tol=1e-6)
    start = np.cumsum(np.random.default_rng(0).uniform(0, 2e-3, 32))
    inner = {}
    for name in ("float32", "tf32", "bfloat16"):
        one = in_format(column, name)
        run = simulate_column(one, one.start(start), 20)
        inner[name] = int(run.record.inner.sum())
        assert (np.asarray(run.record.recurrence)[run.record.outer > 0] < 1.01e-4).all()
    assert inner["float32"] < inner["tf32"] < inner["bfloat16"]


def test_a_cap_is_recorded_as_one():
    column = Column.create(24, "float32", k=1e7, tol=1e-6, max_outer=1)
    run = simulate_column(column, column.start(np.linspace(0, 0.02, 24)), 12)
    assert run.ended()["cap"] > 0
    assert run.record.outer.max() == 1


def test_where_two_columns_part_is_found():
    column = Column.create(8, "float64", k=1e6, tol=1e-12, inner_tol=1e-12)
    a = simulate_column(column, column.start(np.linspace(1e-3, 1e-2, 8)), 30)
    b = simulate_column(column, column.start(np.linspace(1.9e-3, 1.4e-2, 8)), 30)
    found = a.first_difference(b)
    assert found is not None
    step, ball, gap_a, gap_b = found
    differ = a.record.contact != b.record.contact
    assert not differ[: step - 1].any() and differ[step - 1, ball]
    assert (gap_a < 0) != (gap_b < 0)
    assert a.first_difference(a) is None


def test_conjugate_gradients_solve_and_know_it():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(30, 30))
    matrix, b = jnp.asarray(root @ root.T + 30 * np.eye(30)), jnp.asarray(rng.normal(size=30))
    solved = conjugate_gradients(lambda v: matrix @ v, b, 1e-12, 60, true_product=lambda x: matrix @ x)
    assert np.abs(np.asarray(solved.x) - np.linalg.solve(matrix, b)).max() < 1e-12
    assert Reason(int(solved.reason)) == Reason.TOLERANCE
    n = int(solved.iterations)
    true = np.linalg.norm(np.asarray(b - matrix @ solved.x)) / np.linalg.norm(b)
    assert float(solved.true_history[n]) == pytest.approx(true, rel=1e-6)
    assert float(solved.history[n]) == float(solved.residual) <= 1e-12
    assert np.isnan(np.asarray(solved.history)[n + 1 :]).all()
    capped = conjugate_gradients(lambda v: matrix @ v, b, 1e-12, 3)
    assert (int(capped.iterations), Reason(int(capped.reason))) == (3, Reason.CAP)
    assert capped.history.shape == (0,)
    lost = conjugate_gradients(lambda v: v * jnp.nan, b, 1e-12, 9)
    assert Reason(int(lost.reason)) == Reason.NOT_FINITE
    nothing = conjugate_gradients(lambda v: matrix @ v, b * 0, 1e-12, 9)
    assert int(nothing.iterations) == 0 and not np.asarray(nothing.x).any()


def test_a_column_that_is_none_is_refused():
    with pytest.raises(InputError, match="0 balls"):
        Column.create(0)
    with pytest.raises(InputError, match=r"column: k = -1"):
        Column.create(k=-1)
    with pytest.raises(InputError, match="unknown format 'fp8'"):
        Column.create(format="fp8")
