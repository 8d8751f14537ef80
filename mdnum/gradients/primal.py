"""Where the program that was differentiated departs from the run: first in its bits, then in its decisions.

Reverse mode needs another forward pass than a run does, and a compiler is free to round it otherwise. Then a
gradient belongs to a trajectory that nobody simulated. Each step's state and each step's decisions leave a
fingerprint here that does not depend on the order of atoms or of lists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt8, UInt64

from mdnum.gradients.tape import Stretch
from mdnum.md.decide import Tables

_UNSIGNED = {8: jnp.uint64, 4: jnp.uint32, 2: jnp.uint16}


@dataclass(frozen=True)
class Departure:
    """What a comparison of two programs of one rollout found.

    Attributes:
        steps: last step that was compared.
        state: first step whose positions or velocities differ in a bit; None if no step does.
        decision: first step at which another set of pairs is inside; None if no step has one.
    """

    steps: int
    state: int | None
    decision: int | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {"steps compared": self.steps, "first state": self.state, "first decision": self.decision}

    def __str__(self) -> str:
        if self.state is None:
            return f"it has the bits of the run at every step up to {self.steps}"
        decided = "with the run's decisions throughout"
        if self.decision is not None:
            decided = f"and from step {self.decision} on with other decisions"
        return f"from step {self.state} on it is another trajectory than the run's, {decided}"


class Fingerprints:
    """Of the states and decisions of one program, step by step.

    Args:
        steps: last step.
    """

    def __init__(self, steps: int):
        self.state = np.zeros(steps + 1, np.uint64)
        self.decision = np.zeros(steps + 1, np.uint64)
        self.known = np.zeros(steps + 1, bool)

    def add(self, first: int, rows: int, x, v, bits, tables: Tables) -> None:
        """Some steps with one list.

        Args:
            first, rows: first step and how many are used of those given.
            x, v: in the order of the list, shape (room, 3, atoms). bits: packed decisions.
        """
        state, decision = _of_rows(jnp.asarray(x), jnp.asarray(v), jnp.asarray(bits), tables)
        here = slice(first, first + rows)
        self.state[here] = np.asarray(state)[:rows]
        self.decision[here] = np.asarray(decision)[:rows]
        self.known[here] = True

    def add_stretch(self, stretch: Stretch, tables: Tables) -> None:
        """A stretch of a recorded run."""
        self.add(stretch.first, stretch.rows, stretch.x, stretch.v, stretch.bits, tables)

    def departure(self, other: Fingerprints) -> Departure:
        """Where another program's fingerprints differ."""
        both = self.known & other.known
        return Departure(
            int(np.flatnonzero(both)[-1]) if both.any() else -1,
            _first(both & (self.state != other.state)),
            _first(both & (self.decision != other.decision)),
        )


def _first(different: np.ndarray) -> int | None:
    return int(np.argmax(different)) if different.any() else None


@jax.jit
def _of_rows(
    x: Float[Array, "rows 3 atoms"],
    v: Float[Array, "rows 3 atoms"],
    bits: UInt8[Array, "rows words atoms"],
    tables: Tables,
) -> tuple[UInt64[Array, "rows"], UInt64[Array, "rows"]]:
    atoms = x.shape[-1]
    order = tables.order.astype(jnp.uint64)
    ends = jnp.append(order, jnp.zeros((), jnp.uint64))[tables.index]
    pairs = _mixed(order * jnp.uint64(atoms) + ends)
    places = jnp.arange(6, dtype=jnp.uint64)[:, None] * jnp.uint64(atoms) + order
    shifts = jnp.arange(8, dtype=jnp.uint8)[:, None]

    def one(row):
        x, v, bits = row
        words = lax.bitcast_convert_type(jnp.concatenate([x, v]), _UNSIGNED[x.dtype.itemsize])
        state = jnp.sum(_mixed(_mixed(words.astype(jnp.uint64)) + places))
        inside = (bits[:, None, :] >> shifts) & jnp.uint8(1) == 1
        return state, jnp.sum(jnp.where(inside, pairs, jnp.zeros((), jnp.uint64)))

    return lax.map(one, (x, v, bits))


def _mixed(words: UInt64[Array, "..."] | Int[Array, "..."]) -> UInt64[Array, "..."]:
    """Every bit of the result depends on every bit of the word (splitmix64; Steele, Lea & Flood 2014)."""
    z = words + jnp.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> jnp.uint64(30))) * jnp.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> jnp.uint64(27))) * jnp.uint64(0x94D049BB133111EB)
    return z ^ (z >> jnp.uint64(31))


@dataclass(frozen=True)
class ScanDeparture:
    """A loop as it runs, and as it runs inside `jax.value_and_grad`.

    Attributes:
        first: first step after which a bit differs; None if none does.
        separation: largest difference of a number after each step, shape (steps,).
        value, inside: the loss by either program.
    """

    first: int | None
    separation: Float[np.ndarray, "steps"]
    value: float
    inside: float


def of_scan(
    step: Callable[[Any, Any], Any], parameters: Any, state: Any, steps: int, loss: Callable[[Any], Array]
) -> ScanDeparture:
    """Where a loop of anybody's, differentiated by JAX, departs from the same loop that is only run.

    Both are compiled whole, as `jax.jit` of a `jax.lax.scan` and of `jax.value_and_grad` of it. All that
    reverse mode keeps of all steps must fit into memory.

    Args:
        step: (parameters, state) to the next state, a pytree of arrays.
        parameters: what is differentiated by.
        state: where it starts.
        steps: how many steps.
        loss: last state to a scalar.
    """

    def run(parameters):
        def one(state, _):
            state = step(parameters, state)
            return state, [leaf for leaf in jax.tree.leaves(state) if jnp.issubdtype(leaf.dtype, jnp.inexact)]

        last, all_states = lax.scan(one, state, None, length=steps)
        return loss(last), all_states

    value, plain = jax.jit(run)(parameters)
    (inside, other), _ = jax.jit(jax.value_and_grad(run, has_aux=True))(parameters)
    apart = np.zeros(steps)
    differs = np.zeros(steps, bool)
    for a, b in zip(plain, other, strict=True):
        a, b = (np.asarray(leaf).reshape(steps, -1) for leaf in (a, b))
        differs |= (a != b).any(axis=1)
        apart = np.maximum(apart, np.abs(a.astype(np.float64) - b).max(axis=1, initial=0.0))
    first = _first(differs)
    return ScanDeparture(None if first is None else first + 1, apart, float(value), float(inside))
