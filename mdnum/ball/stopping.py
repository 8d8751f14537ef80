"""When an iterative solver stops: rules as objects, each a threshold on a residual.

A rule turns the terms of a residual (one per ball) into the quantity that is compared. A sum over the batch
couples balls that have nothing to do with one another, and its last bits depend on the order of summation;
a rule per ball does neither.
"""

from __future__ import annotations

from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mdnum.events import Threshold
from mdnum.precision.reductions import Pairwise, Reduction

#: Recorded for a rule that compares nothing.
_NO_THRESHOLD = np.inf


class StopRule(Protocol):
    """The contract of a stopping rule.

    Attributes:
        max_iter: the cap: the solver gives up after so many iterations.
    """

    max_iter: int

    def measure(
        self, terms: Float[Array, "balls"], accumulate: Any, decision: Any, zero: Int[Array, ""]
    ) -> Float[Array, "..."]:
        """The residual in the dtype of decisions, from terms summed in the dtype of sums."""
        ...

    def threshold(self, first: Float[Array, "..."], iteration: Int[Array, "..."]) -> Float[Array, "..."]:
        """What the residual is compared with at an iteration, given the residual of the first decision."""
        ...


def stops(threshold: Float[Array, "..."], residual: Float[Array, "..."]) -> Bool[Array, "..."]:
    """The stopping decision: yes when residual < threshold."""
    return Threshold(threshold, "<", "residual").decide(residual)


class _Tolerance(eqx.Module):
    """A rule with one tolerance.

    Attributes:
        tol: the solver stops when the residual is below; the unit of the residual.
        max_iter: the cap.
    """

    tol: Any
    max_iter: int = eqx.field(static=True, default=100)

    def threshold(self, first, iteration):
        """The tolerance in the residual's dtype."""
        return jnp.broadcast_to(jnp.asarray(self.tol).astype(first.dtype), first.shape)


class GlobalSum(_Tolerance):
    """One residual for the batch: the sum of all terms, in the order that a reduction says."""

    reduction: Reduction = eqx.field(static=True, default=Pairwise())

    def measure(self, terms, accumulate, decision, zero):
        """The sum in the dtype of sums."""
        return self.reduction(terms.astype(accumulate), zero).astype(decision)


class PerInstance(_Tolerance):
    """A residual for each ball: a ball stops when its own is low enough, whatever the others do."""

    def measure(self, terms, accumulate, decision, zero):
        """Each ball's own term."""
        return terms.astype(decision)


class Maximum(_Tolerance):
    """One residual for the batch: the largest term. No sum, so no order of summation."""

    def measure(self, terms, accumulate, decision, zero):
        """The largest term."""
        return jnp.max(terms).astype(decision)


class Relative(GlobalSum):
    """The sum, compared with the tolerance times the sum before the first iteration."""

    def threshold(self, first, iteration):
        """tol times the first residual; a residual that starts at zero is below any tolerance."""
        scaled = jnp.asarray(self.tol).astype(first.dtype) * first
        # float32's smallest would be 0 in float16, and no residual is below that
        least = jnp.finfo(first.dtype).tiny
        return jnp.where(first == 0, jnp.asarray(least, first.dtype), scaled)


class Hysteresis(eqx.Module):
    """A rule with a gap: the solver starts only above one threshold, and then runs to below another.

    Attributes:
        rule: says what the residual is, and where a solver that has started stops.
        enter: a residual below this starts no solve; at least the rule's tolerance.
    """

    rule: _Tolerance
    enter: Any

    @property
    def max_iter(self) -> int:
        """The rule's cap."""
        return self.rule.max_iter

    def measure(self, terms, accumulate, decision, zero):
        """As the rule inside."""
        return self.rule.measure(terms, accumulate, decision, zero)  # type: ignore[attr-defined]

    def threshold(self, first, iteration):
        """The higher one before the first iteration, the rule's afterwards."""
        enter = jnp.asarray(self.enter).astype(first.dtype)
        return jnp.where(iteration == 0, enter, self.rule.threshold(first, iteration))


class Fixed(eqx.Module):
    """So many iterations, whatever the residual: no decision, and no decision that could flip.

    Attributes:
        count: iterations; also the cap.
    """

    count: int = eqx.field(static=True, default=10)

    @property
    def max_iter(self) -> int:
        """The count."""
        return self.count

    def measure(self, terms, accumulate, decision, zero):
        """The largest term, for the record only."""
        return jnp.max(terms).astype(decision)

    def threshold(self, first, iteration):
        """Stops when the count is reached, and not before."""
        reached = jnp.broadcast_to(iteration >= self.count, first.shape)
        return jnp.where(reached, _NO_THRESHOLD, -_NO_THRESHOLD).astype(first.dtype)
