"""Conjugate gradients, with the residual it believes in next to the one it has.

The method updates its residual by a recurrence and stops on that. The recurrence is exact only in exact
arithmetic: with rounded products it goes on falling after the true residual b - A x has stopped to.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Int8

from mdnum.ball.state import Reason

Vector = Float[Array, "n"]


class Solution(NamedTuple):
    """Where conjugate gradients ended.

    Attributes:
        x: the solution.
        iterations: products made.
        residual: of the recurrence, relative to the right-hand side.
        reason: a code of `Reason`: tolerance, cap or not finite.
        history: residual of the recurrence at every stop decision, shape (max_iter + 1,), NaN beyond; shape
            (0,) unless asked for.
        true_history: |b - A x| / |b| with the product that was given for it, likewise.
    """

    x: Vector
    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    reason: Int8[Array, ""]
    history: Float[Array, "decisions"]
    true_history: Float[Array, "decisions"]


def conjugate_gradients(
    product: Callable[[Vector], Vector],
    b: Vector,
    tol: Any,
    max_iter: Any,
    *,
    true_product: Callable[[Vector], Vector] | None = None,
) -> Solution:
    """Solve A x = b for a symmetric positive definite A, starting from zero.

    Not differentiable in reverse mode: the number of iterations is decided while it runs.

    Args:
        product: v -> A v, in the arithmetic under study.
        b: right-hand side; its dtype is that of all vectors and dot products.
        tol: stop when the residual of the recurrence is below tol * |b|.
        max_iter: the cap; it may be traced where no histories are kept.
        true_product: v -> A v to measure the true residual with, in any wider dtype; histories are kept only
            with it.

    Source: Hestenes & Stiefel, J. Res. NBS 49, 409 (1952).
    """
    size2 = jnp.dot(b, b)
    limit2 = jnp.asarray(tol).astype(b.dtype) ** 2 * size2
    safe = jnp.where(size2 > 0, size2, 1)
    length = max_iter + 1 if true_product is not None else 0

    def relative(rr):
        return jnp.sqrt(rr / safe)

    def true_residual(x):
        assert true_product is not None
        wide = true_product(x)
        gap = b.astype(wide.dtype) - wide
        return jnp.sqrt(jnp.dot(gap, gap) / safe.astype(wide.dtype)).astype(b.dtype)

    def note(kept, i, x, rr):
        if not length:
            return kept
        return kept[0].at[i].set(relative(rr)), kept[1].at[i].set(true_residual(x))

    def body(carry):
        x, r, p, rr, i, kept = carry
        q = product(p)
        step = rr / jnp.dot(p, q)
        x, r = x + step * p, r - step * q
        new = jnp.dot(r, r)
        return x, r, r + (new / rr) * p, new, i + 1, note(kept, i + 1, x, new)

    blank = jnp.full(length, jnp.nan, b.dtype)
    zero = jnp.zeros_like(b)
    start = (zero, b, b, size2, jnp.zeros((), jnp.int32), note((blank, blank), 0, zero, size2))
    # the loop also ends at a NaN, which is not above anything
    x, _, _, rr, iterations, kept = lax.while_loop(
        lambda carry: (carry[3] > limit2) & (carry[4] < max_iter), body, start
    )
    reason = jnp.where(rr > limit2, Reason.CAP.value, Reason.TOLERANCE.value)
    finite = jnp.isfinite(rr) & jnp.all(jnp.isfinite(x))
    reason = jnp.where(finite, reason, Reason.NOT_FINITE.value).astype(jnp.int8)
    return Solution(x, iterations, relative(rr), reason, kept[0], kept[1])
