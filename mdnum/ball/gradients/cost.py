"""What a derivative costs in memory and what a linear solve costs in accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.ball.gradients.implicit import FixedPoint, fixed_point_tangent
from mdnum.ball.stopping import elementwise


@dataclass(frozen=True)
class Memory:
    """Bytes of temporaries of a compiled gradient through a projection of so many iterations.

    Attributes:
        iterations: of the projection.
        unrolled: reverse mode over the iterations, which keeps something of each.
        carried: tangents carried along in the loop, as mdnum's own unrolled derivative does it (possible
            because each ball's result depends on that ball only).
        implicit: a linear solve at the fixed point.
        value: the loss alone.
    """

    iterations: int
    unrolled: int
    carried: int
    implicit: int
    value: int


def memory(iterations: Sequence[int], balls: int = 1000) -> list[Memory]:
    """Temporaries of value and gradient by gain and start, as the compiler plans them (nothing is run).

    Args:
        iterations: counts to compile for.
        balls: in the batch, float64.
    """
    rows = []
    for count in iterations:
        sizes = [
            _temporaries(jax.value_and_grad(how, argnums=(0, 1)), balls, count)
            for how in (unrolled, carried, implicit)
        ]
        rows.append(Memory(count, sizes[0], sizes[1], sizes[2], _temporaries(carried, balls, count)))
    return rows


def _temporaries(function, balls: int, count: int) -> int:
    gain = jax.ShapeDtypeStruct((), jnp.float64)
    y = jax.ShapeDtypeStruct((balls,), jnp.float64)
    compiled = jax.jit(lambda gain, y: function(gain, y, count)).lower(gain, y).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    return int(analysis.temp_size_in_bytes)


def _once(gain, y):
    return y + gain * jnp.maximum(-y, 0.0)


def unrolled(gain: Float[Array, ""], y: Float[Array, "balls"], count: int) -> Float[Array, ""]:
    """Mean square of what a projection leaves, by a scan that reverse mode tapes."""
    y, _ = jax.lax.scan(lambda y, _: (_once(gain, y), None), y, None, length=count)
    return jnp.mean(y**2)


def carried(gain: Float[Array, ""], y: Float[Array, "balls"], count: int) -> Float[Array, ""]:
    """The same, with tangents carried along in the loop."""

    def run(inputs, rest):
        y, gain = inputs
        return (jax.lax.fori_loop(0, count, lambda _, y: _once(gain, y), y),), ()

    (y,), _ = elementwise(run)((y, jnp.broadcast_to(gain, y.shape)), ())
    return jnp.mean(y**2)


def implicit(gain: Float[Array, ""], y: Float[Array, "balls"], count: int) -> Float[Array, ""]:
    """The same iterations with the derivative of their fixed point."""
    contact = y < 0
    ended = jax.lax.stop_gradient(_loop(gain, y, count))
    y = FixedPoint().attach(jnp.where(contact, ended, y), jnp.broadcast_to(gain, y.shape), contact)
    return jnp.mean(y**2)


def _loop(gain, y, count):
    gain, y = jax.lax.stop_gradient((gain, y))
    return jax.lax.fori_loop(0, count, lambda _, y: _once(gain, y), y)


@dataclass(frozen=True)
class Accuracy:
    """A derivative of a fixed point whose linear system is stopped early.

    Attributes:
        tolerance: of the linear solve.
        regularization: added to the diagonal.
        error: of the derivative, relative to the exact one.
    """

    tolerance: float
    regularization: float
    error: float


def accuracy(
    tolerances: Sequence[float],
    regularizations: Sequence[float] = (0.0,),
    *,
    condition: float = 1e4,
    unknowns: int = 200,
    seed: int = 0,
) -> list[Accuracy]:
    """How the tolerance and the regularization of the backward solve enter a derivative.

    The fixed point is x = x - A (x - p c), with A symmetric, its eigenvalues spread evenly in the logarithm
    from 1 / condition to 1: x = p c, dx/dp = c, whatever A is. What the solve leaves is all the error.

    Args:
        tolerances, regularizations: every pair is tried.
        condition: largest over smallest eigenvalue of A.
    """
    random = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(random.normal(size=(unknowns, unknowns)))
    matrix = jnp.asarray(basis * np.geomspace(1 / condition, 1.0, unknowns) @ basis.T)
    direction = jnp.asarray(random.normal(size=unknowns))
    rows = []
    for regularization in regularizations:
        for tolerance in tolerances:
            options = jnp.asarray(tolerance), jnp.asarray(regularization)
            found = np.asarray(_tangent(matrix, direction, *options))
            error = np.linalg.norm(found - np.asarray(direction)) / np.linalg.norm(direction)
            rows.append(Accuracy(tolerance, regularization, float(error)))
    return rows


@eqx.filter_jit
def _tangent(matrix, direction, tolerance, regularization):
    def update(x, p):
        return x - matrix @ (x - p * direction)

    one = (jnp.ones(()),)
    options = {"tolerance": tolerance, "regularization": regularization, "max_iter": 10_000}
    return fixed_point_tangent(update, direction, one, one, **options)
