"""Gradients through flips, against closed forms that no simulation enters."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import sympy

from mdnum.gradients.losses import Custom
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import EventAware, Forward, Symmetric
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


@pytest.fixture(scope="module")
def well():
    """The final relative speed of the pair that leaves its well."""
    simulation = build("pair/leaving-well")
    steps = 2000
    apart = simulation.positions[1] - simulation.positions[0]
    axis = int(np.argmax(np.abs(apart)))
    loss = Custom(see=lambda frame, *_: frame.v[axis, 1] - frame.v[axis, 0], first=steps)
    return Problem(simulation, loss, steps), axis


def along(gradient: dict[str, np.ndarray], axis: int) -> dict[str, float]:
    """By distance and relative speed: half of each atom's, since both move by halves."""
    return {
        name: float((value[1, axis] - value[0, axis]) / 2) if value.ndim == 2 else float(value)
        for name, value in gradient.items()
    }


def test_leaving_a_well_has_the_derivatives_of_the_closed_form(well):
    problem, axis = well
    found = EventAware()(problem, NAMES)
    got = along(found.gradient, axis)
    for name, value in exact().items():
        assert got[name] == pytest.approx(value, abs=1e-4), name
    assert found.details["crossings"] == 1


def test_without_the_flip_the_error_is_an_eighth_and_the_radius_seems_not_to_matter(well):
    problem, axis = well
    found = Symmetric()(problem, NAMES)
    got, true = along(found.gradient, axis), exact()
    assert got["initial.positions"] == pytest.approx(0.875 * true["initial.positions"], rel=2e-3)
    assert got["cutoff.radius"] == 0.0
    assert "exactly 0" in found.notes["cutoff.radius"]
    assert "event-aware" in found.notes["potential.sigma"]


def test_a_crossing_slower_than_the_guard_is_left_out_and_listed(well):
    problem, axis = well
    # far above any speed of this run
    found = EventAware(guard=100.0)(problem, NAMES)
    plain = Symmetric()(problem, NAMES)
    assert along(found.gradient, axis) == along(plain.gradient, axis)
    (row,) = found.details["heaviest"]
    assert row["grazing"] and found.details["grazing"] == 1
    # its weight is what it would have added to the derivative by the radius
    assert row["weight"] == pytest.approx(exact()["cutoff.radius"], abs=1e-4)
    assert found.details["weight left out"] == abs(row["weight"])


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
    order = (0, 1, 2, 3, 4)
    found = [mpmath.diff(average, at, tuple(int(k == n) for k in order)) for n in order]
    names = NAMES
    return {name: float(value) for name, value in zip(names, found, strict=True)}


@pytest.mark.parametrize("w", ["u", pytest.param("w", marks=pytest.mark.slow)])
def test_what_a_loss_sees_jump_moves_with_the_crossing(well, w):
    """Energy and virial jump with the flip: by the radius their averages have no other derivative."""
    simulation, axis = well[0].simulation, well[1]
    steps = 2000
    see = (lambda frame, *_: frame.potential) if w == "u" else (lambda frame, *_: frame.virial)
    time = (steps + 1) * float(simulation.integrator.timestep)
    exact = averages(w, time)
    for every in (1, 4):
        problem = Problem(simulation, Custom(see=see, every=every), steps)
        got = along(EventAware()(problem, NAMES).gradient, axis)
        plain = along(Symmetric()(problem, NAMES).gradient, axis)
        assert plain["cutoff.radius"] == 0
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
    late = Custom(see=lambda frame, *_: frame.potential, first=20)
    found = EventAware()(Problem(simulation, late, 20), ("potential.sigma",))
    assert found.details["loss jumps"] and "single frames" in found.notes["potential.sigma"]
    often = Custom(see=lambda frame, *_: frame.potential, every=2)
    found = EventAware()(Problem(simulation, often, 20), ("potential.sigma",))
    assert not found.details["loss jumps"] and not found.notes
    speed = EventAware()(Problem(simulation, Custom(see=lambda f, *_: f.v[0, 0], first=20), 20), ("sigma",))
    assert not speed.details["loss jumps"]
