"""Gradients in the form that JAX functions return, for training loops.

The host builds neighbor lists during the simulation. Transformations of the whole simulation (jit, vmap) are
therefore not supported.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from mdnum.errors import InputError, NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.problem import Gradient, Method, Problem, Values, method


def value_and_grad(
    problem: Problem, names: Sequence[str], method: Method | str = "event-aware", *, has_aux: bool = False
) -> Callable[[Values], tuple[Any, dict[str, np.ndarray]]]:
    """Return a function that computes the loss and its gradient, like `jax.value_and_grad`.

    Example:
        >>> f = mdnum.value_and_grad(problem, ["sigma"])
        >>> value, slopes = f({"sigma": 1.01})

    Args:
        names: full or short names of the parameters to differentiate by. method: a method, or its name.
        has_aux: whether to return the `Gradient` object too, as ((value, gradient), gradient by name).

    Returns:
        a function from values by name (parameters without a value keep that of the system file) to (value,
        gradient by name), with names as given. For a complex loss z both are complex; the derivative by a
        real parameter p is dz/dp = d Re z/dp + i d Im z/dp, without a conjugate: d|z|² = 2 Re(conj(z) dz),
        d arg z = Im(dz/z). This is no direction of descent; `mdnum grad` and `trust` take real losses only.

    Raises:
        InputError: a parameter or method does not exist, the method does not apply, or a value is not real.

    Warns:
        UserWarning: a derivative is exactly zero; the warning gives the reason.
    """
    chosen, full = _chosen(problem, names, method)
    # a word for several parameters is none of them
    spelled = {word: parameters.resolve(problem.simulation, [word]) for word in reversed(names)}
    asked = {name: name for name in full} | {one[0]: word for word, one in spelled.items() if len(one) == 1}

    def function(values: Values | None = None):
        found = _differentiated(chosen, problem.at(_in_full(problem, values or {}, full)), full)
        gradient = {asked[name]: found.gradient[name] for name in full}
        return ((found.value, found) if has_aux else found.value), gradient

    return function


def differentiable(
    problem: Problem,
    names: Sequence[str],
    method: Method | str = "event-aware",
    watch: Callable[[Gradient], None] | None = None,
) -> Callable[[Values], jax.Array]:
    """Return the loss as a function that JAX can differentiate in reverse mode.

    For other variables, such as a pytree, write a function that computes the named values from these
    variables. Apply `jax.grad` to the composition.

    Args:
        problem, names, method: as for `value_and_grad`, which also lists errors and warnings.
        watch: called with the `Gradient` object each time that a gradient is computed.

    Returns:
        a function from values by name to the scalar loss; apply a real function such as jnp.abs to a complex
        loss before `jax.grad`. The function runs only outside of `jit` and `vmap`.
    """
    chosen, full = _chosen(problem, names, method)

    def at(values: Values) -> Problem:
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values)):
            raise InputError(
                "a rollout was called inside jit or vmap, but neighbor lists are built outside compiled code",
                remedy="Call the rollout, or jax.grad of the rollout, outside of jit and vmap",
            )
        return problem.at(_in_full(problem, values, full))

    @jax.custom_vjp
    def loss(values: Values) -> jax.Array:
        return jnp.asarray(at(values).value())

    def forward(values: Values):
        found = _differentiated(chosen, at(values), full)
        if watch is not None:
            watch(found)
        by_name = {}
        for name, value in values.items():
            (one,) = parameters.resolve(problem.simulation, [name])
            derivative = found.gradient[one]
            dtype = np.promote_types(jnp.result_type(value), np.complex64)
            by_name[name] = jnp.asarray(derivative).astype(dtype)
        return jnp.asarray(found.value), by_name

    def backward(gradient, onto):
        # the cotangent of x + iy is that of x minus i times that of y
        return (jax.tree.map(lambda one: jnp.real(onto.astype(one.dtype) * one), gradient),)

    loss.defvjp(forward, backward)
    return loss


def _chosen(problem: Problem, names: Sequence[str], word: Method | str) -> tuple[Method, tuple[str, ...]]:
    chosen = method(word) if isinstance(word, str) else word
    return chosen, chosen.check(problem, names)


def _differentiated(chosen: Method, problem: Problem, names: tuple[str, ...]) -> Gradient:
    """Compute the gradient. Warn if a derivative is exactly zero. Raise an error if one is not finite."""
    found = chosen(problem, names)
    for name, value in found.gradient.items():
        if not np.any(np.asarray(value)):
            note = found.notes.get(name, "exactly 0 in this run")
            warnings.warn(f"{found.method} by {name}: {note}", UserWarning, stacklevel=3)
    bad = [name for name, value in found.gradient.items() if not np.isfinite(value).all()]
    if bad or not np.isfinite(found.value):
        from mdnum.gradients.diagnose.detective import detective

        why = ""
        with suppress(InputError):
            blamed = detective((problem.parts or (problem,))[0], names, saltation=False)
            inputs = ", ".join(f"{one:.3g}" for one in blamed.inputs)
            if blamed.operation:
                why = f": at step {blamed.step} {blamed.operation}({inputs}) in {blamed.source}"
        what = "the loss" if not np.isfinite(found.value) else f"a derivative, by {', '.join(bad)}"
        raise NumericalError(
            f"{what} is not finite{why}", where=found.method, remedy="Correct the operation giving inf or NaN"
        )
    return found


def _in_full(problem: Problem, values: Values, full: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the parameter values by full parameter name. The given names may be short."""
    out = {}
    for word, value in values.items():
        (name,) = parameters.resolve(problem.simulation, [word])
        if name not in full:
            raise InputError(
                f"a value was given for {word}, but the gradient does not include this parameter",
                remedy=f"Add {word} to the parameters of the gradient ({', '.join(full)})",
            )
        out[name] = np.asarray(value)
    return out
