"""A parameter that is not written, not used, or used to no effect, told apart."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from mdnum.gradients.ball import dependence
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


@pytest.mark.parametrize(("tol", "iterations"), [(1e-2, 14), (1.0, 0)])
def test_a_loop_that_ran_no_iteration_did_not_use_the_gain(tol: float, iterations: int) -> None:
    found = dependence(relax(tol), {"k": 0.5, "p0": jnp.array([0.25, 0.2])})
    assert found == {"k": (True, iterations > 0), "p0": (True, True)}


def test_what_the_program_cannot_reach_is_not_written() -> None:
    found = dependence(lambda at: jnp.sin(at["a"]) + jax.lax.stop_gradient(at["b"]), {"a": 1.0, "b": 2.0})
    assert found == {"a": (True, True), "b": (False, False)}


def test_a_used_parameter_may_still_have_a_zero_derivative() -> None:
    def loss(at):
        # the sort has no derivative by element
        return (jnp.sort(jnp.array([3.0, 1.0]) * at["a"])[0] * 1e-200) * 1e-200

    assert jax.grad(loss)({"a": 1.0})["a"] == 0.0
    assert dependence(loss, {"a": 1.0})["a"].used


@pytest.mark.parametrize("x", [-1.0, 1.0])
def test_the_branch_taken_counts_by_element_and_by_cond(x: float) -> None:
    def by_where(at):
        y = jnp.array([x, -2.0])
        return jnp.sum(jnp.where(y < 0, at["a"], at["b"][:2]))

    def by_cond(at):
        return jax.lax.cond(jnp.asarray(x) < 0, lambda: at["a"][0], lambda: at["b"][0])

    at = {"a": jnp.ones(2), "b": jnp.ones(3)}
    assert dependence(by_where, at) == {"a": (True, True), "b": (True, x > 0)}
    assert dependence(by_cond, at) == {"a": (True, x < 0), "b": (True, x > 0)}


def test_elements_are_told_apart_through_a_scan() -> None:
    def loss(at):
        def body(carry, row):
            # only the first of two balls ever touches k
            return jnp.concatenate([carry[:1] * at["k"], carry[1:] + row]), carry[1]

        end, rows = jax.lax.scan(body, jnp.ones(2), at["u"])
        return end[1] + jnp.sum(rows)

    # a carry is one value to the text
    assert dependence(loss, {"k": 2.0, "u": jnp.ones(3)}) == {"k": (True, False), "u": (True, True)}
