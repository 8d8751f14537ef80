"""Loss scaling: a gradient that would fall below the smallest float16 is computed larger and divided after.

The scale is the cotangent with which the backward pass starts, so the loss itself is not multiplied and
cannot overflow. Unscaling happens in float64: a power of two, exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from mdnum.errors import InputError, NumericalError


class ScaledGradient(NamedTuple):
    """A loss with its gradient.

    Attributes:
        value: the loss, in its own dtype.
        gradient: as the differentiated argument, leaves in float64.
        finite: whether every number of the gradient is finite.
        scale: the factor that was used.
    """

    value: Float[Array, ""]
    gradient: PyTree
    finite: Bool[Array, ""]
    scale: Float[Array, ""]


def _scaled(function: Callable[..., Any], scale: Float[Array, ""], args: tuple) -> ScaledGradient:
    value, pullback = jax.vjp(lambda first: function(first, *args[1:]), args[0])
    (gradient,) = pullback(scale.astype(value.dtype))
    gradient = jax.tree.map(lambda g: g.astype(jnp.float64) / jnp.broadcast_to(scale, g.shape), gradient)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(gradient)]))
    return ScaledGradient(value, gradient, finite, scale)


def _power_of_two(scale: float, what: str) -> None:
    if not (scale > 0 and scale < float("inf") and float(scale).hex().split("p")[0].rstrip("0") in ("0x1.",)):
        raise InputError(f"{what} {scale:g} is not a power of two", remedy="Give one; then scaling is exact.")


@dataclass(frozen=True)
class StaticScale:
    """One factor for all gradients.

    Attributes:
        scale: a power of two; too small and gradients vanish, too large and they overflow.
    """

    scale: float = 2.0**15

    def __post_init__(self):
        _power_of_two(self.scale, "scale")

    def value_and_grad(self, function: Callable[..., Any], *args: Any) -> ScaledGradient:
        """The loss `function(*args)` and its gradient by the first argument."""
        return _scaled(function, jnp.asarray(self.scale, jnp.float64), args)


class ScaleState(NamedTuple):
    """Where a dynamic scale stands.

    Attributes:
        scale: the factor of the next gradient.
        good: finite gradients since the last change.
        skipped: gradients that were not finite, so far.
    """

    scale: Float[Array, ""]
    good: Int[Array, ""]
    skipped: Int[Array, ""]


@dataclass(frozen=True)
class DynamicScale:
    """A factor that follows the gradients: halved when one is not finite, doubled after a run of finite ones.

    Source: Micikevicius et al., Mixed precision training, ICLR 2018, section 3.2.

    Attributes:
        initial: the first factor.
        interval: finite gradients in a row before it is doubled.
        smallest, largest: it stays between these.
    """

    initial: float = 2.0**15
    interval: int = 2000
    smallest: float = 1.0
    largest: float = 2.0**24

    def __post_init__(self):
        for what in ("initial", "smallest", "largest"):
            _power_of_two(getattr(self, what), what)
        if not self.smallest <= self.initial <= self.largest:
            raise InputError(f"a scale of {self.initial:g} outside {self.smallest:g} ... {self.largest:g}")
        if self.interval < 1:
            raise InputError(f"an interval of {self.interval} gradients", remedy="Give 1 or more.")

    def start(self) -> ScaleState:
        """Before the first gradient."""
        return ScaleState(
            jnp.asarray(self.initial, jnp.float64), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
        )

    def value_and_grad(
        self, state: ScaleState, function: Callable[..., Any], *args: Any
    ) -> tuple[ScaledGradient, ScaleState]:
        """The loss, its gradient and the next state; skip the step where it is not `finite`."""
        result = _scaled(function, state.scale, args)
        good = jnp.where(result.finite, state.good + 1, 0)
        grow = good >= self.interval
        scale = jnp.where(result.finite, jnp.where(grow, state.scale * 2, state.scale), state.scale / 2)
        scale = jnp.clip(scale, self.smallest, self.largest)
        skipped = state.skipped + (~result.finite).astype(jnp.int32)
        return result, ScaleState(scale, jnp.where(grow, 0, good).astype(jnp.int32), skipped)

    def settle(self, function: Callable[..., Any], *args: Any) -> tuple[ScaledGradient, ScaleState]:
        """One gradient, on the host: the factor is doubled while all is finite, or halved until it is.

        Raises:
            NumericalError: not finite even with the smallest factor.
        """
        # arguments and not constants: what a compiler knows it folds, fences with it
        compiled = eqx.filter_jit(lambda scale, args: _scaled(function, scale, args))
        scale, best = self.initial, None
        skipped = 0
        while self.smallest <= scale <= self.largest:
            result = compiled(jnp.asarray(scale, jnp.float64), args)
            if bool(result.finite):
                if skipped or scale == self.largest:
                    best = result
                    break
                best, scale = result, scale * 2
            else:
                skipped += 1
                if best is not None:
                    break
                scale /= 2
        if best is None:
            raise NumericalError(
                f"the gradient is not finite even with a scale of {self.smallest:g}",
                remedy="Compute the loss in a wider dtype.",
            )
        used = jnp.asarray(best.scale, jnp.float64)
        return best, ScaleState(used, jnp.ones((), jnp.int32), jnp.asarray(skipped, jnp.int32))
