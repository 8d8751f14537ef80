"""Iterative solvers: the loop, its stopping rules, and its derivatives.

A stopping rule compares a quantity, computed from the residual of each ball, with a threshold. A sum over all
balls couples independent balls. The last bits of the sum depend on the order of summation. A separate
stopping rule for each ball involves no sum over balls.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from mdnum.numerics.events import Threshold
from mdnum.numerics.roles import RolePrecision
from mdnum.numerics.sums import Pairwise, Reduction

#: function(inputs, rest) -> (outputs, record); inputs and outputs are tuples of arrays of shape (balls,).
Map = Callable[[tuple, Any], tuple[tuple, Any]]


class Reason(IntEnum):
    """Reason why the iterative solver of a time step ended."""

    NONE = 0
    TOLERANCE = 1
    CAP = 2
    FIXED = 3
    NOT_FINITE = 4
    REST = 5

    @property
    def word(self) -> str:
        """Name under which the reason for stopping is displayed."""
        return self.name.lower().replace("_", " ")


class Solve(NamedTuple):
    """Record of one call of an iterative solver. Arrays have one entry per ball if balls stop separately."""

    iterations: Int[Array, "..."]  # how often it went on
    reason: Int[Array, "..."]  # a `Reason`
    residual: Float[Array, "..."]  # the residual at the last decision
    # threshold minus residual there: positive where the residual was low enough to stop
    margin: Float[Array, "..."]
    # the margin of the decision before, which was to go on; -inf where there was none
    before: Float[Array, "..."]
    # residual at every decision, NaN where none was made, shape (max_iter + 1,), or (0,) unless it was asked
    # for; the largest over the balls where each ball has its own
    history: Float[Array, "decisions"]


class StopRule(Protocol):
    """Base class of the stopping rules."""

    max_iter: int  # the cap: the solver gives up after so many iterations

    def measure(
        self, terms: Float[Array, "balls"], accumulate: Any, decision: Any, zero: Int[Array, ""]
    ) -> Float[Array, "..."]:
        """Compute the residual: a sum in the dtype `accumulate`, rounded to the dtype `decision`."""
        ...

    def threshold(self, first: Float[Array, "..."], iteration: Int[Array, "..."]) -> Float[Array, "..."]:
        """Return the threshold of an iteration. `first` is the initial residual."""
        ...


def stops(threshold: Float[Array, "..."], residual: Float[Array, "..."]) -> Bool[Array, "..."]:
    """Return True if the solver stops, which requires residual < threshold."""
    return Threshold(threshold, "<", "residual").decide(residual)


class _ToleranceRule(eqx.Module):
    """Base class of the stopping rules with one tolerance."""

    tol: Any  # the solver stops when the residual is below; the unit of the residual
    max_iter: int = eqx.field(static=True, default=100)  # the cap

    def threshold(self, first, iteration):
        return jnp.broadcast_to(jnp.asarray(self.tol).astype(first.dtype), first.shape)


class GlobalSum(_ToleranceRule):
    """Stopping rule that compares the sum of all residuals with a tolerance."""

    reduction: Reduction = eqx.field(static=True, default=Pairwise())

    def measure(self, terms, accumulate, decision, zero):
        return self.reduction(terms.astype(accumulate), zero).astype(decision)


class PerInstance(_ToleranceRule):
    """Stopping rule that compares the residual of each ball separately with a tolerance."""

    def measure(self, terms, accumulate, decision, zero):
        return terms.astype(decision)


class Maximum(_ToleranceRule):
    """Stopping rule that compares the largest residual of all balls with a tolerance."""

    def measure(self, terms, accumulate, decision, zero):
        return jnp.max(terms).astype(decision)


class Relative(GlobalSum):
    """Stopping rule that compares the sum of residuals with tol times the initial sum."""

    def threshold(self, first, iteration):
        """Return tol times the initial residual. For a residual of 0, return the smallest normal number."""
        scaled = jnp.asarray(self.tol).astype(first.dtype) * first
        # float32's smallest would be 0 in float16, and no residual is below that
        least = jnp.finfo(first.dtype).tiny
        return jnp.where(first == 0, jnp.asarray(least, first.dtype), scaled)


class HysteresisStop(eqx.Module):
    """Hysteresis: the solver starts above the threshold `enter`, and stops below a lower threshold."""

    rule: _ToleranceRule  # says what the residual is, and where a solver that has started stops
    enter: Any  # a residual below this starts no solve; at least the rule's tolerance

    @property
    def max_iter(self) -> int:
        """Largest number of iterations that the rule permits."""
        return self.rule.max_iter

    def measure(self, terms, accumulate, decision, zero):
        return self.rule.measure(terms, accumulate, decision, zero)  # type: ignore[attr-defined]

    def threshold(self, first, iteration):
        """Return `enter` before the first iteration, and then the threshold for stopping."""
        enter = jnp.asarray(self.enter).astype(first.dtype)
        return jnp.where(iteration == 0, enter, self.rule.threshold(first, iteration))


class FixedCount(eqx.Module):
    """Stopping rule with a fixed number of iterations."""

    count: int = eqx.field(static=True, default=10)  # iterations; also the cap

    @property
    def max_iter(self) -> int:
        """Fixed number of iterations."""
        return self.count

    # for the record only
    measure = Maximum.measure

    def threshold(self, first, iteration):
        """Return a threshold that stops the solver after the fixed number of iterations."""
        reached = jnp.broadcast_to(iteration >= self.count, first.shape)
        return jnp.where(reached, np.inf, -np.inf).astype(first.dtype)


def iterate(
    rule: StopRule,
    start: Any,
    update: Callable[[Any], Any],
    terms: Callable[[Any], Float[Array, "balls"]],
    policy: RolePrecision,
    zero: Int[Array, ""],
    *,
    imposed: Int[Array, "..."] | None = None,
    history: bool = False,
) -> tuple[Any, Solve]:
    """Iterate until the rule stops the solver, or until the maximum or imposed iteration number.

    Args:
        rule: stopping rule.
        start: initial value, a pytree of arrays of shape (balls,).
        update: function that makes one iteration.
        terms: function that returns the terms of the residual, one per ball.
        policy: dtypes of sums and decisions.
        zero: zero for fenced sums, unknown to the compiler.
        imposed: number of iterations to make instead of applying the rule; the rule is applied if negative.
        history: whether to keep the residual of every decision.

    Returns:
        the final value of the iteration, and the record of the solve.
    """
    accumulate, decision = policy.dtype("accumulate"), policy.dtype("decision")

    def measure(x):
        return lax.stop_gradient(rule.measure(terms(x), accumulate, decision, zero))

    def goes_on(stopped, iterations):
        own = ~stopped & (iterations < rule.max_iter)
        return own if imposed is None else jnp.where(imposed < 0, own, iterations < imposed)

    def note(kept, iterations, residual):
        if not history:
            return kept
        # with a count per ball the loop has made as many rounds as its busiest ball has iterations
        return kept.at[jnp.max(iterations)].set(jnp.max(residual))

    first = measure(start)
    if imposed is not None:
        # one rule for the batch may be given a count for each ball
        first = jnp.broadcast_to(first, jnp.broadcast_shapes(first.shape, imposed.shape))
    none = jnp.zeros(first.shape, jnp.int32)
    threshold = rule.threshold(first, none)
    kept = jnp.full(rule.max_iter + 1 if history else 0, jnp.nan, decision)

    def body(carry):
        x, iterations, residual, margin, before, stopped, kept = carry
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
            jnp.where(on, margin, before),
            jnp.where(on, stops(threshold, now), stopped),
            note(kept, iterations, now),
        )

    before = jnp.full(first.shape, -jnp.inf, decision)
    carry = (start, none, first, threshold - first, before, stops(threshold, first), note(kept, none, first))
    x, iterations, residual, margin, before, stopped, kept = lax.while_loop(
        lambda carry: jnp.any(goes_on(carry[5], carry[1])), body, carry
    )
    met = Reason.FIXED if isinstance(rule, FixedCount) else Reason.TOLERANCE
    reason = jnp.where(stopped, met.value, Reason.CAP.value)
    reason = jnp.where(jnp.isfinite(residual), reason, Reason.NOT_FINITE.value).astype(jnp.int8)
    return x, Solve(iterations, reason, residual, margin, before, kept)


def no_solve(dtype: Any) -> Solve:
    """Create the record of a time step that needs no iterative solver."""
    none, nan = jnp.zeros((), jnp.int32), jnp.asarray(jnp.nan, dtype)
    return Solve(none, jnp.asarray(Reason.NONE.value, jnp.int8), nan, nan, nan, jnp.zeros(0, dtype))


def elementwise(function: Map) -> Map:
    """Return a differentiable version of a function with a `while_loop`.

    JAX has no reverse mode for a `while_loop`, since its memory is not known in advance. If a function treats
    balls separately, its Jacobian is diagonal. Forward mode can compute this Jacobian. Forward mode runs in
    the same loop, so iterations need not be stored. Decisions are held fixed in the derivative. The record of
    the solve and the inputs in `rest` are not differentiated.

    Args:
        function: a function whose outputs for ball b depend only on the inputs for ball b (and on `rest`).

    Returns:
        the same function, differentiable in forward and reverse mode.

        Error: tangents are propagated in the dtype of the inputs, with one rounding error per operation.
    """

    @jax.custom_jvp
    def apply(inputs, rest):
        return function(inputs, rest)

    def rule(primals, tangents):
        inputs, rest = primals
        # an input that nothing differentiated depends on needs no tangent of its own in the loop
        moving = [k for k, rate in enumerate(tangents[0]) if not isinstance(rate, SymbolicZero)]

        def outputs(*given):
            every = list(inputs)
            for k, value in zip(moving, given, strict=True):
                every[k] = value
            return function(tuple(every), rest)

        varied = tuple(inputs[k] for k in moving)
        if not moving:
            made, record = outputs()
            return (made, record), (jax.tree.map(jnp.zeros_like, made), jax.tree.map(_no_tangent, record))
        basis = tuple(
            jnp.stack([jnp.full_like(x, row == column) for row in range(len(moving))])
            for column, x in enumerate(varied)
        )

        def along(direction):
            return jax.jvp(outputs, varied, direction, has_aux=True)

        made, jacobian, record = jax.vmap(along, out_axes=(None, 0, None))(basis)
        slopes = [tangents[0][k] for k in moving]
        rates = tuple(
            sum((rows[k] * slopes[k] for k in range(1, len(moving))), rows[0] * slopes[0])
            for rows in jacobian
        )
        return (made, record), (rates, jax.tree.map(_no_tangent, record))

    apply.defjvp(rule, symbolic_zeros=True)
    return apply


def _no_tangent(leaf: Any) -> Any:
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        return jnp.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)
