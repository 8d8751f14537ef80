"""Gradients in JAX's shape: through a user's own parameters, with the keys that were asked for."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_systems import LENNARD_JONES, crystal, make

import mdnum
from mdnum.errors import InputError
from mdnum.gradients import METHODS, differentiable, method, value_and_grad
from mdnum.gradients.ball import BALL_METHODS
from mdnum.gradients.diagnose.trust import trust
from mdnum.gradients.losses import LOSSES, Custom, Loss, MeanPotential, MeanSquaredDisplacement
from mdnum.gradients.problem import Problem
from mdnum.systems import build

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
    for ask, text in (
        (lambda: jax.jit(loss)({"sigma": jnp.asarray(1.0)}), "outside of jit"),
        (lambda: loss({"epsilon": 1.0}), "not include this parameter"),
        (lambda: value_and_grad(problem, ("sigma",), "symetric"), "Did you mean symmetric"),
        (lambda: value_and_grad(problem, ("seed",)), "seed"),
        (lambda: loss({"sigma": jnp.asarray(np.nan)}), "expected finite real"),
        (lambda: Problem(simulation, vector, STEPS), "shape \\(3,\\)"),
        (lambda: Problem(simulation, count, STEPS), "int.*varies"),
    ):
        with pytest.raises(InputError, match=text):
            ask()
    assert Problem(simulation, MeanPotential(), STEPS).loss.name == "potential"


def turned(angle):
    """exp(i angle)."""
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


class StructureFactor(Loss):
    """Amplitude of one density wave, averaged over frames."""

    name = "structure-factor"
    of_single_frames = True

    def observe(self, frame, origin, around):
        k = 2 * jnp.pi * jnp.linalg.inv(around.matrix) @ jnp.array([1.0, 2.0, 0.0])
        return jnp.sum(turned(-(k @ frame.x)))


class Intensity(StructureFactor):
    """A real loss of complex sums."""

    name = "intensity"

    def value(self, total, frames):
        return jnp.square(jnp.abs(total / frames))


@pytest.mark.parametrize(
    ("name", "loss"),
    [
        ("event-aware", StructureFactor(every=3)),
        ("forward", StructureFactor(every=3)),
        ("event-aware", Intensity(every=3)),
        pytest.param("forward", Intensity(every=3), marks=pytest.mark.nightly),
        pytest.param("unrolled", StructureFactor(every=3), marks=pytest.mark.nightly),
        pytest.param("unrolled", Intensity(every=3), marks=pytest.mark.nightly),
    ],
)
def test_a_complex_loss_has_the_derivatives_of_both_parts(smooth, name, loss):
    problem = Problem(smooth, loss, STEPS)
    function = value_and_grad(problem, ("sigma", "timestep"), name)
    value, gradient = function({})
    assert value == problem.value() and np.iscomplexobj(value) == (loss.name == "structure-factor")
    for key, here in (("sigma", 1.0), ("timestep", float(smooth.integrator.timestep))):
        step = 1e-5 * here
        up, down = (function({key: here + s})[0] for s in (step, -step))
        slope = (up - down) / (2 * step)
        for part in (np.real, np.imag):
            assert part(gradient[key]) == pytest.approx(part(slope), rel=1e-5, abs=1e-9 * abs(slope))
    # neither part is small, so that no conjugate and no factor could hide
    assert np.isrealobj(value) or min(abs(gradient["sigma"].real), abs(gradient["sigma"].imag)) > 0.1


def test_a_complex_loss_has_what_the_flips_add_to_both_parts(well):
    """z = exp(i w) of the speed that is left beyond the cutoff: dz = i z dw."""
    problem, axis = well
    wave = Custom(see=lambda frame, *_: turned(frame.v[axis, 1] - frame.v[axis, 0]), first=2000)
    names = ("epsilon", "r_cut", "initial.velocities")
    speed, slopes = value_and_grad(problem, names)({})
    value, gradient = value_and_grad(replace(problem, loss=wave), names)({})
    assert value == pytest.approx(np.exp(1j * speed), rel=1e-12)
    for name in names:
        np.testing.assert_allclose(gradient[name], 1j * value * slopes[name], rtol=1e-10, atol=1e-14)


@pytest.mark.nightly
def test_an_average_of_a_complex_loss_has_both_parts():
    wide = make(crystal(), LENNARD_JONES, {"kind": "hard", "radius": 2.0})
    simulation, names = build(wide), ("sigma", "r_cut")
    wave = Custom(
        see=lambda frame, *_: jax.lax.complex(2 * frame.potential, 3 * frame.potential), single=True
    )
    plain = Custom(see=lambda frame, *_: frame.potential, single=True)
    (whole, real) = (Problem(simulation, loss, STEPS) for loss in (wave, plain))
    one, other = (method("boundary")(problem, names) for problem in (whole, real))
    for name in one.gradient:
        np.testing.assert_allclose(one.gradient[name], (2 + 3j) * other.gradient[name], rtol=1e-10)
    assert np.abs(one.gradient["cutoff.radius"]) > 0


def test_jax_takes_real_functions_of_a_complex_loss(smooth):
    problem = Problem(smooth, StructureFactor(), STEPS)
    loss = differentiable(problem, ("sigma", "epsilon"), "symmetric")

    def at(function):
        return lambda values: function(loss({"sigma": values[0], "epsilon": values[1]}))

    here, h = jnp.ones(2), 1e-5
    for function in (jnp.abs, jnp.angle, lambda z: jnp.abs(z) ** 2, lambda z: jnp.real((2 - 3j) * z)):
        for k, slope in enumerate(jax.grad(at(function))(here)):
            up, down = (at(function)(here.at[k].add(s)) for s in (h, -h))
            assert float(slope) == pytest.approx(float(up - down) / (2 * h), rel=1e-5)


def test_where_a_complex_derivative_has_no_meaning_it_is_refused(smooth, monkeypatch, tmp_path):
    problem = Problem(smooth, StructureFactor(), STEPS)
    with pytest.raises(TypeError, match="real-valued outputs"):
        jax.grad(differentiable(problem, ("sigma",)))({"sigma": 1.0})
    monkeypatch.setitem(LOSSES._own, "structure-factor", StructureFactor)
    verb = partial(mdnum.grad, "pair/leaving-well", of="structure-factor", wrt="sigma", steps=STEPS)
    for ask, text in (
        (lambda: trust(problem, ("sigma",)), "structure-factor.*is complex.*value_and_grad"),
        (lambda: verb(out=tmp_path / "out", methods="finite-differences"), "structure-factor.*is complex"),
        (lambda: value_and_grad(problem, ("sigma",))({"sigma": 1 + 1j}), "finite real numbers"),
    ):
        with pytest.raises(InputError, match=text):
            ask()
    assert not (tmp_path / "out").exists()


def test_every_name_is_that_of_its_method():
    assert [method(name).name for name in METHODS] == list(METHODS)
    assert [BALL_METHODS.parse(name).name for name in BALL_METHODS] == list(BALL_METHODS)
    assert all(map(METHODS.description, METHODS)) and all(map(LOSSES.description, LOSSES))
