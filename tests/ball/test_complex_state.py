"""A complex state against exact arithmetic, and JAX's convention against finite differences."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.ball.complex_state import Phasor, direction, rotate, unwrapped, uphill, upper
from mdnum.errors import InputError


def differences(function, z: complex, h: float = 1e-6) -> complex:
    """∂f/∂x + i ∂f/∂y by central differences."""
    along = [(float(function(z + h * e)) - float(function(z - h * e))) / (2 * h) for e in (1.0, 1j)]
    return complex(*along)


FUNCTIONS = {
    "modulus": (lambda z: jnp.abs(z), lambda z: z / abs(z)),
    "squared": (lambda z: jnp.real(z * jnp.conj(z)), lambda z: 2 * z),
    "argument": (lambda z: jnp.angle(z), lambda z: 1j * z / abs(z) ** 2),
    "direction": (
        lambda z: jnp.real(direction(z) * (2.0 - 1.0j)),
        lambda z: 1j * z / abs(z) ** 2 * (1j * z / abs(z) * (2 - 1j)).real,
    ),
    "holomorphic part": (lambda z: jnp.real(z**3), lambda z: np.conj(3 * z**2)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("z", [0.6 + 0.8j, -1.5 + 0.25j, 0.3 - 2.0j])
def test_the_conjugate_of_jax_grad_points_uphill(name: str, z: complex) -> None:
    function, exact = FUNCTIONS[name]
    found = complex(uphill(function)(z))
    np.testing.assert_allclose(found, differences(function, z), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found, exact(z), rtol=1e-13)
    # JAX itself gives the conjugate: a descent along it goes the wrong way in the imaginary part
    np.testing.assert_array_equal(complex(jax.grad(function)(jnp.asarray(z))), np.conj(found))


def test_a_step_along_the_conjugate_rises_and_along_jax_grad_need_not() -> None:
    def f(z):
        return jnp.imag(z)

    z, raw = 1.0 + 1.0j, complex(jax.grad(f)(jnp.asarray(1.0 + 1.0j)))
    up = complex(uphill(f)(z))
    assert float(f(z + 0.1 * up)) > float(f(z)) > float(f(z + 0.1 * raw))


@pytest.mark.parametrize(("zero", "arg", "side"), [(0.0, np.pi, True), (-0.0, -np.pi, False)])
def test_the_sign_of_a_zero_says_on_which_side_of_the_cut_a_number_is(zero, arg, side) -> None:
    z = jnp.asarray(complex(-1.0, zero))
    assert float(jnp.angle(z)) == arg
    assert bool(upper(z)) is side


def test_a_phasor_turns_as_exact_arithmetic_does() -> None:
    factor, steps = 0.75 + 0.5j, 12  # |factor|² = 13/16: dyadic, exact for a few steps
    run = rotate(Phasor.create(factor), Phasor.create(factor).start([1.0 + 0j, 0.5 - 0.25j]), steps)
    real, imaginary = Fraction(1), Fraction(0)
    for step in range(1, steps + 1):
        a, b = Fraction(3, 4), Fraction(1, 2)
        real, imaginary = a * real - b * imaginary, a * imaginary + b * real
        assert (Fraction(run.z[step, 0].real), Fraction(run.z[step, 0].imag)) == (real, imaginary)
    exact = np.angle(run.z[0]) + np.arange(steps + 1)[:, None] * np.angle(factor)
    np.testing.assert_allclose(run.phase, exact, rtol=1e-14)


@pytest.mark.parametrize("sense", [1, -1])
def test_every_crossing_of_the_cut_is_in_the_ledger_with_its_margin(sense: int) -> None:
    angle, steps = 0.7, 100
    phasor = Phasor.create(complex(np.exp(1j * sense * angle)))
    run = rotate(phasor, phasor.start([1.0, 2j]), steps)
    for who, first in enumerate((0.0, np.pi / 2)):
        turns = np.floor((sense * first + np.arange(steps + 1) * angle + np.pi) / (2 * np.pi))
        expected = np.flatnonzero(np.diff(turns)) + 1
        rows = run.crossings.subject[:, 0] == who
        np.testing.assert_array_equal(run.crossings.step[rows], expected)
        assert np.all(run.crossings.entered[rows] == (sense > 0))
        np.testing.assert_array_equal(run.crossings.margin[rows], run.z[expected, who].imag)
        # arg jumps by what the ledger says, less the turn of the step itself
        jumps = np.diff(np.angle(run.z[:, who]))[expected - 1]
        np.testing.assert_allclose(jumps, run.crossings.jump[rows] + sense * angle, rtol=1e-12)
    assert not np.any(run.crossings.ambiguous)


def test_a_quarter_turn_lands_on_the_cut_and_says_so() -> None:
    phasor = Phasor.create(1j)
    run = rotate(phasor, phasor.start([1.0, -1.0j, complex(-0.0, -1.0)]), 3)
    # 1, i, -1: Im is +0 there, so the cut is crossed a step later
    ones = run.crossings.subject[:, 0] == 0
    assert run.crossings.step[ones].tolist() == [3]
    assert run.z[2, 0] == -1.0
    np.testing.assert_array_equal(np.signbit(run.z[2, 0].imag), False)


def test_two_starts_a_hair_apart_end_on_two_sides_with_two_losses_and_gradients() -> None:
    phasor = Phasor.create(1j)

    def loss(z0):
        state = phasor.start(z0)
        for _ in range(2):
            state = phasor.step(state, phasor.decide(state))
        return (jnp.angle(state.z)[0] - 1.0) ** 2, unwrapped(state)[0]

    # XLA flushes what is smaller to zero
    tiny = float(np.finfo(float).tiny)
    ends = [loss(complex(1.0, im)) for im in (-tiny, tiny)]
    wrapped = [float(end[0]) for end in ends]
    np.testing.assert_allclose(wrapped, [(np.pi - 1) ** 2, (np.pi + 1) ** 2], rtol=1e-15)
    # the phase without jumps is the same on both sides
    np.testing.assert_allclose([float(end[1]) for end in ends], np.pi, rtol=1e-15)
    slopes = [complex(uphill(lambda z: loss(z)[0])(complex(1.0, im))) for im in (-tiny, tiny)]
    np.testing.assert_allclose(slopes, [2j * (np.pi - 1), 2j * (-np.pi - 1)], rtol=1e-14)


def test_a_circle_is_a_decision_that_removes_the_radial_derivative() -> None:
    phasor = Phasor.create(1.25j, radius=2.0)
    run = rotate(phasor, phasor.start([1.0]), 8)
    # 1.25^3 < 2 < 1.25^4
    assert (run.stops.step.tolist(), run.stops.entered.tolist()) == ([4], [False])
    np.testing.assert_allclose(run.stops.margin, 2 - 1.25**4, rtol=1e-15)
    np.testing.assert_allclose(np.abs(run.z[4:, 0]), 2.0, rtol=1e-15)

    def modulus(z0, steps):
        state = phasor.start(z0)
        for _ in range(steps):
            state = phasor.step(state, phasor.decide(state))
        return jnp.abs(state.z)[0]

    np.testing.assert_allclose(complex(uphill(lambda z: modulus(z, 3))(1.0)), 1.25**3, rtol=1e-14)
    np.testing.assert_allclose(complex(uphill(lambda z: modulus(z, 5))(1.0)), 0.0, atol=1e-15)


def test_zero_has_no_direction_and_a_finite_derivative() -> None:
    z = jnp.asarray([0.0 + 0j, 3.0 + 4j])
    np.testing.assert_array_equal(np.asarray(direction(z)), [0, 0.6 + 0.8j])
    slope = jax.grad(lambda z: jnp.sum(jnp.real(direction(z))))(z)
    assert np.all(np.isfinite(np.asarray(slope)))
    np.testing.assert_array_equal(np.asarray(direction(z, floor=5.0)), [0, 0])


@pytest.mark.parametrize(
    ("factor", "radius"), [(0j, 1.0), (-1 + 0j, 1.0), (complex(np.nan, 0), 1.0), (1j, 0.0)]
)
def test_what_cannot_turn_is_refused(factor: complex, radius: float) -> None:
    with pytest.raises(InputError):
        Phasor.create(factor, radius)
