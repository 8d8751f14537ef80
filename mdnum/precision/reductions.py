"""The order in which a sum over neighbors is made, as an object.

A reduction receives blocks of terms (leading axis: the slots of the block) and keeps what it needs in
a carry, so that the terms of a whole neighbor list never exist at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp


class Reduction(Protocol):
    """Order of a sum over slots that arrive in blocks."""

    def within(self, total: jax.Array, terms: Sequence[jax.Array]) -> tuple[jax.Array, jax.Array | None]:
        """Take one block; returns the carried total and, if it is to be summed later, the block's own sum."""
        ...

    def finish(self, total: jax.Array, blocks: jax.Array | None) -> jax.Array:
        """The sum, from the carried total and the stacked block sums (leading axis: blocks)."""
        ...


@dataclass(frozen=True)
class Sequential:
    """Slot after slot, left to right. Error: at most gamma_{n-1} * sum |terms| (Higham 2002, 4.4)."""

    def within(self, total, terms):
        for term in terms:
            total = total + term
        return total, None

    def finish(self, total, blocks):
        return total


def _tree(terms: list[jax.Array]) -> jax.Array:
    while len(terms) > 1:
        pairs = [terms[k] + terms[k + 1] for k in range(0, len(terms) - 1, 2)]
        terms = pairs + terms[len(terms) - len(terms) % 2 :]
    return terms[0]


@dataclass(frozen=True)
class Pairwise:
    """A balanced tree over the slots. Error: at most gamma_{log2 n} * sum |terms| (Higham 2002, 4.6)."""

    def within(self, total, terms):
        return total, _tree(list(terms))

    def finish(self, total, blocks):
        return _tree(list(jnp.asarray(blocks)))


BY_NAME: dict[str, Reduction] = {"sequential": Sequential(), "pairwise": Pairwise()}
