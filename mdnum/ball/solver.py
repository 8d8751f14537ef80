"""An iteration that is stopped by a rule, with every stopping decision on record."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from mdnum.ball.state import Reason, Solve
from mdnum.ball.stopping import Fixed, StopRule, stops
from mdnum.precision.policy import RolePrecision


def iterate(
    rule: StopRule,
    start: Any,
    update: Callable[[Any], Any],
    terms: Callable[[Any], Float[Array, "balls"]],
    policy: RolePrecision,
    zero: Int[Array, ""],
    *,
    told: Int[Array, "..."] | None = None,
    history: bool = False,
) -> tuple[Any, Solve]:
    """Update until the rule stops it, its cap ends it, or the number of iterations it was told is reached.

    Args:
        rule: when to stop.
        start: a pytree of arrays of shape (balls,).
        update: one iteration.
        terms: of the residual, one per ball.
        policy: dtypes of sums and decisions.
        zero: runtime zero for fenced sums.
        told: iterations to make instead of the rule's own; a negative number leaves it to the rule.
        history: whether to keep the residual of every decision.

    Returns:
        where it ended, and the record.
    """
    accumulate, decision = policy.dtype("accumulate"), policy.dtype("decision")

    def measure(x):
        return lax.stop_gradient(rule.measure(terms(x), accumulate, decision, zero))

    def goes_on(stopped, iterations):
        own = ~stopped & (iterations < rule.max_iter)
        return own if told is None else jnp.where(told < 0, own, iterations < told)

    def note(kept, iterations, residual):
        if not history:
            return kept
        # with a count per ball the loop has made as many rounds as its busiest ball has iterations
        return kept.at[jnp.max(iterations)].set(jnp.max(residual))

    residual = measure(start)
    if told is not None:
        # one rule for the batch may be told a count for each ball
        residual = jnp.broadcast_to(residual, jnp.broadcast_shapes(residual.shape, told.shape))
    iterations = jnp.zeros(residual.shape, jnp.int32)
    threshold = rule.threshold(residual, iterations)
    kept = jnp.full(rule.max_iter + 1 if history else 0, jnp.nan, decision)
    first = residual

    def body(carry):
        x, iterations, residual, margin, _, stopped, kept = carry
        on = goes_on(stopped, iterations)
        x = jax.tree.map(lambda new, old: jnp.where(on, new, old), update(x), x)
        iterations = iterations + on.astype(jnp.int32)
        now = measure(x)
        threshold = rule.threshold(first, iterations)
        return (
            x,
            iterations,
            jnp.where(on, now, residual),
            jnp.where(on, threshold - now, margin),
            jnp.where(on, margin, carry[4]),
            jnp.where(on, stops(threshold, now), stopped),
            note(kept, iterations, now),
        )

    carry = (
        start,
        iterations,
        residual,
        threshold - residual,
        jnp.full(residual.shape, -jnp.inf, decision),
        stops(threshold, residual),
        note(kept, iterations, residual),
    )
    x, iterations, residual, margin, before, stopped, kept = lax.while_loop(
        lambda carry: jnp.any(goes_on(carry[5], carry[1])), body, carry
    )
    met = Reason.FIXED if isinstance(rule, Fixed) else Reason.TOLERANCE
    reason = jnp.where(stopped, met.value, Reason.CAP.value)
    reason = jnp.where(jnp.isfinite(residual), reason, Reason.NOT_FINITE.value).astype(jnp.int8)
    return x, Solve(iterations, reason, residual, margin, before, kept)


def no_solve(dtype: Any) -> Solve:
    """The record of a step without a solver."""
    nothing = jnp.asarray(jnp.nan, dtype)
    return Solve(
        jnp.zeros((), jnp.int32),
        jnp.asarray(Reason.NONE.value, jnp.int8),
        nothing,
        nothing,
        nothing,
        jnp.zeros(0, dtype),
    )
