"""Compensated sums: the rounding error of every addition is computed exactly and carried along."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from mdnum.precision.orders import Add, Whole
from mdnum.precision.ulp import unit_roundoff


def _start(terms: jax.Array) -> tuple[jax.Array, jax.Array]:
    zeros = jnp.zeros(terms.shape[1:], terms.dtype)
    return zeros, zeros


class _Compensated(Whole):
    def bound(self, terms: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "..."]:
        """(2u + 8(n u)²) * sum |terms|: independent of n until n is near 1/u (Higham 2002, 4.3)."""
        u, n = unit_roundoff(terms.dtype), len(terms)
        factor = 2 * u + 8 * (n * u) ** 2 if n * u < 0.1 else np.inf
        return np.asarray(factor * np.abs(terms.astype(np.float64)).sum(axis=0))


@dataclass(frozen=True)
class Kahan(_Compensated):
    """A loop that subtracts from the next term what the last addition lost (Kahan, CACM 8, 40 (1965)).

    Error: at most (2u + O(n u²)) * sum |terms|; a term much larger than the sum so far defeats it.
    """

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Four additions per term."""

        def step(carry, term):
            total, lost = carry
            addend = add(term, -lost)
            new = add(total, addend)
            return (new, add(add(new, -total), -addend)), None

        (total, _), _ = lax.scan(step, _start(terms), terms, unroll=min(4, terms.shape[0]))
        return total


@dataclass(frozen=True)
class Neumaier(_Compensated):
    """Kahan's sum for terms of any size: the losses are summed apart and added at the end.

    Error: at most u |sum| + O(n² u²) * sum |terms|. Source: Neumaier, ZAMM 54, 39 (1974).
    """

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Four additions per term and one at the end."""

        def step(carry, term):
            total, lost = carry
            new = add(total, term)
            larger = jnp.abs(total) >= jnp.abs(term)
            big, small = jnp.where(larger, total, term), jnp.where(larger, term, total)
            return (new, add(lost, add(add(big, -new), small))), None

        (total, lost), _ = lax.scan(step, _start(terms), terms, unroll=min(4, terms.shape[0]))
        return add(total, lost)
