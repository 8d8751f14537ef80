"""A parameter that is not written, not used, or used to no effect, told apart."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.gradients.dependence import dependence
from mdnum.numerics.exact import fence, zero_bits


def relax(tol: float, cap: int = 40):
    """The penetration that a projection leaves, as a function of its gain: a loop that may run zero times."""
    zero = zero_bits(jnp.float64)

    def loss(at):
        def body(carry):
            p, it = carry
            return p - fence(0.5 * at["k"] * p, zero), it + 1

        start = (at["p0"], 0)
        p, _ = jax.lax.while_loop(lambda c: (jnp.sum(c[0]) >= tol) & (c[1] < cap), body, start)
        return jnp.sum(p)

    return loss


@pytest.mark.parametrize(("tol", "iterations"), [(1e-2, 14), (1e-4, 30), (1.0, 0)])
def test_a_loop_that_ran_no_iteration_did_not_use_the_gain(tol: float, iterations: int) -> None:
    at = {"k": 0.5, "p0": jnp.array([0.25, 0.2])}
    found = dependence(relax(tol), at, why_unused="the loop ended before {name} was used")
    # d/dk of p0 (1 - k/2)^n
    expected = 0.45 * iterations * 0.75 ** (iterations - 1) * -0.5 if iterations else 0.0
    assert found["k"].written
    assert found["k"].used == (iterations > 0)
    np.testing.assert_allclose(found["k"].derivative, expected, rtol=1e-12)
    assert found["p0"].used
    if not iterations:
        assert found["k"].message == "the loop ended before k was used: the loss does not depend on k"


def test_what_the_program_cannot_reach_is_not_written() -> None:
    found = dependence(lambda at: jnp.sin(at["a"]) + jax.lax.stop_gradient(at["b"]), {"a": 1.0, "b": 2.0})
    assert found["a"].written
    assert not found["b"].written
    assert "no path from b" in found["b"].message


def test_a_used_parameter_may_still_have_a_zero_derivative() -> None:
    found = dependence(lambda at: (at["a"] * 1e-200) * 1e-200, {"a": 1.0})
    assert found["a"].used
    assert found["a"].derivative == 0.0
    assert "exactly zero" in found["a"].message


@pytest.mark.parametrize("x", [-1.0, 1.0])
def test_marks_follow_the_branch_taken_by_element_and_by_cond(x: float) -> None:
    def by_where(at):
        y = jnp.array([x, -2.0])
        return jnp.sum(jnp.where(y < 0, at["a"], at["b"][:2]))

    def by_cond(at):
        return jax.lax.cond(jnp.asarray(x) < 0, lambda: at["a"][0], lambda: at["b"][0])

    at = {"a": jnp.ones(2), "b": jnp.ones(3)}
    where, cond = dependence(by_where, at), dependence(by_cond, at)
    assert where["a"].used
    assert where["b"].used == (x > 0)
    assert (cond["a"].used, cond["b"].used) == (x < 0, x > 0)
    assert all(answer.written for answer in (*where.values(), *cond.values()))


def test_marks_move_with_the_elements_through_a_scan() -> None:
    def loss(at):
        def body(carry, row):
            # only the first of two balls ever touches k
            return jnp.concatenate([carry[:1] * at["k"], carry[1:] + row]), carry[1]

        end, rows = jax.lax.scan(body, jnp.ones(2), at["u"])
        return end[1] + jnp.sum(rows)

    found = dependence(loss, {"k": 2.0, "u": jnp.ones(3)})
    # a carry is one value to the text; the tape knows its elements
    assert found["k"].written
    assert not found["k"].used
    assert found["u"].used


def test_a_primitive_without_a_rule_of_its_own_marks_everything() -> None:
    found = dependence(lambda at: jnp.sort(jnp.array([3.0, 1.0]) * at["a"])[0], {"a": 1.0})
    assert found["a"].used
    np.testing.assert_allclose(found["a"].derivative, 1.0)


def test_only_some_are_asked_about_and_unknown_names_are_refused() -> None:
    assert list(dependence(lambda at: at["a"] * at["b"], {"a": 1.0, "b": 2.0}, ["b"])) == ["b"]
    with pytest.raises(InputError, match="no parameter 'c'"):
        dependence(lambda at: at["a"], {"a": 1.0}, ["c"])
