"""Pairs that nearly flipped: planted ones, against energy conservation and runs in which they flip."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ase import Atoms
from scipy.integrate import quad
from scipy.optimize import brentq
from small_systems import LENNARD_JONES, make

from mdnum.gradients import Problem
from mdnum.gradients.diagnose import growth, trust
from mdnum.gradients.diagnose.near import FINER, REACH, Near, Turns
from mdnum.gradients.diagnose.trust import GROWN, grew, shorter, spread
from mdnum.gradients.losses import EinsteinDiffusion, MeanPotential, MeanSquaredDisplacement
from mdnum.gradients.recorded import EventAware, passed
from mdnum.gradients.tape import pace_of
from mdnum.systems import build

R_CUT, START = 2.5, 1.05

NAMES = ("r_cut", "epsilon", "dt", "sigma")


def u(r):
    return 4 * (r**-12 - r**-6)


#: A dimer that is let go compressed stretches up to here: its energy is conserved.
FARTHEST: Any = brentq(lambda r: u(r) - u(START), 1.13, 2.0, xtol=1e-15)


def problem(gap: float, timestep: float, time: float = 0.6, radius: float = R_CUT, loss=None):
    """A dimer along x, and a third atom: the nearer of the two would come to within `gap` of the cutoff."""
    middle = np.array([6.0, 7.0, 7.0])
    x = middle + np.array([[-START / 2, 0, 0], [START / 2, 0, 0], [FARTHEST / 2 + R_CUT + gap, 0, 0]])
    atoms = Atoms("Ar3", positions=x, velocities=np.zeros((3, 3)), cell=[14.0] * 3, pbc=True)
    atoms.set_masses(np.ones(3))
    atoms.set_momenta(np.zeros((3, 3)) + 1e-300)
    dynamics = {"kind": "nve", "timestep": timestep}
    cutoff = {"kind": "hard", "radius": radius}
    simulation = build(make(atoms, LENNARD_JONES, cutoff, dynamics=dynamics))
    return Problem(simulation, loss or MeanSquaredDisplacement(), round(time / timestep))


def limit(found, what):
    return next(one for one in found.limits if one.what == what)


def farthest(timestep: float) -> float:
    """Largest distance that steps of the dimer alone reach, by velocity Verlet written out."""
    r, v, steps = START, 0.0, round(0.6 / timestep)

    def a(r):
        return 2 * (48 * r**-13 - 24 * r**-7)

    seen = []
    for _ in range(steps):
        half = v + timestep / 2 * a(r)
        r += timestep * half
        v = half + timestep / 2 * a(r)
        seen.append((r, v))
    k = int(np.argmax([one[0] for one in seen]))
    # a parabola through the three steps around it
    y = np.array([seen[k + n][0] for n in (-1, 0, 1)])
    return float(y[1] - (y[2] - y[0]) ** 2 / (8 * (y[2] - 2 * y[1] + y[0])))


#: A time step, and how much farther the exact motion of an atom of the dimer comes than that of half of it.
STEP = 0.01
SHORT = (FARTHEST - farthest(STEP / 2)) / 2


@pytest.fixture(scope="module")
def planted():
    return problem(-0.5 * SHORT, STEP)


@pytest.fixture(scope="module")
def judged(planted):
    return trust(planted, NAMES)


def test_a_near_miss_that_no_time_step_tried_shows_is_not_trusted(planted, judged):
    """At this time step and at half of it nothing flips; the exact motion enters: its gradient is not 0."""
    timestep, short, found = STEP, SHORT, judged
    assert 0 < short < (FARTHEST - farthest(timestep)) / 2 < 1e-3
    own = EventAware()(planted, ("r_cut", "dt"))
    assert own.details["crossings"] == 0
    assert found.half["cutoff.radius"].tolist() == [0.0]
    near = limit(found, "near miss")
    assert near.reached and near.horizon == 35 and found.verdict == "limited"
    assert found.turns is not None
    (row,) = found.turns.heaviest(found.columns, lambda kind: {})
    assert (row["i"], row["j"]) == (1, 2)
    # what it is beyond the cutoff by, in shorter steps, is known from the steps alone
    assert row["gap"] == pytest.approx((FARTHEST - farthest(timestep / FINER)) / 2 - 0.5 * short, rel=0.05)
    # with a time step at which it does enter, the derivative is of the size that was told
    finer = EventAware()(problem(-0.5 * short, timestep / 16), ("r_cut", "dt"))
    true = float(finer.gradient["cutoff.radius"])
    assert true != 0 and 1 < abs(row["term"]["cutoff.radius"] / true) < 25
    # at a fixed number of steps, twice as many of half the length move with it as far as one of them
    by_time = float(own.gradient["dynamics.timestep"])
    assert found.half["dynamics.timestep"][0] == pytest.approx(by_time, rel=0.02)


def test_the_term_of_a_near_miss_is_that_of_the_least_depth_that_is_likely():
    """Two crossings at a depth d add 2 w / sqrt(2 a d): those of a shallow one, or their change."""
    shift, bend, weight = np.array([3e-4, 1e-3, 5e-5, 2e-4, 1e-4]), np.array([4.0, 0.3, 7.0, 2.0, 5.0]), 0.8
    moved = np.array([[1.0, -0.2], [0.5, 3.0], [-2.0, 0.1], [0.7, 0.0], [0.9, -1.0]])
    table = {"step": np.arange(5), "shift": shift, "bend": bend, "weight": np.full(5, weight), "moved": moved}
    # within reach on either side; out of reach; beyond the cutoff between two steps alone, far within; beyond
    # it in all steps, and further in the shorter ones
    table |= {"gap": np.array([1e-3, -1.5e-4, 0.02, -0.01, -0.01]), "unseen": np.arange(5) == 3}
    table |= {"side": np.array([-1, 1, 1, 1, -1]), "finer": np.array([9.5e-4, 0.0, 0.0, 0.0, 0.03])}
    turns = Turns(table)
    np.testing.assert_allclose(turns.gap, [5e-5, -1.5e-4, 0.02, -0.01, -0.04], rtol=1e-9)
    # the typical shift is that of all five; what moves further than others reaches further
    typical = np.sqrt(np.mean(shift**2))
    np.testing.assert_allclose(turns.reach, REACH * np.maximum(shift, typical), rtol=1e-12)
    assert turns.within.tolist() == [True, True, False, True, False]
    for k in (0, 1):
        # of depths that are all alike likely one in a hundred is less deep
        shallow = 2 * weight / np.sqrt(2 * bend[k] * turns.reach[k] / 100)
        np.testing.assert_allclose(turns.term[k], np.abs(moved[k]) * shallow, rtol=1e-12)
        mean, _ = quad(lambda d, a=bend[k]: 2 * weight / np.sqrt(2 * a * d), 0, turns.reach[k])
        assert shallow == pytest.approx(5 * mean / turns.reach[k], rel=1e-6)
    assert not turns.term[2].any()
    np.testing.assert_allclose(turns.term[3], np.abs(moved[3]) * 2 * weight / np.sqrt(2 * 2.0 * 0.01))
    differ = 1 / np.sqrt(2 * 5.0 * 0.01) - 1 / np.sqrt(2 * 5.0 * 0.04)
    np.testing.assert_allclose(turns.term[4], np.abs(moved[4]) * 2 * weight * differ)


def test_a_near_miss_counts_against_the_derivatives_that_it_adds_to(planted, judged):
    """How far a dimer stretches does not depend on the depth of its well, nor does the near miss: all of the
    derivative by the cutoff is in doubt, and none of that by epsilon."""
    cutoff, epsilon = judged.by["cutoff.radius"], judged.by["potential.epsilon"]
    assert (cutoff.verdict, cutoff.limited_by, cutoff.horizon) == ("limited", "near miss", 35)
    assert (epsilon.verdict, epsilon.horizon, epsilon.limited_by) == ("trusted", planted.steps, "")
    shares = {
        name: next(one.values["share"] for one in judged.by[name].limits if one.what == "near miss")
        for name in judged.by
    }
    assert shares["cutoff.radius"] > 1 > 0.01 > 10 * shares["potential.epsilon"]
    # all parameters together are as good as the worst
    assert (judged.verdict, judged.limited_by, judged.horizon) == ("limited", "near miss", 35)
    # differences of runs at a sixteenth of the time step
    fine = problem(-0.5 * SHORT, STEP / 16)
    high, low = (fine.value({"potential.epsilon": 1 + shift}) for shift in (1e-6, -1e-6))
    own = EventAware()(planted, ("r_cut", "epsilon", "dt", "sigma")).gradient["potential.epsilon"]
    assert float(own) == pytest.approx((high - low) / 2e-6, rel=0.05)


@pytest.mark.parametrize("loss", [None, MeanPotential()])
def test_the_weight_of_a_near_miss_is_what_its_flips_add_when_it_flips(loss):
    """Of a pair that is deep inside for a while the gradient itself has both terms."""
    gap, depth, timestep = 5e-4, 2e-3, 0.002
    missed = problem(gap, timestep, loss=loss)
    near = Near(missed.simulation, pace_of(missed.loss, missed.steps))
    passed(missed, ("cutoff.radius", "dynamics.timestep"), watches=[near.reverse])
    turns = near.turns(0).table
    (k,) = np.flatnonzero((turns["i"] == 1) & (turns["j"] == 2) & (turns["gap"] > 0) & (turns["gap"] < 1e-3))
    assert turns["gap"][k] == pytest.approx(gap, rel=0.02)
    inside = problem(gap, timestep, radius=R_CUT + gap + depth, loss=loss)
    true = EventAware()(inside, ("r_cut", "dt"))
    assert true.details["crossings"] == 2
    told = 2 * turns["weight"][k] / np.sqrt(2 * turns["bend"][k] * depth)
    assert told == pytest.approx(float(true.gradient["cutoff.radius"]), rel=0.1)


def test_a_pair_that_is_inside_between_two_steps_alone_is_seen():
    """Two free atoms that pass each other: no time step and no rounding moves them."""
    closest, speed, timestep = R_CUT - 1e-3, 1.0, 0.2
    # a third one far from both
    x = np.array([[3.0, 7.0, 7.0], [3.0 + speed * 1.5 * timestep, 7.0 + closest, 7.0], [10.0, 12.0, 13.0]])
    atoms = Atoms("Ar3", positions=x, cell=[14.0] * 3, pbc=True)
    atoms.set_masses(np.ones(3))
    atoms.set_momenta([[speed, 0, 0], [0, 0, 0], [0, 0, 0]])
    dynamics = {"kind": "nve", "timestep": timestep}
    cutoff = {"kind": "hard", "radius": R_CUT}
    simulation = build(make(atoms, LENNARD_JONES, cutoff, dynamics=dynamics))
    passing = Problem(simulation, MeanSquaredDisplacement(), 4)
    near = Near(simulation, pace_of(passing.loss, passing.steps))
    made = passed(passing, ("cutoff.radius", "dynamics.timestep"), watches=[near.reverse])
    assert sum(map(len, made.crossings)) == 0
    found = near.turns(1)
    turns = found.table
    assert turns["unseen"].tolist() == found.within.tolist() == [True] and turns["step"].tolist() == [2]
    assert turns["gap"][0] == pytest.approx(-1e-3, rel=1e-3)
    assert turns["bend"][0] == pytest.approx(speed**2 / closest, rel=0.01)


def test_nothing_is_trusted_that_was_not_looked_at(monkeypatch):
    wide = problem(0.01, 0.01)
    found = trust(wide, NAMES, tolerance=0.03)
    assert found.verdict == "trusted"
    assert found.digits["potential.sigma"] == 1 and not limit(found, "near miss").reached
    blind = trust(wide, NAMES, tolerance=0.03, half_step=False)
    assert blind.verdict == "undecided" and not blind.digits
    assert limit(blind, "time step").horizon is None and limit(blind, "near miss").horizon is None
    # what was made is not what is missing
    monkeypatch.setattr(sys.modules["mdnum.gradients.diagnose.trust"], "_MEMORY", 0)
    large = limit(trust(wide, NAMES, tolerance=0.03), "near miss")
    assert large.horizon is None and large.code == "memory" and large.values["bytes"] > 0
    # the third atom is inside for a while
    crossing = trust(problem(-0.02, 0.01), NAMES, tolerance=0.03, saltation=False)
    assert crossing.verdict == "limited" and crossing.limited_by == "flips left out"


def test_an_average_over_steps_is_not_distrusted_for_the_growth_of_its_first_steps():
    """Over its first thirty steps every average gains frames, and every velocity becomes a displacement."""
    average = problem(0.01, 0.01, loss=MeanPotential())
    seen = growth(average, NAMES)
    assert seen.gain > 10 * GROWN and not grew(seen)
    # what grows from there on by as much is one start among many
    size = seen.table["size"] * np.exp(0.2 * np.maximum(np.arange(61) - 30, 0))
    assert grew(replace(seen, table={**seen.table, "size": size}))
    found = trust(average, NAMES, tolerance=0.03)
    assert found.by["potential.epsilon"].verdict == "trusted" and not found.unknown


@pytest.mark.parametrize("loss", [MeanPotential(every=7, first=5), EinsteinDiffusion(every=10)])
def test_half_the_time_step_looks_at_the_same_times(loss):
    whole = problem(0.01, 0.002, loss=loss)
    half = shorter(whole, np.array([whole.steps]), per=2)
    assert half.steps == 2 * whole.steps
    assert half.value() == pytest.approx(whole.value(), rel=1e-3)
    assert len(spread(whole, 10)) > 3
