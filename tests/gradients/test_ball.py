"""Each derivative against an oracle of its own: closed forms, finite differences, exact motions."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.ball import ExactImpact, ExactPenalty
from mdnum.ball.problem import BallProblem, MeanHeight, ResidualPenetration
from mdnum.ball.step import BallVerlet, EventLocated, Impact, Penalty, Projection, SemiImplicitEuler
from mdnum.ball.stopping import GlobalSum, PerInstance
from mdnum.ball.world import World
from mdnum.errors import InputError, MdnumError
from mdnum.gradients.ball import BALL_METHODS, compare, dependence
from mdnum.numerics.exact import fence, zero_bits
from mdnum.numerics.roles import RolePrecision

IMPACT = ("y0", "restitution", "gravity")


def gradient(name: str, problem: BallProblem, *names: str, **options: Any):
    """By a method with options."""
    return BALL_METHODS[name](**options)(problem, names)


def relaxation(tol: float, p0=(0.45,), rule=GlobalSum, k: float = 0.5, most: int = 200) -> BallProblem:
    """One step without gravity from below the floor: the projection and nothing else."""
    world = World.create(Projection(k, 0.5, rule(tol, most)), SemiImplicitEuler(1.0), gravity=0.0)
    return BallProblem(world, -np.array(p0), 0.0, 1, ResidualPenetration(1))


def bouncing(h: float = 1e-3, end: float = 2.0, y0: Any = 1.0) -> BallProblem:
    """Plain steps: by default 2,000 of them, one program for all that ask for no other."""
    return BallProblem(World.create(Impact(), SemiImplicitEuler(h)), y0, 0.0, round(end / h))


@pytest.mark.parametrize(("tol", "n", "k"), [(1e-2, 14, -7.5e-2), (1e-4, 30, -1.6e-3), (1e-6, 46, -2.5e-5)])
def test_the_unrolled_gain_is_an_artefact_of_the_tolerance_and_the_implicit_one_is_zero(tol, n, k):
    problem = relaxation(tol)
    unrolled = gradient("unrolled", problem, "k", "y0")
    # p0 (1 - alpha k)^n, differentiated by hand
    np.testing.assert_allclose(unrolled.gradient["k"], -0.45 * n * 0.75 ** (n - 1) * 0.5, rtol=1e-13)
    np.testing.assert_allclose(unrolled.gradient["k"], k, rtol=0.02)
    np.testing.assert_allclose(unrolled.gradient["y0"], -(0.75**n), rtol=1e-13)
    np.testing.assert_allclose(unrolled.value, 0.45 * 0.75**n, rtol=1e-13)
    assert unrolled.details["iterations"] == n
    implicit = gradient("implicit", problem, "k", "y0")
    assert implicit.gradient == {"k": 0.0, "y0": 0.0}
    assert implicit.value == unrolled.value
    assert implicit.notes["k"] != unrolled.notes["k"]
    assert unrolled.depends == {"k": True, "y0": True}
    assert implicit.depends == {"k": False, "y0": False}
    # taking the stopped iterate for the fixed point lets the tolerance back in: p / k
    near = gradient("implicit", problem, "k", "y0", at_iterate=True)
    np.testing.assert_allclose(near.gradient["k"], -unrolled.value / 0.5, rtol=1e-11)


def test_a_gain_that_no_iteration_used_is_said_not_to_matter():
    for rule in (GlobalSum, PerInstance):
        found = gradient("unrolled", relaxation(1.0, (0.25,), rule), "k", "y0")
        assert found.gradient["k"] == 0.0
        assert found.depends == {"k": False, "y0": True}
        assert "k" in found.notes
    flying = gradient("unrolled", bouncing(y0=100.0), "restitution")
    assert not flying.depends["restitution"]
    assert "restitution" in flying.notes


@pytest.mark.slow
def test_frozen_is_the_derivative_of_the_pinned_program():
    control = 3.0 * np.sin(np.arange(60.0))[:, None] * np.array([1.0, 0.5])
    contact = Projection(0.5, 0.5, GlobalSum(1e-3, 60))
    world = World.create(contact, SemiImplicitEuler(1e-2), control=control)
    problem = BallProblem(world, np.array([0.05, 0.2]), 0.0, 60, MeanHeight())
    names = ("k", "alpha", "restitution", "gravity", "y0", "v0")
    frozen, unrolled = (gradient(word, problem, *names) for word in ("frozen", "unrolled"))
    assert frozen.value == unrolled.value == problem.value()
    assert frozen.details["iterations"] > 20
    for name in names:
        np.testing.assert_allclose(frozen.gradient[name], unrolled.gradient[name], rtol=1e-13, err_msg=name)
        difference = frozen.details["finite_difference"][name]
        np.testing.assert_allclose(frozen.gradient[name], difference, rtol=1e-6, atol=1e-9, err_msg=name)


def test_located_impacts_have_the_derivative_of_the_exact_motion():
    problem = BallProblem(World.create(Impact(0.8), EventLocated(1e-2)), 1.0, 0.5, 200)
    found = gradient("event-aware", problem, *ExactImpact.NAMES)
    assert found.details == {"events": 3, "located": True}
    exact = ExactImpact(1.0, 0.5, 9.81, 0.8).height(2.0)
    np.testing.assert_allclose(found.value, exact.value, rtol=1e-12)
    for name, slope in exact.gradient.items():
        np.testing.assert_allclose(found.gradient[name], slope, rtol=1e-8, err_msg=name)


@pytest.mark.slow
def test_steps_alone_never_learn_of_the_start_and_saltation_does_to_order_h():
    # the mean over heights averages out where in its step each impact falls; an eighth of the step at the end
    starts = np.linspace(0.98, 1.02, 41)
    each = [ExactImpact(y0, 0.0, 9.81, 0.8).height(2.0).gradient for y0 in starts]
    exact, errors = [np.mean([one[name] for one in each]) for name in IMPACT], []
    for h in (2e-3, 2.5e-4):
        problem = bouncing(h, y0=starts)
        assert problem.value_and_grad(["y0"])[1]["y0"] == 0.0
        aware = gradient("event-aware", problem, *IMPACT)
        assert aware.depends["y0"] and aware.details["events"] == 3 * 41
        errors.append(np.abs([aware.gradient[name] for name in IMPACT] / np.array(exact) - 1))
    assert np.all(errors[1] < 0.05)
    # order 1: an eighth of the error at an eighth of the step
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]) / 3, 1.0, atol=0.2)


@pytest.mark.parametrize("scheme", [SemiImplicitEuler, BallVerlet])
def test_a_damper_that_sets_in_with_a_jump_needs_the_saltation_too(scheme):
    names = ("y0", "k", "damping")
    # half the step for half the time is the same program: the ball then starts nearer to its contact
    for h, y0, v0 in ((2e-5, 1.0, 0.0), (1e-5, 0.3, -3.0)):
        exact = ExactPenalty(y0, v0, 9.81, 1e4, 20.0).height(50_000 * h)
        problem = BallProblem(World.create(Penalty(1e4, damping=20.0), scheme(h)), y0, v0, 50_000)
        plain, aware = (gradient(word, problem, *names) for word in ("unrolled", "event-aware"))
        np.testing.assert_allclose(plain.value, exact.value, atol=30 * h)
        off = {name: abs(plain.gradient[name] / exact.gradient[name] - 1) for name in names}
        # by k the steps alone have the wrong sign, at every step size
        assert off["k"] > 1.5 and off["damping"] > 0.02
        for name in names:
            np.testing.assert_allclose(aware.gradient[name], exact.gradient[name], rtol=0.01, err_msg=name)


@pytest.mark.parametrize(("damping", "word"), [(0.0, "of the steps"), (2.0, "of the motion")])
def test_a_spring_has_no_saltation(damping: float, word: str):
    problem = BallProblem(World.create(Penalty(900.0, damping), SemiImplicitEuler(2e-5)), 1.0, 0.0, 50_000)
    aware, plain = (gradient(name, problem, "y0", "k", "damping") for name in ("event-aware", "unrolled"))
    assert f"derivative {word}" in aware.description
    same = aware.gradient["y0"] == pytest.approx(plain.gradient["y0"], rel=1e-12)
    assert same == (damping == 0.0)


def test_a_smooth_floor_is_another_program_near_the_given_one():
    exact, biases, errors = ExactImpact(1.0).height(1.0), [], []
    for eps in (4e-2, 2e-2, 1e-2):
        soft = gradient("smoothed", bouncing(2e-5, 1.0), "y0", "restitution", eps=eps)
        biases.append(abs(soft.value - exact.value))
        errors.append(abs(soft.gradient["y0"] - exact.gradient["y0"]))
    assert biases[0] > 1.6 * biases[1] > 2.6 * biases[2]
    assert errors[0] > 1.5 * errors[1] > 2.25 * errors[2]
    assert errors[-1] < 0.05 * exact.gradient["y0"]


def test_random_smoothing_sees_through_jumps_with_an_honest_standard_error():
    width = 0.05
    # E[loss(k + sigma x) x] / sigma by the trapezoidal rule, the loss written as a loop
    x = np.linspace(-8, 8, 200_001)
    p, gain = np.full(x.shape, 0.45), 0.5 * (0.5 + width * 0.5 * x)
    while np.any(p >= 1e-3):
        p = np.where(p >= 1e-3, p - gain * p, p)
    exact = np.trapezoid(p * x * np.exp(-x * x / 2), x) / np.sqrt(2 * np.pi) / (width * 0.5)
    pulls = []
    for seed in range(6):
        options: dict[str, Any] = {"width": width, "samples": 2000, "seed": seed}
        found, again = (gradient("randomized", relaxation(1e-3), "k", **options) for _ in range(2))
        pulls.append((found.gradient["k"] - exact) / found.details["standard_error"]["k"])
        assert again.gradient == found.gradient
    assert np.max(np.abs(pulls)) < 4
    assert 0.3 < np.std(pulls) < 2.5


def test_loss_scaling_brings_back_what_float16_loses():
    policy = RolePrecision("float16", "float16", "float32", "float32", "float32")
    top, tiny = float(np.nextafter(np.float16(1e-3), np.float16(0))), 2.0**-23
    contact = Projection(0.5, 0.5, GlobalSum(float(np.float16(1e-3)), 25))
    world = World.create(contact, SemiImplicitEuler(1e-2), gravity=0.0, policy=policy)
    problem = BallProblem(world, -np.array([top] + [tiny] * 8), 0.0, 4, ResidualPenetration())
    plain, scaled = (gradient("unrolled", problem, "k", loss_scale=scale) for scale in (1.0, 2.0**16))
    # 2 p1 dp1/dk / 9 in real arithmetic
    exact = -2 * (0.75 * top) * 0.5 * top / 9
    assert plain.gradient["k"] == -(2.0**-23)
    assert abs(plain.gradient["k"] / exact - 1) > 0.4
    np.testing.assert_allclose(scaled.gradient["k"], exact, rtol=1e-3)


def test_a_comparison_runs_what_applies_and_says_why_the_rest_does_not():
    made = compare(bouncing(), ["y0"])
    assert [one.method for one in made] == ["unrolled", "frozen", "event-aware", "smoothed", "randomized"]
    assert "not solved by iteration" in made.refused["implicit"]
    assert len({one.description for one in made}) == 5
    assert set(BALL_METHODS) == {*made.refused, *(one.method for one in made)}


def hover() -> BallProblem:
    """Sinks through the floor at 1e-9 m/s: the time of its contact is nowhere near differentiable."""
    world = World.create(Impact(0.8, rest_speed=0.0), SemiImplicitEuler(0.125))
    return BallProblem(world, 1e-10, 9.81 * 0.125 - 1e-9, 1)


@pytest.mark.parametrize(
    ("word", "problem", "name", "options", "message"),
    [
        ("implicit", relaxation(1e-2, k=1e-13, most=3), "k", {}, "linear system is 2e\\+13"),
        ("event-aware", hover(), "y0", {}, "graze"),
        ("smoothed", bouncing(1e-2, 1.0), "y0", {"eps": 1e-3}, "too fast"),
        ("smoothed", bouncing(1e-2, 1.0), "y0", {"eps": 0.0}, "width"),
        ("randomized", relaxation(1e-3), "k", {"samples": 1}, "2 samples"),
        ("unrolled", relaxation(1e-2), "damping", {}, "parameter 'damping'"),
    ],
)
def test_what_has_no_such_derivative_is_refused(word, problem, name, options, message):
    with pytest.raises(MdnumError, match=message):
        gradient(word, problem, name, **options)
    with pytest.raises(InputError, match="gradient 'adjoint'"):
        compare(problem, [name] if name != "damping" else ["k"], ["adjoint"])
    if word == "implicit":
        helped = gradient(word, problem, "k", "y0", regularization=1e-3)
        assert helped.details["condition"] < 1e4 and helped.gradient["k"] == 0.0


# --- a parameter that is not written, not used, or used to no effect -------------------------------


def relax(tol: float):
    """The penetration that a projection leaves, as a function of its gain: a loop that may run zero times."""
    zero = zero_bits(jnp.float64)

    def loss(at):
        def body(p):
            return p - fence(0.5 * at["k"] * p, zero)

        return jnp.sum(jax.lax.while_loop(lambda p: jnp.sum(p) >= tol, body, at["p"]))

    return loss


def flat(at):
    # the sort has no derivative by element
    return (jnp.sort(jnp.array([3.0, 1.0]) * at["a"])[0] * 1e-200) * 1e-200


def by_where(at, x=1.0):
    return jnp.sum(jnp.where(jnp.array([x, -2.0]) < 0, at["a"], at["b"]))


def by_cond(at, x=1.0):
    return jax.lax.cond(jnp.asarray(x) < 0, lambda: at["a"][0], lambda: at["b"][0])


def by_scan(at):
    def body(carry, row):
        # only the first of two balls ever touches k
        return jnp.concatenate([carry[:1] * at["k"], carry[1:] + row]), carry[1]

    end, rows = jax.lax.scan(body, jnp.ones(2), at["u"])
    return end[1] + jnp.sum(rows)


YES, UNUSED, UNWRITTEN = (True, True), (True, False), (False, False)
PAIR = {"a": jnp.ones(2), "b": jnp.ones(2)}


@pytest.mark.parametrize(
    ("loss", "values", "expected"),
    [
        (relax(1e-2), {"k": 0.5, "p": jnp.array([0.25, 0.2])}, (YES, YES)),
        (relax(1.0), {"k": 0.5, "p": jnp.array([0.25, 0.2])}, (UNUSED, YES)),
        (
            lambda at: jnp.sin(at["a"]) + jax.lax.stop_gradient(at["b"]),
            {"a": 1.0, "b": 2.0},
            (YES, UNWRITTEN),
        ),
        # used, with a derivative of zero
        (flat, {"a": 1.0}, (YES,)),
        # the branch taken counts, by element and by cond
        (by_where, PAIR, (YES, YES)),
        (lambda at: by_where(at, -1.0), PAIR, (YES, UNUSED)),
        (by_cond, PAIR, (UNUSED, YES)),
        (lambda at: by_cond(at, -1.0), PAIR, (YES, UNUSED)),
        # elements are told apart through a scan, whose carry is one value to the text
        (by_scan, {"k": 2.0, "u": jnp.ones(3)}, (UNUSED, YES)),
    ],
)
def test_what_the_run_used_is_told_from_what_has_a_derivative_of_zero(loss, values, expected):
    assert tuple(dependence(loss, values).values()) == expected
    assert loss is not flat or jax.grad(loss)(values)["a"] == 0.0
