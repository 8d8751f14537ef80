"""Parts of demonstrations: step matrices, a column of balls, integers for a state."""

from __future__ import annotations

import itertools
from functools import cache
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.ball import Penalty, Reason, World
from mdnum.errors import InputError
from mdnum.verbs import demos

G = 9.81


@cache
def script(name: str) -> SimpleNamespace:
    """Everything that a demonstration's file defines."""
    return SimpleNamespace(**demos.load(name).__globals__)


# stiffness


@eqx.filter_jit
def step_jacobian(x, world: World, half: bool):
    """Of a step from (sqrt(k) y, v), for velocity Verlet with the v of the half step, to a step later."""
    contact: Any = world.contact
    h, unit = world.integrator.h, jnp.sqrt(contact.k)

    def step(x):
        y, v = x[:1] / unit, x[1:]
        state = world.start(y, v)
        a = contact.acceleration(y, v, state.a * 0 - G, jnp.ones(1, bool), world.rounding)
        state = state._replace(y=y, v=v - h / 2 * a if half else v, a=a)
        after = world.advance(state)[0]
        v = after.v + h / 2 * after.a if half else after.v
        return jnp.concatenate([after.y * unit, v])

    return jax.jacfwd(step)(x)


@pytest.mark.parametrize(("z", "zeta"), [(1.3, 0.0), (0.7, 0.2), (2.5, 0.6)])
def test_the_matrix_is_the_jacobian_of_a_step_in_contact(z: float, zeta: float):
    own, h = script("stiffness"), 0.125
    k = (z / h) ** 2
    for scheme, build in own.SCHEMES.items():
        world = World.create(Penalty(k, 2 * zeta * np.sqrt(k)), build(h), G)
        # deep in contact, so that the step ends there too
        jacobian = step_jacobian(np.array([-3.0, 0.1]), world, scheme == "velocity-verlet")
        np.testing.assert_allclose(jacobian, own.step_matrix(scheme, z, zeta), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("zeta", [0.0, 0.05, 0.7, 1.0, 3.0])
def test_the_limit_is_where_an_eigenvalue_leaves_the_unit_circle(zeta: float):
    own = script("stiffness")
    for scheme in own.SCHEMES:
        known = own.limit(scheme, zeta)
        z = np.linspace(1e-3, min(known, 50.0) * (1 - 1e-9), 500)
        assert known == 0 or np.all(own.spectral_radius(scheme, z, zeta) <= 1 + 1e-9)
        if np.isfinite(known):
            beyond = np.linspace(known + 1e-6, 3 * known + 1, 500)
            assert np.all(own.spectral_radius(scheme, beyond, zeta) > 1)
    assert [own.limit(scheme) for scheme in own.SCHEMES] == [0, 2, 2, np.inf]


@pytest.mark.parametrize("zeta", [0.0, 0.1, 0.7])
@pytest.mark.nightly
def test_balls_held_in_contact_run_away_where_the_eigenvalues_say(zeta: float):
    own, steps = script("stiffness"), 2000
    for scheme in ("explicit-euler", "semi-implicit-euler", "velocity-verlet"):
        found = own.measured_limit(scheme, zeta, steps=steps)
        # the growth that was waited for, up to the part of it that is not in the fastest eigenvector
        power = steps * np.log(own.spectral_radius(scheme, found, zeta))
        if own.limit(scheme, zeta) == 2:
            assert abs(found - 2) < 1e-5
        else:
            assert abs(power - np.log(own.GROWTH)) < 0.4 * np.log(own.GROWTH)
            assert 0 < found - own.limit(scheme, zeta) < 0.1
        # rounding does not move the limit: float32 finds the same to a thousandth
        assert abs(own.measured_limit(scheme, zeta, steps=steps, dtype="float32") - found) < 1e-3 * found


def test_the_growth_of_a_bounce():
    own = script("stiffness")
    # at z = 1 three contact steps are minus the identity, whatever the phase, as in the exact motion
    power = np.linalg.matrix_power(own.step_matrix("semi-implicit-euler", 1.0), 3)
    np.testing.assert_allclose(power, -np.eye(2), atol=1e-15)
    assert own.bounce_growth("semi-implicit-euler", 1.0) < 1e-6
    assert own.bounce_growth("semi-implicit-euler", 0.9) > 1.0
    assert own.bounce_growth("semi-implicit-euler", 0.1, zeta=3.0) == np.inf


# quantized-state


@pytest.mark.parametrize("bits", [12, 32])
def test_the_integer_ball_has_the_bits_of_pythons_integers_and_returns(bits: int):
    control, step, k = 2.0 * np.sin(np.arange(700) * 0.1), 0.01, 1234.5
    ball = script("quantized-state").LatticeBall.create(k, step, control, bits=bits)
    start = ball.start([0.3, 0.7, 1.1], -0.5)
    end, contact = ball.run(start)
    h, push = round(step * 2**24), round(step * k * 2**24)
    for n in range(3):
        y, v = int(start.y[n]), int(start.v[n])
        for u, touches in zip(control, np.asarray(contact)[:, n], strict=True):
            assert touches == (y < 0)
            v += int(np.rint((u - G) * step * 2**bits)) - ((y * push >> 24) if y < 0 else 0)
            y += v * h >> 24
        assert (int(end.y[n]), int(end.v[n])) == (y, v)
    assert np.asarray(contact).any(axis=0).all()
    back = ball.rewind(end)
    assert np.array_equal(back.y, start.y) and np.array_equal(back.v, start.v)
    with pytest.raises(InputError, match="overflow"):
        script("quantized-state").LatticeBall.create(k, step, control, bits=40)


# tf32-in-solver


def exact_step(q, v, k, h=0.01):
    """The minimum of a step by trying every set of contacts: the one that agrees with itself."""
    n = len(q)
    jacobian = np.eye(n) - np.eye(n, k=-1)
    free = q + h * v - h * h * G
    for flags in itertools.product([0.0, 1.0], repeat=n):
        active = np.diag(flags)
        new = np.linalg.solve(np.eye(n) + h * h * k * jacobian.T @ active @ jacobian, free)
        if np.array_equal(jacobian @ new < 0, np.array(flags) > 0):
            return new, (new - q) / h, np.array(flags) > 0
    raise AssertionError("no set of contacts agrees with itself")


def test_a_step_of_the_column_is_the_minimum_found_by_trying_all_sets_of_contacts():
    own = script("tf32-in-solver")
    column = own.Column.create(6, "float64", k=1e6, tol=1e-13, inner_tol=1e-13)
    q, v = np.cumsum(np.random.default_rng(3).uniform(0, 2e-3, 6)), np.zeros(6)
    run = own.simulate_column(column, column.start(q), 25)
    for step in range(25):
        q, v, contact = exact_step(q, v, 1e6)
        assert np.abs(run.q[step + 1] - q).max() < 1e-11
        assert np.array_equal(run.record.contact[step], contact)
    assert run.record.contact.any() and not run.record.contact.all()
    assert run.ended() == {"tolerance": 25}
    # another start: where two columns diverge
    other = own.simulate_column(column, column.start(np.linspace(1.9e-3, 1.4e-2, 6)), 25)
    step, ball, gap, there = run.first_difference(other)
    differ = run.record.contact != other.record.contact
    assert not differ[: step - 1].any() and differ[step - 1, ball]
    assert (gap < 0) != (there < 0) and run.first_difference(run) is None


def test_conjugate_gradients_solve_and_know_it():
    conjugate_gradients = script("tf32-in-solver").conjugate_gradients
    rng = np.random.default_rng(1)
    root = rng.normal(size=(30, 30))
    matrix, b = jnp.asarray(root @ root.T + 30 * np.eye(30)), jnp.asarray(rng.normal(size=30))
    solved = conjugate_gradients(lambda v: matrix @ v, b, 1e-12, 60, true_product=lambda x: matrix @ x)
    assert np.abs(np.asarray(solved.x) - np.linalg.solve(matrix, b)).max() < 1e-12
    n = int(solved.iterations)
    true = np.linalg.norm(np.asarray(b - matrix @ solved.x)) / np.linalg.norm(b)
    assert float(solved.true_history[n]) == pytest.approx(true, rel=1e-6)
    assert float(solved.history[n]) == float(solved.residual) <= 1e-12
    reasons = [
        Reason(int(one.reason))
        for one in (
            solved,
            conjugate_gradients(lambda v: matrix @ v, b, 1e-12, 3),
            conjugate_gradients(lambda v: v * jnp.nan, b, 1e-12, 9),
        )
    ]
    assert reasons == [Reason.TOLERANCE, Reason.CAP, Reason.NOT_FINITE]
