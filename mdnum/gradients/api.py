"""Gradients of rollouts in the shape that JAX gives to gradients, for training loops.

The run is made on the host, list by list, so that it is the run `mdnum run` makes; a transformation that
would trace it as one program (jit, vmap) cannot. Differentiating can: the rollout is a function with a
reverse rule of its own, and whatever is before or behind it is differentiated by JAX.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.problem import Gradient, Method, Problem
from mdnum.gradients.problem import method as by_name

#: Parameters by name, each of the shape of its value in the simulation.
Values = Mapping[str, Any]


def value_and_grad(
    problem: Problem, names: Sequence[str], method: Method | str = "event-aware", *, has_aux: bool = False
) -> Callable[[Values], tuple[Any, dict[str, np.ndarray]]]:
    """A function that gives the loss and its gradient, as `jax.value_and_grad` does.

    Args:
        problem: the loss of a rollout.
        names: parameters to differentiate by, full or short names.
        method: a method, or its name.
        has_aux: whether to return the whole `Gradient` too, as `(value, gradient)` does in JAX.

    Returns:
        values by name (any of the names; those not given stay as the system file has them) to
        (value, gradient by name), or to ((value, Gradient), gradient by name). The names are spelled as they
        were asked for, so that the gradient has the keys of the values.

    Raises:
        InputError: no such parameter or method, or it does not apply; the loss is not a scalar.

    Warns:
        UserWarning: a derivative that is exactly zero, with the reason.

    Error: that of the method.
    """
    method = by_name(method) if isinstance(method, str) else method
    full = method.check(problem, names)
    asked = {parameters.resolve(problem.simulation, [name])[0]: name for name in reversed(names)}

    def function(values: Values | None = None):
        found = method(problem.at(_in_full(problem, values or {}, full)), full)
        _warn(found)
        gradient = {asked[name]: found.gradient[name] for name in full}
        return ((found.value, found) if has_aux else found.value), gradient

    return function


def differentiable(
    problem: Problem,
    names: Sequence[str],
    method: Method | str = "event-aware",
    watch: Callable[[Gradient], None] | None = None,
) -> Callable[[Values], jax.Array]:
    """The loss as a function that JAX can differentiate in reverse mode.

    Parameters may be any pytree: put a function of your own before it, which makes the named values of it,
    and `jax.grad` goes through both.

    Args:
        problem: the loss of a rollout.
        names: parameters to differentiate by.
        method: a method, or its name.
        watch: called with the whole gradient each time that one is worked out.

    Returns:
        values by name to the loss, a float64 scalar. It runs outside of `jit` and `vmap`.

    Raises:
        InputError: no such parameter or method, or it does not apply.

    Error: that of the method.
    """
    method = by_name(method) if isinstance(method, str) else method
    full = method.check(problem, names)

    def at(values: Values) -> Problem:
        for leaf in jax.tree.leaves(values):
            if isinstance(leaf, Tracer):
                raise InputError(
                    "a rollout was called inside jit or vmap; its lists are made on the host",
                    remedy="Call it, and jax.grad of it, outside of jit and vmap",
                )
        return problem.at(_in_full(problem, values, full))

    @jax.custom_vjp
    def loss(values: Values) -> jax.Array:
        return jnp.asarray(at(values).value(), jnp.float64)

    def forward(values: Values):
        found = method(at(values), full)
        _warn(found)
        if watch is not None:
            watch(found)
        by_name = {}
        for name, value in values.items():
            derivative = found.gradient[parameters.resolve(problem.simulation, [name])[0]]
            by_name[name] = jnp.asarray(derivative).astype(jnp.result_type(value))
        return jnp.asarray(found.value, jnp.float64), by_name

    def backward(gradient, onto):
        return (jax.tree.map(lambda one: onto.astype(one.dtype) * one, gradient),)

    loss.defvjp(forward, backward)
    return loss


def _warn(found: Gradient) -> None:
    """Warn of a derivative that is exactly zero why it is: a training loop would not look at notes."""
    for name, value in found.gradient.items():
        if not np.any(np.asarray(value)):
            note = found.notes.get(name, "exactly 0 in this run")
            warnings.warn(f"{found.method} by {name}: {note}", UserWarning, stacklevel=3)


def _in_full(problem: Problem, values: Values, full: Sequence[str]) -> dict[str, np.ndarray]:
    """Values by full name.

    Raises:
        InputError: a name that is not differentiated by, or an integer in place of a number.
    """
    out = {}
    for word, value in values.items():
        (name,) = parameters.resolve(problem.simulation, [word])
        if name not in full:
            raise InputError(
                f"a value for {word}, which the gradient was not asked for",
                remedy=f"Name it among the parameters; they are {', '.join(full)}",
            )
        out[name] = np.asarray(value, np.float64)
    return out
