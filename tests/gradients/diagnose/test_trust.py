"""How far a gradient is trusted: each limit against what it is made of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients import Problem
from mdnum.gradients.diagnose.trust import (
    Horizons,
    Limit,
    ambiguity,
    first_difference,
    horizons,
    last_agreeing,
    last_below,
    no_half_step,
    shadow_of,
    spread,
    standard_error,
    trust,
    verdict_of,
)
from mdnum.gradients.differences import richardson
from mdnum.gradients.losses import MeanPotential, MeanSquaredDisplacement
from mdnum.gradients.parameters import ParameterEntry
from mdnum.systems import build

QUINTIC = {"kind": "quintic", "radius": 2.2, "onset": 1.8}
NARROW: dict[str, Any] = {"precision": dict.fromkeys(("state", "force", "decision", "accumulate"), "float32")}


@pytest.fixture(scope="module")
def problem(smooth):
    return Problem(smooth, MeanPotential(every=7, first=5), 60)


@pytest.mark.slow
def test_every_horizon_has_the_gradient_of_its_own_run(problem):
    """A mean over frames, of which shorter runs have fewer."""
    at = spread(problem, 4)
    # those that look at nothing are left out
    assert spread(problem, 20)[0] == 6
    assert at.tolist() == [15, 30, 45, 60]
    found = horizons(problem, ("potential.sigma",), at)
    for k in (1, 3):
        shorter = replace(problem, steps=int(at[k]))
        slope = richardson(lambda q, one=shorter: one.value({"potential.sigma": q}), 1.0, 1e-4, 3)
        assert found.value[k] == pytest.approx(shorter.value(), rel=1e-12)
        assert found.gradient[k, 0] == pytest.approx(slope.value, rel=1e-7)


def made(gradient, flips=()) -> Horizons:
    gradient = np.asarray(gradient, float)[:, None]
    flips = np.array(flips, np.int64).reshape(-1, 4)
    return Horizons(np.arange(len(gradient)), (ParameterEntry("q"),), gradient[:, 0], gradient, flips)


@pytest.mark.parametrize(
    ("judge", "values", "found"),
    [
        # a single point beyond a limit does not end trust, the last one does
        (last_below, [0, 5, 0, 0, 0], (50, False)),
        (last_below, [0, 0, 5, 5, 5], (20, True)),
        (last_below, [0, 0, 0, 0, np.nan], (40, True)),
        (last_below, [2, 2, 2, 2, 2], (0, True)),
        # half the time step is judged where the gradient is asked for, and one horizon alone agrees by chance
        (last_agreeing, [5, 5, 0, 0, 0], (50, False)),
        (last_agreeing, [0, 0, 0, 5, 5], (30, True)),
        (last_agreeing, [0, 0, 5, 5, 0], (20, True)),
        (last_agreeing, [0, 0, 0, 0, np.nan], (40, True)),
    ],
)
def test_how_far_differences_stay_below_a_limit(judge, values, found):
    at = np.array([10, 20, 30, 40, 50])
    assert judge(at, {"p": np.zeros(5), "q": np.array(values, float)}, 1.0) == found


FINE = [Limit(what, 2000, False, "agree") for what in ("rounding", "time step", "near miss")]


@pytest.mark.parametrize(
    ("scatter", "grew", "skipped", "verdict"),
    [
        # a gradient that grew is not trusted before other starts were looked at
        ((None, False), True, False, ("undecided", 2000, "", ("other starts",))),
        ((None, False), False, False, ("trusted", 2000, "", ())),
        ((None, False), False, True, ("undecided", 2000, "", ("parameters of many entries",))),
        ((2000, False), True, False, ("trusted", 2000, "", ())),
        ((350, True), True, False, ("limited", 350, "standard error", ())),
    ],
)
def test_the_verdict_follows_from_the_limits(scatter, grew, skipped, verdict):
    limits = [*FINE, Limit("standard error", *scatter, "scatter")]
    assert verdict_of(limits, 2000, grew, skipped) == verdict


def test_the_standard_error_is_that_of_the_mean():
    runs = [made([1.0, 1.0]), made([1.0, -1.0]), made([1.0, 3.0])]
    assert standard_error(runs)["q"].tolist() == pytest.approx([0.0, 2 / np.sqrt(3)])


@pytest.mark.parametrize(
    ("first", "second", "step"),
    [
        ([], [], None),
        ([(3, 0, 1, 1)], [(3, 0, 1, 1)], None),
        ([(3, 0, 1, 1), (5, 0, 2, 1)], [(3, 0, 1, 1)], 5),
        ([(3, 0, 1, 1), (5, 0, 2, 1)], [(3, 0, 1, 1), (4, 0, 2, 0)], 4),
    ],
)
def test_the_first_flip_that_differs_is_found(first, second, step):
    assert first_difference(made([1.0], first), made([2.0], second)) == step


def test_a_shadow_is_wider_where_there_is_a_wider_format(problem):
    ours, none = shadow_of(problem.simulation)
    moved = np.abs(ours.positions - problem.simulation.positions)
    assert not none and 0 < moved.max() < 1e-14
    wide, narrow = shadow_of(build(make(crystal(), LENNARD_JONES, QUINTIC, **NARROW)))
    assert narrow == ("float32",) and wide.decider.dtype == "float64"
    force = eqx.filter(wide.force, eqx.is_inexact_array)
    assert {str(leaf.dtype) for leaf in jax.tree.leaves(force)} == {"float64"}
    # half the time step of a thermostat is another noise
    dynamics = {"kind": "langevin", "friction": 1.0, "timestep": 0.004, "temperature": 1.0, "seed": 3}
    assert no_half_step(build(make(crystal(), LENNARD_JONES, QUINTIC, dynamics=dynamics)))
    assert not no_half_step(problem.simulation)


@pytest.mark.slow
def test_a_shell_at_the_cutoff_is_an_ambiguous_decision(problem):
    shell = build(make(crystal(rattle=0), LENNARD_JONES, {"kind": "quintic", "radius": 1.8, "onset": 1.5}))
    found = ambiguity(replace(problem, simulation=shell))
    assert found.reached and found.horizon == 0 and found.values["step"] == 0
    assert not ambiguity(problem).reached


def test_bad_input_is_refused(problem):
    with pytest.raises(InputError, match="too many entries"):
        trust(problem, ("v0",))
    with pytest.raises(InputError, match="tolerance"):
        trust(problem, ("sigma",), tolerance=2.0)


@pytest.mark.nightly
def test_rounding_limits_a_narrow_run_where_it_has_grown_to_the_tolerance():
    simulation = build(make(crystal(), LENNARD_JONES, QUINTIC, **NARROW))
    problem = Problem(simulation, MeanSquaredDisplacement(), 400)
    found = trust(problem, ("sigma",), tolerance=1e-4, points=20)
    rounding, step, near, ambiguous, scatter = found.limits
    assert rounding.horizon is not None and ambiguous.horizon is not None and step.horizon is not None
    assert rounding.reached and 100 < rounding.horizon < 400 and scatter.horizon is None
    # a cutoff without a jump: no pair that turns around near it, or near its onset, adds anything
    assert near.horizon == 400 and not near.reached and len(found.turns) == 0
    apart, at = found.table["relative.potential.sigma"], found.table["horizon"]
    assert np.all(apart[at <= rounding.horizon] <= 1e-4) and apart[0] < 1e-5
    assert found.horizon == min(rounding.horizon, ambiguous.horizon, step.horizon)
    assert found.verdict == "limited" and len(apart) == 20
