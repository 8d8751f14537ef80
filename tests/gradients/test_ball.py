"""Each derivative against an oracle of its own: closed forms, finite differences, exact motions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from mdnum.ball.problem import BallProblem, MeanHeight, ResidualPenetration
from mdnum.ball.step import BallVerlet, EventLocated, Impact, Penalty, Projection, SemiImplicitEuler
from mdnum.ball.stopping import GlobalSum, PerInstance
from mdnum.ball.world import World
from mdnum.errors import InputError, NumericalError
from mdnum.gradients.ball import BALL_METHODS, compare, dependence
from mdnum.numerics.exact import fence, zero_bits
from mdnum.numerics.roles import RolePrecision


def method(name: str, **options):
    """A method with options."""
    return BALL_METHODS[name](**options)


def relaxation(tol: float, p0=(0.45,), rule=GlobalSum) -> BallProblem:
    """One step without gravity from below the floor: the projection and nothing else."""
    contact = Projection(0.5, 0.5, rule(tol, 200))
    world = World.create(contact, SemiImplicitEuler(1.0), gravity=0.0)
    return BallProblem(world, -np.array(p0), 0.0, 1, ResidualPenetration(1))


def plain(y0=1.0, h: float = 1e-3) -> BallProblem:
    """2,000 plain steps: one program for all that ask for no other."""
    return bouncing(SemiImplicitEuler(h), steps=2000, y0=y0)


def bouncing(scheme, end: float = 2.0, steps: int | None = None, y0=1.0, **contact) -> BallProblem:
    world = World.create(Impact(**contact), scheme)
    return BallProblem(world, y0, 0.0, steps or round(end / float(scheme.h)))


def height(y0, v0, e, g, end):
    """The bouncing ball in closed form, bounce after bounce."""
    s = np.sqrt(v0 * v0 + 2 * g * y0)
    left, v = end - (v0 + s) / g, e * s
    if left < 0:
        return y0 + v0 * end - g * end * end / 2
    while left > 2 * v / g:
        left, v = left - 2 * v / g, v * e
    return v * left - g * left * left / 2


def slopes(f, at: dict, widths: float = 1e-6) -> dict:
    """Central differences of a smooth function, with Richardson's extrapolation."""
    found = {}
    for name, value in at.items():
        h = widths * max(abs(value), 1.0)
        d = [(f(**at | {name: value + w}) - f(**at | {name: value - w})) / (2 * w) for w in (h, 2 * h)]
        found[name] = (4 * d[0] - d[1]) / 3
    return found


@pytest.mark.parametrize(("tol", "n", "k"), [(1e-2, 14, -7.5e-2), (1e-4, 30, -1.6e-3), (1e-6, 46, -2.5e-5)])
def test_the_unrolled_gain_is_an_artefact_of_the_tolerance_and_the_implicit_one_is_zero(tol, n, k) -> None:
    problem = relaxation(tol)
    unrolled = method("unrolled")(problem, ["k", "y0"])
    # p0 (1 - alpha k)^n, differentiated by hand
    np.testing.assert_allclose(unrolled.gradient["k"], -0.45 * n * 0.75 ** (n - 1) * 0.5, rtol=1e-13)
    np.testing.assert_allclose(unrolled.gradient["k"], k, rtol=0.02)
    np.testing.assert_allclose(unrolled.gradient["y0"], -(0.75**n), rtol=1e-13)
    np.testing.assert_allclose(unrolled.value, 0.45 * 0.75**n, rtol=1e-13)
    assert unrolled.details["iterations"] == n
    implicit = method("implicit")(problem, ["k", "y0"])
    assert implicit.gradient == {"k": 0.0, "y0": 0.0}
    assert implicit.value == unrolled.value
    assert implicit.notes["k"] == "the fixed point does not depend on k"
    assert unrolled.depends == {"k": True, "y0": True}
    assert implicit.depends == {"k": False, "y0": False}
    # taking the stopped iterate for the fixed point lets the tolerance back in: p / k
    near = method("implicit", at_iterate=True)(problem, ["k", "y0"])
    np.testing.assert_allclose(near.gradient["k"], -unrolled.value / 0.5, rtol=1e-11)


def test_a_gain_that_no_iteration_used_is_said_not_to_matter() -> None:
    for rule in (GlobalSum, PerInstance):
        found = method("unrolled")(relaxation(1.0, (0.25,), rule), ["k", "y0"])
        assert found.gradient["k"] == 0.0
        assert found.depends == {"k": False, "y0": True}
        assert found.notes["k"] == "the loop ended before k was used: the loss does not depend on k"
    flying = method("unrolled")(plain(y0=100.0), ["restitution"])
    assert not flying.depends["restitution"]
    assert flying.notes["restitution"].startswith("no ball touched the floor")


@pytest.mark.slow
def test_frozen_is_the_derivative_of_the_pinned_program() -> None:
    control = 3.0 * np.sin(np.arange(60.0))[:, None] * np.array([1.0, 0.5])
    contact = Projection(0.5, 0.5, GlobalSum(1e-3, 60))
    world = World.create(contact, SemiImplicitEuler(1e-2), control=control)
    problem = BallProblem(world, np.array([0.05, 0.2]), 0.0, 60, MeanHeight())
    names = ["k", "alpha", "restitution", "gravity", "y0", "v0"]
    frozen = method("frozen")(problem, names)
    unrolled = method("unrolled")(problem, names)
    assert frozen.value == unrolled.value == problem.value()
    assert frozen.details["iterations"] > 20
    for name in names:
        np.testing.assert_allclose(frozen.gradient[name], unrolled.gradient[name], rtol=1e-13, err_msg=name)
        difference = frozen.details["finite_difference"][name]
        np.testing.assert_allclose(frozen.gradient[name], difference, rtol=1e-6, atol=1e-9, err_msg=name)


def test_a_fixed_point_too_ill_conditioned_to_differentiate_is_refused() -> None:
    world = World.create(Projection(1e-13, 0.5, GlobalSum(1e-2, 3)), SemiImplicitEuler(1.0), gravity=0.0)
    problem = BallProblem(world, np.array([-0.45]), 0.0, 1, ResidualPenetration(1))
    with pytest.raises(InputError, match="condition number 2e\\+13"):
        method("implicit")(problem, ["k", "y0"])
    helped = method("implicit", regularization=1e-3)(problem, ["k", "y0"])
    assert helped.details["condition"] < 1e4
    assert helped.gradient["k"] == 0.0


def test_located_impacts_have_the_derivative_of_the_exact_motion() -> None:
    at = {"y0": 1.0, "v0": 0.5, "e": 0.8, "g": 9.81}
    world = World.create(Impact(0.8), EventLocated(1e-2))
    found = method("event-aware")(BallProblem(world, 1.0, 0.5, 200), ["y0", "v0", "restitution", "gravity"])
    assert found.details == {"events": 3, "located": True}
    exact = slopes(lambda **p: height(p["y0"], p["v0"], p["e"], p["g"], 2.0), at, 1e-4)
    got = dict(zip(at, found.gradient.values(), strict=True))
    np.testing.assert_allclose(found.value, height(1.0, 0.5, 0.8, 9.81, 2.0), rtol=1e-12)
    for name in at:
        np.testing.assert_allclose(got[name], exact[name], rtol=1e-8, err_msg=name)


@pytest.mark.slow
def test_steps_alone_never_learn_of_the_start_and_saltation_does_to_order_h() -> None:
    # the mean over heights averages out where in its step each impact falls; an eighth of the step at the end
    starts = np.linspace(0.98, 1.02, 41)

    def mean(shift: float, e: float, g: float) -> float:
        return float(np.mean([height(y0 + shift, 0.0, e, g, 2.0) for y0 in starts]))

    exact = slopes(mean, {"shift": 0.0, "e": 0.8, "g": 9.81}, 1e-4)
    errors = []
    for h in (2e-3, 2.5e-4):
        problem = bouncing(SemiImplicitEuler(h), y0=starts)
        assert problem.value_and_grad(["y0"])[1]["y0"] == 0.0
        aware = method("event-aware")(problem, ["y0", "restitution", "gravity"])
        assert aware.depends["y0"]
        assert aware.details["events"] == 3 * 41
        near = list(exact.values())
        errors.append([abs(a - b) for a, b in zip(aware.gradient.values(), near, strict=True)])
    relative = np.array(errors) / np.abs(list(exact.values()))
    assert np.all(relative[-1] < 0.05)
    # order 1: an eighth of the error at an eighth of the step
    np.testing.assert_allclose(np.log2(relative[0] / relative[-1]) / 3, 1.0, atol=0.2)


@pytest.mark.parametrize(
    ("h", "known"), [pytest.param(1e-2, 0.39, marks=pytest.mark.nightly), (1e-3, 9.9e-3)]
)
def test_the_known_errors_of_saltation_on_plain_steps(h: float, known: float) -> None:
    problem = plain() if h == 1e-3 else bouncing(SemiImplicitEuler(h))
    assert problem.value_and_grad(["y0"])[1]["y0"] == 0.0
    found = method("event-aware")(problem, ["y0"]).gradient["y0"]
    np.testing.assert_allclose(abs(found - 0.4266108641634107), known, rtol=0.03)


def damped(y0, k, damping, v0, end, g=9.81):
    """A ball on a damped spring floor: flight, one contact by the roots of the oscillator, flight."""
    speed = np.sqrt(v0 * v0 + 2 * g * y0)
    time = (v0 + speed) / g
    rate = np.sqrt(k - damping**2 / 4)

    def depth(t):
        # y'' = -g - damping y' - k y from (0, -speed)
        swing = np.exp(-damping * t / 2)
        amplitude = (-speed + damping * g / (2 * k)) / rate
        y = -g / k + swing * (g / k * np.cos(rate * t) + amplitude * np.sin(rate * t))
        slope = swing * (
            (amplitude * rate - damping * g / (2 * k)) * np.cos(rate * t)
            - (g / k * rate + damping * amplitude / 2) * np.sin(rate * t)
        )
        return y, slope

    out = brentq(lambda t: depth(t)[0], 0.5 * np.pi / rate, 1.5 * np.pi / rate, xtol=1e-15, rtol=1e-15)
    left = end - time - out
    return depth(out)[1] * left - g * left * left / 2


@pytest.mark.parametrize("scheme", [SemiImplicitEuler, BallVerlet])
def test_a_damper_that_sets_in_with_a_jump_needs_the_saltation_too(scheme) -> None:
    names = ["y0", "k", "damping"]
    naive_error, aware_error = [], []
    # half the step for half the time is the same program: the ball then starts nearer to its contact
    for h, y0, v0 in ((2e-5, 1.0, 0.0), (1e-5, 0.3, -3.0)):
        at, end = {"y0": y0, "k": 1e4, "damping": 20.0}, 50_000 * h
        exact = slopes(lambda v0=v0, end=end, **p: damped(**p, v0=v0, end=end), at, 1e-5)
        world = World.create(Penalty(1e4, damping=20.0), scheme(h))
        problem = BallProblem(world, y0, v0, 50_000)
        plain_steps = method("unrolled")(problem, names)
        np.testing.assert_allclose(plain_steps.value, damped(**at, v0=v0, end=end), atol=30 * h)
        naive, aware = plain_steps.gradient, method("event-aware")(problem, names).gradient
        naive_error.append([abs(naive[name] / exact[name] - 1) for name in names])
        aware_error.append([abs(aware[name] / exact[name] - 1) for name in names])
    # by k the steps alone have the wrong sign, at every step size
    assert all(row[1] > 1.5 for row in naive_error)
    assert all(row[2] > 0.02 for row in naive_error)
    assert all(error < 0.01 for row in aware_error for error in row)


def test_a_graze_is_refused() -> None:
    # a ball that sinks through the floor at 1e-9 m/s: the time of its contact is nowhere near differentiable
    world = World.create(Impact(0.8, rest_speed=0.0), SemiImplicitEuler(0.125))
    hover = BallProblem(world, 1e-10, 9.81 * 0.125 - 1e-9, 1)
    with pytest.raises(NumericalError, match="graze"):
        method("event-aware")(hover, ["y0"])


def test_a_smooth_floor_is_another_program_near_the_given_one() -> None:
    exact = slopes(lambda y0, e: height(y0, 0.0, e, 9.81, 1.0), {"y0": 1.0, "e": 0.8})
    biases, errors = [], []
    for eps in (4e-2, 2e-2, 1e-2):
        soft = method("smoothed", eps=eps)(bouncing(SemiImplicitEuler(2e-5), 1.0), ["y0", "restitution"])
        biases.append(abs(soft.value - height(1.0, 0.0, 0.8, 9.81, 1.0)))
        errors.append(abs(soft.gradient["y0"] - exact["y0"]))
    assert biases[0] > 1.6 * biases[1] > 2.6 * biases[2]
    assert errors[0] > 1.5 * errors[1] > 2.25 * errors[2]
    assert errors[-1] < 0.05 * exact["y0"]
    with pytest.raises(InputError, match="does not resolve"):
        method("smoothed", eps=1e-3)(bouncing(SemiImplicitEuler(1e-2), 1.0), ["y0"])
    with pytest.raises(InputError, match="width"):
        method("smoothed", eps=0.0)(bouncing(SemiImplicitEuler(1e-2), 1.0), ["y0"])


def test_random_smoothing_sees_through_jumps_with_an_honest_standard_error() -> None:
    problem = relaxation(1e-3)
    width = 0.05

    # E[loss(k + sigma x) x] / sigma by the trapezoidal rule, the loss written as a loop
    x = np.linspace(-8, 8, 200_001)
    p, gain = np.full(x.shape, 0.45), 0.5 * (0.5 + width * 0.5 * x)
    while np.any(p >= 1e-3):
        p = np.where(p >= 1e-3, p - gain * p, p)
    exact = np.trapezoid(p * x * np.exp(-x * x / 2), x) / np.sqrt(2 * np.pi) / (width * 0.5)
    pulls = []
    for seed in range(6):
        found = method("randomized", width=width, samples=2000, seed=seed)(problem, ["k"])
        pulls.append((found.gradient["k"] - exact) / found.details["standard_error"]["k"])
        again = method("randomized", width=width, samples=2000, seed=seed)(problem, ["k"])
        assert again.gradient == found.gradient
    assert np.max(np.abs(pulls)) < 4
    assert 0.3 < np.std(pulls) < 2.5
    with pytest.raises(InputError):
        method("randomized", samples=1)(problem, ["k"])


def test_loss_scaling_brings_back_what_float16_loses() -> None:
    policy = RolePrecision("float16", "float16", "float32", "float32", "float32")
    top, tiny = float(np.nextafter(np.float16(1e-3), np.float16(0))), 2.0**-23
    contact = Projection(0.5, 0.5, GlobalSum(float(np.float16(1e-3)), 25))
    world = World.create(contact, SemiImplicitEuler(1e-2), gravity=0.0, policy=policy)
    problem = BallProblem(world, -np.array([top] + [tiny] * 8), 0.0, 4, ResidualPenetration())
    plain = method("unrolled")(problem, ["k"])
    scaled = method("unrolled", loss_scale=2.0**16)(problem, ["k"])
    # 2 p1 dp1/dk / 9 in real arithmetic
    exact = -2 * (0.75 * top) * 0.5 * top / 9
    assert plain.gradient["k"] == -(2.0**-23)
    assert abs(plain.gradient["k"] / exact - 1) > 0.4
    np.testing.assert_allclose(scaled.gradient["k"], exact, rtol=1e-3)


def test_a_comparison_runs_what_applies_and_says_why_the_rest_does_not() -> None:
    made = compare(plain(), ["y0"])
    assert [one.method for one in made] == ["unrolled", "frozen", "event-aware", "smoothed", "randomized"]
    assert "no iterated projection" in made.refused["implicit"]
    assert len({one.description for one in made}) == 5
    assert set(BALL_METHODS) == {*made.refused, *(one.method for one in made)}
    with pytest.raises(InputError, match="no gradient 'adjoint'"):
        compare(relaxation(1e-2), ["k"], ["adjoint"])
    with pytest.raises(InputError, match="no parameter called 'damping'"):
        compare(relaxation(1e-2), ["damping"])


@pytest.mark.parametrize(
    ("damping", "word"), [(0.0, "derivative of the steps"), (2.0, "derivative of the motion")]
)
def test_a_spring_has_no_saltation(damping: float, word: str) -> None:
    world = World.create(Penalty(900.0, damping), SemiImplicitEuler(2e-5))
    problem = BallProblem(world, 1.0, 0.0, 50_000)
    names = ["y0", "k", "damping"]
    aware, unrolled = (method(name)(problem, names) for name in ("event-aware", "unrolled"))
    assert word in aware.description
    same = aware.gradient["y0"] == pytest.approx(unrolled.gradient["y0"], rel=1e-12)
    assert same == (damping == 0.0)


# --- a parameter that is not written, not used, or used to no effect -------------------------------


def relax(tol: float, cap: int = 40):
    """The penetration that a projection leaves, as a function of its gain: a loop that may run zero times."""
    zero = zero_bits(jnp.float64)

    def loss(at):
        def body(carry):
            p, it = carry
            return p - fence(0.5 * at["k"] * p, zero), it + 1

        start = (at["p0"], 0)
        p, _ = jax.lax.while_loop(lambda c: (jnp.sum(c[0]) >= tol) & (c[1] < cap), body, start)
        return jnp.sum(p)

    return loss


@pytest.mark.parametrize(("tol", "iterations"), [(1e-2, 14), (1.0, 0)])
def test_a_loop_that_ran_no_iteration_did_not_use_the_gain(tol: float, iterations: int) -> None:
    found = dependence(relax(tol), {"k": 0.5, "p0": jnp.array([0.25, 0.2])})
    assert found == {"k": (True, iterations > 0), "p0": (True, True)}


def test_what_the_program_cannot_reach_is_not_written() -> None:
    found = dependence(lambda at: jnp.sin(at["a"]) + jax.lax.stop_gradient(at["b"]), {"a": 1.0, "b": 2.0})
    assert found == {"a": (True, True), "b": (False, False)}


def test_a_used_parameter_may_still_have_a_zero_derivative() -> None:
    def loss(at):
        # the sort has no derivative by element
        return (jnp.sort(jnp.array([3.0, 1.0]) * at["a"])[0] * 1e-200) * 1e-200

    assert jax.grad(loss)({"a": 1.0})["a"] == 0.0
    assert dependence(loss, {"a": 1.0})["a"].used


@pytest.mark.parametrize("x", [-1.0, 1.0])
def test_the_branch_taken_counts_by_element_and_by_cond(x: float) -> None:
    def by_where(at):
        y = jnp.array([x, -2.0])
        return jnp.sum(jnp.where(y < 0, at["a"], at["b"][:2]))

    def by_cond(at):
        return jax.lax.cond(jnp.asarray(x) < 0, lambda: at["a"][0], lambda: at["b"][0])

    at = {"a": jnp.ones(2), "b": jnp.ones(3)}
    assert dependence(by_where, at) == {"a": (True, True), "b": (True, x > 0)}
    assert dependence(by_cond, at) == {"a": (True, x < 0), "b": (True, x > 0)}


def test_elements_are_told_apart_through_a_scan() -> None:
    def loss(at):
        def body(carry, row):
            # only the first of two balls ever touches k
            return jnp.concatenate([carry[:1] * at["k"], carry[1:] + row]), carry[1]

        end, rows = jax.lax.scan(body, jnp.ones(2), at["u"])
        return end[1] + jnp.sum(rows)

    # a carry is one value to the text
    assert dependence(loss, {"k": 2.0, "u": jnp.ones(3)}) == {"k": (True, False), "u": (True, True)}
