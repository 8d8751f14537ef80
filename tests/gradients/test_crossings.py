"""Gradients through flips, against closed forms that no simulation enters, and tangents against the reverse
pass, with whose code they share nothing beyond the recorded run."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import sympy
from gradient_problems import everything
from small_systems import KOB_ANDERSEN, make, mixture

from mdnum.errors import InputError
from mdnum.gradients.adjoint import reverse
from mdnum.gradients.losses import Custom, FinalProjection
from mdnum.gradients.parameters import gathered, gradient, resolve, with_values
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import EventAware, Forward, Symmetric, tape_of
from mdnum.gradients.tangents import by_column, tangents
from mdnum.gradients.tape import RunTape
from mdnum.rollout.engine import Engine
from mdnum.systems import build

NAMES = ("initial.positions", "initial.velocities", "cutoff.radius", "potential.sigma", "potential.epsilon")


def exact() -> dict[str, float]:
    """Derivatives of the speed of a particle that has left a well, by conservation of energy.

    mu v²/2 + u(r_cut) = mu v0²/2 + u(r0) with a reduced mass of 1: inside the cutoff nothing is lost, and
    beyond it nothing acts.
    """
    r0, r_cut, sigma, epsilon, v0 = sympy.symbols("r0 r_cut sigma epsilon v0", positive=True)

    def u(r):
        return 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6)

    v = sympy.sqrt(v0**2 + 2 * u(r0) - 2 * u(r_cut))
    at = {r0: 1.8, r_cut: 2.5, sigma: 1, epsilon: 1, v0: 1}
    names = zip(NAMES, (r0, v0, r_cut, sigma, epsilon), strict=True)
    return {name: float(sympy.diff(v, q).subs(at)) for name, q in names}


def along(gradient: dict[str, np.ndarray], axis: int) -> dict[str, float]:
    """By distance and relative speed: half of each atom's, since both move by halves."""
    return {
        name: float((value[1, axis] - value[0, axis]) / 2) if value.ndim == 2 else float(value)
        for name, value in gradient.items()
    }


def test_leaving_a_well_has_the_derivatives_of_the_closed_form(well):
    problem, axis = well
    aware, plain = EventAware()(problem, NAMES), Symmetric()(problem, NAMES)
    true, steps = exact(), along(plain.gradient, axis)
    assert along(aware.gradient, axis) == pytest.approx(true, abs=1e-4)
    assert aware.details["crossings"] == 1
    # without the flip the error is an eighth, and the radius seems not to matter
    assert steps["initial.positions"] == pytest.approx(0.875 * true["initial.positions"], rel=2e-3)
    assert steps["cutoff.radius"] == 0.0
    assert "exactly 0" in plain.notes["cutoff.radius"]
    assert "event-aware" in plain.notes["potential.sigma"]
    # a crossing slower than the guard, far above any speed of this run, is left out and listed
    guarded = EventAware(guard=100.0)(problem, NAMES)
    assert along(guarded.gradient, axis) == steps
    (row,) = guarded.details["heaviest"]
    assert row["grazing"] and guarded.details["grazing"] == 1
    # its weight is what it would have added to the derivative by the radius
    assert row["weight"] == pytest.approx(true["cutoff.radius"], abs=1e-4)
    assert guarded.details["weight left out"] == abs(row["weight"])


def averages(w: str, time: float) -> dict[str, float]:
    """Derivatives of the time average of energy ("u") or virial ("w") of the particle that leaves the well.

    Dwelling at a distance goes with one over the speed: the average is the integral of what is seen over
    v(r), from the start to the cutoff, over the time.
    """
    mpmath.mp.dps = 30

    def average(r0, v0, r_cut, sigma, epsilon):
        def u(r):
            return 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6)

        def seen(r):
            return u(r) if w == "u" else 4 * epsilon * (12 * (sigma / r) ** 12 - 6 * (sigma / r) ** 6)

        def density(r):
            return seen(r) / mpmath.sqrt(v0**2 + 2 * u(r0) - 2 * u(r))

        return mpmath.quad(density, [r0, r_cut]) / time

    at = [mpmath.mpf(q) for q in ("1.8", "1", "2.5", "1", "1")]
    found = [mpmath.diff(average, at, tuple(int(k == n) for k in range(5))) for n in range(5)]
    return {name: float(value) for name, value in zip(NAMES, found, strict=True)}


def energy(frame, *_):
    return frame.potential


@pytest.mark.parametrize(("w", "every"), [("u", 1), pytest.param("w", 4, marks=pytest.mark.nightly)])
def test_what_a_loss_sees_jump_moves_with_the_crossing(well, w, every):
    """Energy and virial jump with the flip: by the radius their averages have no other derivative."""
    simulation, axis = well[0].simulation, well[1]
    steps = 2000
    see = energy if w == "u" else (lambda frame, *_: frame.virial)
    exact = averages(w, (steps + 1) * float(simulation.integrator.timestep))
    problem = Problem(simulation, Custom(see=see, every=every), steps)
    got = along(EventAware()(problem, NAMES).gradient, axis)
    for name, value in exact.items():
        # frames are a rule of rectangles for the integral
        assert got[name] == pytest.approx(value, abs=2e-3 * every * max(map(abs, exact.values()))), name
    # what the crossing adds has no such error: its frame is as early as late
    assert got["cutoff.radius"] == pytest.approx(exact["cutoff.radius"], rel=1e-5 if every == 1 else 2e-3)
    tangent = Forward(saltation=True)(problem, ("cutoff.radius", "potential.sigma"))
    for name, value in tangent.gradient.items():
        assert float(value) == pytest.approx(got[name], rel=1e-11)


def test_a_single_frame_that_jumps_is_told(well):
    simulation = well[0].simulation
    late = Problem(simulation, Custom(see=energy, first=20), 20)
    found = EventAware()(late, ("potential.sigma",))
    assert found.details["loss jumps"] and "single frames" in found.notes["potential.sigma"]
    often, speed = Custom(see=energy, every=2), Custom(see=lambda f, *_: f.v[0, 0], first=20)
    assert not any(any(tape_of(replace(late, loss=loss), False).jumps_unseen) for loss in (often, speed))


# --- tangents ----------------------------------------------------------------------------------------

STEPS = 40
WORDS = ("sigma", "epsilon", "cutoff.radius", "timestep", "temperature", "scale", "friction")


@pytest.fixture(scope="module")
def hot():
    """A mixture in a bath so fast that pairs cross the cutoff, where the force jumps."""
    dynamics = {"kind": "langevin", "timestep": 0.004, "temperature": 3.0, "friction": 2.0, "seed": 3}
    system = make(mixture(), KOB_ANDERSEN, {"kind": "hard", "radius": 2.0}, dynamics=dynamics)
    simulation = build(system)
    return RunTape(simulation, everything(simulation.atoms), STEPS, flips=True)


@pytest.fixture(scope="module")
def forward(hot):
    """Tangents along one recorded run, without and with what the flips add."""
    names = resolve(hot.simulation, WORDS)
    return {jumps: list(tangents(hot, names, saltation=jumps, states=True)) for jumps in (False, True)}


def agree(ours, theirs):
    for name, value in theirs.items():
        scale = max(float(np.max(np.abs(value))), 1e-300)
        assert np.max(np.abs(ours[name] - value)) <= 1e-9 * scale, name


@pytest.mark.slow
def test_tangents_agree_with_the_reverse_pass_and_flips_add_their_weights(hot, forward):
    names = resolve(hot.simulation, WORDS)
    # in which every flip grazes and none does: one program, plain and event-aware
    passes = {jumps: reverse(hot, saltation=True, guard=0.0 if jumps else np.inf) for jumps in (False, True)}
    theirs = {
        jumps: {name: gradient(hot.simulation, parts, name) for name in names}
        for jumps, (parts, _) in passes.items()
    }
    for jumps, value in theirs.items():
        agree(gathered(hot.simulation, names, by_column(hot, forward[jumps][-1].total)), value)
        # with flips, and only with them, the radius counts
        assert np.all((value["cutoff.radius"] != 0) == jumps)
    added = np.zeros(())
    for met, part in zip(reversed(passes[True][1]), forward[False], strict=True):
        added = added + np.where(met.grazing, 0, met.weight) @ (part.dr_cut - part.dr)
    difference = {name: theirs[True][name] - theirs[False][name] for name in names}
    assert all(np.all(value != 0) for value in difference.values())
    agree(gathered(hot.simulation, names, added), difference)
    # and the method is what it is made of
    found = EventAware(guard=0.0)(Problem(hot.simulation, hot.loss, STEPS), names)
    assert found.value == hot.value and found.gradient["potential.epsilon"].shape == (3,)
    assert found.details["crossings"] == sum(len(part.crossings) for part in forward[True]) > 50
    agree(theirs[True], found.gradient)


@pytest.mark.slow
def test_the_tangent_of_a_state_is_that_of_differences(hot, forward):
    """Of the last positions by one sigma, against two runs that make the same decisions."""

    def last(shift: float) -> tuple[np.ndarray, int]:
        sigma = np.asarray(hot.simulation.potential.sigma) + shift * np.array([1.0, 0.0, 0.0])
        shifted = with_values(hot.simulation, {"potential.sigma": sigma})
        segments = [
            (segment.unsorted("x", segment.rows - 1), segment.unsorted("images", segment.rows - 1))
            for segment in Engine(shifted, STEPS).segments()
        ]
        x, images = segments[-1]
        return x + images @ np.asarray(shifted.cell.matrix), len(segments)

    (above, lists), (below, as_many) = last(1e-7), last(-1e-7)
    assert lists == as_many > 1
    difference = (above - below) / 2e-7
    part = forward[False][-1]
    ours = np.empty_like(difference)
    ours[part.stretch.table.order] = part.x[part.stretch.rows - 1, 0].T
    assert ours == pytest.approx(difference, abs=1e-6 * np.abs(difference).max())


def test_bad_input_says_what_would_do(hot):
    problem = Problem(hot.simulation, hot.loss, STEPS)
    with pytest.raises(InputError, match="324 numbers"):
        Forward()(problem, ("x0",))
    with pytest.raises(InputError, match="were not recorded"):
        next(tangents(RunTape(hot.simulation, hot.loss, STEPS), ("potential.sigma",), saltation=True))


@pytest.mark.nightly
def test_the_pair_that_leaves_its_well_agrees_by_every_number():
    """Each coordinate of a free pair is a column; stretched, it starts at another distance."""
    simulation = build("pair/leaving-well")
    problem = Problem(simulation, FinalProjection(direction=jnp.asarray([[1.0, 0], [0, 0], [0, 0]])), 2000)
    names = ("x0", "v0", "scale", "sigma")
    ours, theirs = Forward(saltation=True)(problem, names), EventAware()(problem, names)
    for name, value in theirs.gradient.items():
        assert ours.gradient[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    assert np.linalg.norm(simulation.positions[1] - simulation.positions[0]) == pytest.approx(1.8)
    by_distance = float(np.sum(theirs.gradient["initial.positions"] * simulation.positions))
    assert float(ours.gradient["box.scale"]) == pytest.approx(by_distance, rel=1e-9)
