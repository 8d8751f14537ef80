"""From tables to objects: starts, controls, rules and worlds are those that the file describes."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import ml_dtypes
import numpy as np
import pytest

from mdnum.ball import problem as losses
from mdnum.ball import step, stopping
from mdnum.errors import InputError
from mdnum.numerics.reductions import Blocked, Permuted
from mdnum.systems import build_ball, load
from mdnum.systems.ball import BallSpec
from mdnum.systems.build_ball import problem, start

IMPACT = {"kind": "impact"}
SPRING = {"kind": "penalty", "k": 100.0}
SOLVED = {"kind": "projection", "k": 0.5, "alpha": 0.25, "restitution": 0.75}
EULER = {"kind": "semi-implicit-euler", "timestep": 0.01, "steps": 8}


def spec(contact: dict[str, Any], **tables: Any) -> BallSpec:
    return BallSpec.model_validate({"world": "ball", "contact": contact, "integrator": EULER, **tables})


def test_heights_and_velocities():
    y, v = start(spec(SPRING, start={"height": [1.0, 2.0], "velocity": 3.0}))
    assert (y.tolist(), v.tolist()) == ([1.0, 2.0], [3.0, 3.0])
    y, _ = start(spec(SPRING, start={"height": 1.0, "balls": 5, "spread": 0.5}))
    assert y.tolist() == [0.5, 0.75, 1.0, 1.25, 1.5]


@pytest.mark.parametrize("height", [1.3, 0.999, -1.3])
@pytest.mark.parametrize("name", ["float16", "bfloat16", "float32", "float64"])
def test_adjacent_starts_are_adjacent_in_the_dtype_of_the_state(name: str, height: float):
    # heights that are no floats of any of them, or lie next to where the spacing doubles
    rows = {"height": height, "balls": 4, "spread_ulps": 1}
    y, _ = start(spec(SPRING, start=rows, precision={"state": name}))
    dtype = np.dtype(getattr(ml_dtypes, name)) if name == "bfloat16" else np.dtype(name)
    held = y.astype(dtype)
    assert np.array_equal(held.astype(np.float64), y), "each is a float of the dtype"
    bits = np.diff(held.view(f"i{dtype.itemsize}").astype(np.int64)).tolist()
    assert bits == ([1, 1, 1] if height > 0 else [-1, -1, -1])


def test_penetrations_on_the_boundary_sum_to_the_tolerance_exactly():
    system = load("ball/batch-on-the-boundary")
    y, v = start(system.spec)
    assert sum((Fraction(p) for p in -y), Fraction(0)) == Fraction(system.spec.stop.tol)
    assert not v.any()
    low = np.dtype(ml_dtypes.bfloat16)
    assert np.array_equal(y.astype(low).astype(np.float64), y)
    # largest first, each of the small ones is lost in the low format
    total = np.zeros((), low)
    for p in (-y).astype(low):
        total = (total + p).astype(low)
    assert total < low.type(system.spec.stop.tol)


@pytest.mark.parametrize(
    ("control", "pushes"),
    [
        (None, None),
        ({"kind": "constant", "value": 2.0}, [2.0] * 8),
        ({"kind": "sine", "amplitude": 2.0, "period": 0.04, "phase": 0.0}, [0, 2, 0, -2, 0, 2, 0, -2]),
        ({"kind": "values", "values": (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)}, list(range(8))),
    ],
)
def test_controls(control: dict[str, Any] | None, pushes: list[float] | None):
    flight = {"gravity": 0.0} | ({} if control is None else {"control": control})
    made = problem(spec(SPRING, flight=flight)).world.control
    assert (made is None) if pushes is None else np.allclose(made, pushes, atol=1e-14)


def test_contacts():
    spring = problem(spec({**SPRING, "damping": 2.0, "hysteresis": 0.25})).world
    assert isinstance(spring.contact, step.Penalty) and float(spring.lift) == 0.25
    assert (float(spring.contact.k), float(spring.contact.damping)) == (100.0, 2.0)
    assert not spring.contact.smooth
    soft = problem(spec({**SPRING, "eps": 0.1})).world.contact
    assert soft.smooth and float(soft.eps) == 0.1
    table = spec(SOLVED, stop={"rule": "sum", "tol": 1e-3, "max_iter": 7})
    solved = problem(table).world.contact
    assert isinstance(solved, step.Projection)
    assert (float(solved.k), float(solved.alpha), float(solved.restitution)) == (0.5, 0.25, 0.75)


@pytest.mark.parametrize(
    ("kind", "contact", "made"),
    [
        ("explicit-euler", IMPACT, step.ExplicitEuler),
        ("semi-implicit-euler", IMPACT, step.SemiImplicitEuler),
        ("velocity-verlet", IMPACT, step.BallVerlet),
        ("event-located", IMPACT, step.EventLocated),
        ("implicit-midpoint", SPRING, step.ImplicitMidpoint),
    ],
)
def test_integrators(kind: str, contact: dict[str, Any], made: type):
    rule = {"stop": {"rule": "maximum", "tol": 1e-9}} if kind == "implicit-midpoint" else {}
    integrator = problem(spec(contact, integrator={**EULER, "kind": kind}, **rule)).world.integrator
    assert type(integrator) is made and float(integrator.h) == 0.01
    assert not rule or isinstance(integrator.stop, stopping.Maximum)


@pytest.mark.parametrize(
    ("rule", "made"),
    [
        ("sum", stopping.GlobalSum),
        ("relative", stopping.Relative),
        ("per-instance", stopping.PerInstance),
        ("maximum", stopping.Maximum),
    ],
)
def test_stopping_rules(rule: str, made: type):
    stop = problem(spec(SOLVED, stop={"rule": rule, "tol": 1e-3, "max_iter": 7})).world.contact.stop
    assert type(stop) is made and (float(stop.tol), stop.max_iter) == (1e-3, 7)
    two = problem(spec(SOLVED, stop={"rule": rule, "tol": 1e-3, "enter": 1e-2})).world.contact.stop
    assert isinstance(two, stopping.HysteresisStop) and float(two.enter) == 1e-2


def test_rules_with_a_number():
    for text, made in (("blocked:4", Blocked(4)), ("permuted:3", Permuted(3))):
        table = spec(SOLVED, stop={"rule": "sum", "tol": 1e-3}, precision={"reduction": text})
        assert problem(table).world.contact.stop.reduction == made
    assert problem(spec(SOLVED, stop={"rule": "fixed", "count": 3})).world.contact.stop.count == 3


def test_precision_and_loss():
    low = {"state": "float16", "loss": "float32", "rounding": "stochastic", "seed": 5}
    made = problem(spec(SPRING, precision=low, loss={"kind": "mean-height"}))
    policy = made.world.policy
    assert (policy.state, policy.arithmetic, policy.loss) == ("float16", "float64", "float32")
    assert (policy.rounding, policy.seed) == ("stochastic", 5)
    assert isinstance(made.loss, losses.MeanHeight)
    assert problem(spec(SPRING, loss={"target": 0.5})).loss.target == 0.5


def test_build_makes_every_variant_and_takes_other_steps():
    built = build_ball("ball/drop", {"contact.k": "2e4"}, steps=12)
    assert built.problem.steps == 12
    assert float(built.problem.world.contact.k) == 2e4
    names = [variant.name for variant in built.variants]
    assert names == ["float32", "velocity-verlet", "explicit-euler"]
    assert all(variant.problem.steps == 12 for variant in built.variants)
    assert isinstance(built.variants[1].problem.world.integrator, step.BallVerlet)
    assert built.problem.run().steps == 12


def test_what_the_world_refuses_names_the_system(monkeypatch: pytest.MonkeyPatch):
    def refuse(*arguments: Any, **options: Any):
        raise InputError("no such world")

    monkeypatch.setattr("mdnum.ball.world.World.create", refuse)
    with pytest.raises(InputError, match="here: no such world"):
        problem(spec(SPRING), where="here")
