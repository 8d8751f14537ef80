"""Gradients in JAX's shape: through a user's own parameters, with the keys that were asked for."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.gradients import METHODS, differentiable, method, value_and_grad
from mdnum.gradients.ball import BALL_METHODS
from mdnum.gradients.losses import LOSSES, Custom, MeanPotential, MeanSquaredDisplacement
from mdnum.gradients.problem import Problem

STEPS = 20


@pytest.fixture(scope="module")
def problem(smooth):
    return Problem(smooth, MeanSquaredDisplacement(), STEPS)


def test_the_keys_are_those_asked_for_and_values_move_the_loss(problem):
    function = value_and_grad(problem, ("sigma", "potential.epsilon"), "symmetric")
    value, gradient = function({"sigma": 1.0, "potential.epsilon": 1.0})
    assert value == problem.value()
    assert list(gradient) == ["sigma", "potential.epsilon"]
    step = 1e-5
    up, down = (function({"sigma": 1.0 + s})[0] for s in (step, -step))
    assert float(gradient["sigma"]) == pytest.approx((up - down) / (2 * step), rel=1e-5)
    (again, whole), _ = value_and_grad(problem, ("sigma",), "symmetric", has_aux=True)({})
    assert again == value
    assert whole.method == "symmetric"


def test_jax_differentiates_through_a_users_own_tree(problem):
    told = []
    loss = differentiable(problem, ("sigma", "epsilon"), "symmetric", watch=told.append)

    def mine(tree):
        root, (shift, width) = tree["root"], tree["rest"]
        return jnp.sin(1e2 * loss({"sigma": jnp.exp(root) * width, "epsilon": 1.0 + shift * width}))

    tree = {"root": jnp.asarray(0.01), "rest": (jnp.asarray(0.02), jnp.asarray(0.99))}
    value, gradient = jax.value_and_grad(mine)(tree)
    assert len(told) == 1
    assert float(value) == float(mine(tree))
    leaves, structure = jax.tree.flatten(tree)
    for k, ours in enumerate(jax.tree.leaves(gradient)):

        def shifted(step, k=k):
            moved = [leaf + step if n == k else leaf for n, leaf in enumerate(leaves)]
            return float(mine(jax.tree.unflatten(structure, moved)))

        assert float(ours) == pytest.approx((shifted(1e-5) - shifted(-1e-5)) / 2e-5, rel=1e-5)


def test_a_derivative_that_is_exactly_zero_is_never_silent(problem):
    hard = Problem(problem.simulation.with_cutoff("hard"), problem.loss, STEPS)
    with pytest.warns(UserWarning, match="symmetric by cutoff.radius: exactly 0"):
        value_and_grad(hard, ("r_cut", "sigma"), "symmetric")()
    with pytest.warns(UserWarning, match="cutoff.radius"):
        jax.grad(differentiable(hard, ("r_cut",), "symmetric"))({"r_cut": jnp.asarray(2.2)})


def test_what_is_no_loss_or_cannot_be_traced_or_named_is_refused(problem):
    loss, simulation = differentiable(problem, ("sigma",), "symmetric"), problem.simulation
    vector = Custom(see=lambda frame, origin, around: jnp.sum(frame.x, axis=1))
    count = Custom(see=lambda frame, origin, around: frame.step, conclude=lambda total, frames: total)
    wave = Custom(see=lambda frame, origin, around: jnp.sum(jax.lax.complex(frame.x[0], frame.x[1])))
    for ask, text in (
        (lambda: jax.jit(loss)({"sigma": jnp.asarray(1.0)}), "outside of jit"),
        (lambda: loss({"epsilon": 1.0}), "not asked for"),
        (lambda: value_and_grad(problem, ("sigma",), "symetric"), "Did you mean symmetric"),
        (lambda: value_and_grad(problem, ("seed",)), "seed"),
        (lambda: loss({"sigma": jnp.asarray(np.nan)}), "expected finite numbers"),
        (lambda: Problem(simulation, vector, STEPS), "shape \\(3,\\)"),
        (lambda: Problem(simulation, count, STEPS), "int.*of it that varies"),
        (lambda: Problem(simulation, wave, STEPS), "complex128.*jnp.real.*jnp.abs"),
    ):
        with pytest.raises(InputError, match=text):
            ask()
    assert Problem(simulation, MeanPotential(), STEPS).loss.name == "potential"


def test_every_name_is_that_of_its_method():
    assert [method(name).name for name in METHODS] == list(METHODS)
    assert [BALL_METHODS.parse(name).name for name in BALL_METHODS] == list(BALL_METHODS)
    assert all(map(METHODS.description, METHODS)) and all(map(LOSSES.description, LOSSES))
