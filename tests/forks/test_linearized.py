"""Linearized runs beside the runs: the exponent of two runs an ulp apart, and predicted flips."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from ase import Atoms
from forks.harness import crystal, pair
from rollout.harness import history
from rollout.harness import liquid as fluid
from small_systems import LENNARD_JONES, make

from mdnum.errors import InputError
from mdnum.forks.linearized import forecast, lyapunov, tangents
from mdnum.numerics.verdicts import Growth, growth
from mdnum.rollout.program import MdProgram
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation


@cache
def liquid() -> Simulation:
    """A hot dense fluid of 108 atoms."""
    atoms = fluid()
    atoms.set_masses([1.0] * len(atoms))
    dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 1.5, "seed": 3}
    cutoff = {"kind": "switched", "radius": 2.2}
    return build(make(atoms, LENNARD_JONES, cutoff, neighbors={"skin": 0.25}, dynamics=dynamics))


def separation(a: Simulation, b: Simulation, steps: int) -> np.ndarray:
    twin = pair(a, b)
    rows = twin.a.lockstep(twin.b, steps, forward=False, back=False, guard=None)
    return np.concatenate([one.separation["B"] for one in rows])


# --- exponents ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_exponent_is_the_rate_at_which_two_runs_part():
    a = liquid()
    found = lyapunov(a, 2000)
    assert found.chaotic and found.error < 0.1 * found.rate
    place = np.unravel_index(np.argmax(a.positions), a.positions.shape)
    moved = a.positions.copy()
    moved[place] = np.nextafter(moved[place], np.inf)
    seen = growth(separation(a, replace(a, positions=moved), 2000), 0.088)
    assert seen.r_squared > 0.98
    assert found.rate == pytest.approx(seen.rate, rel=0.2)
    assert found.ratio(seen) == pytest.approx(1, rel=0.25)
    assert found.rate_time == pytest.approx(found.rate / 0.004)
    # beyond the run at the rate
    far = found.steps_to(1e-30, 1.0)
    assert far is not None and far > 2000
    assert far - 2000 == pytest.approx((np.log(1e30) - found.furthest[-1]) / found.rate)
    # and within it where the run itself grew to
    assert np.isfinite(found.size).all() and found.size[0] == pytest.approx(0.0, abs=1e-12)
    assert found.furthest[0] == pytest.approx(0.0, abs=1e-12)
    within = found.steps_to(1.0, float(np.exp(found.furthest[1500])))
    assert within == int((found.furthest >= found.furthest[1500]).argmax()) <= 1500


@pytest.mark.slow
def test_what_is_not_chaotic():
    found = lyapunov(crystal(cutoff__radius=1.35), 2000)
    assert not found.chaotic and abs(found.rate) < 3e-4
    assert np.isnan(found.ratio(Growth(0.1, 1.0, 0, 100))) and found.steps_to(1e-16, 1.0) is None
    # one degree of freedom: a perturbation changes the period, so it grows linearly and no faster
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [1.5, 0, 0]], masses=[1.0, 1.0])
    atoms.set_velocities(np.zeros((2, 3)))
    found = lyapunov(build(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": 2.5})), 4000)
    assert found.size.max() > 1 and not found.chaotic and found.steps_to(1e-16, 1.0) is None


# --- forecasts ----------------------------------------------------------------------------------------

SYSTEMS = {
    "cold": {},
    "hot": {"dynamics__temperature": 1.5},
    "continuous": {"cutoff__kind": "force-shifted", "dynamics__temperature": 0.3, "neighbors__skin": 0.1},
}


@pytest.mark.parametrize(
    "name",
    [
        "cold",
        pytest.param("continuous", marks=pytest.mark.nightly),
        pytest.param("hot", marks=pytest.mark.nightly),
    ],
)
def test_no_predicted_flip_is_contradicted_by_the_run(name):
    simulation, steps = crystal(**SYSTEMS[name]), 200
    _, plain = history(simulation, steps)
    flips, ends, each = [], [], []
    for seed in range(2):
        ahead = forecast(simulation, steps, seed=seed)
        for amplitude in (1e-8, -1e-6, 1e-5, -1e-4, 1e-3):
            perturbed = replace(simulation, positions=simulation.positions + amplitude * ahead.dx)
            good = ahead.good_until(amplitude)
            rows = zip(plain, history(perturbed, steps)[1], strict=False)
            differing = {
                (step, *divmod(key, simulation.atoms))
                for step, (ours, theirs) in enumerate(rows)
                if step <= good.step
                for key in ours ^ theirs
            }
            predicted = {(flip.step, flip.i, flip.j) for flip in ahead.first(amplitude, 10)}
            at = {step for step, _, _ in predicted}
            # where flips kick, a step of flips that were not predicted is a contradiction too
            unforeseen = {flip for flip in differing if flip[0] not in at} if ahead.kicks else set()
            assert not (predicted - differing) | unforeseen, (seed, amplitude, good)
            flips += predicted
            ends.append(good.ends)
            each.append(len(at))
    # and flips are predicted, late and early, and many
    assert len({step for step, _, _ in flips}) >= 3 and set(ends) & {"flip", "end"}
    if name == "continuous":
        # a flip is no reason to end where it does not kick
        assert not set(ends) & {"flip", "close"} and len(flips) > 30
    else:
        assert max(each) <= 1 and ends.count("flip") >= 4


def test_a_forecast_ends_with_the_flip_that_kicks():
    """Beyond it runs decide otherwise than the tangent has it, so nothing is predicted of that."""
    ahead = forecast(crystal(), 300, seed=0)
    good = ahead.good_until(1e-5)
    assert good.ends == "flip" and good.step < 300 == ahead.linear_until(1e-5)
    assert {flip.step for flip in ahead.first(1e-5, 10)} == {good.step}
    # between what surely flips and what surely does not
    nearest = ahead.nearest(1)[0]
    at_edge = ahead.good_until(nearest.amplitude)
    assert (at_edge.ends, at_edge.step) == ("close", nearest.step - 1)
    assert ahead.first(nearest.amplitude) == ()
    # what is too large to be linear
    assert ahead.good_until(1e-2) == (-1, "size") and ahead.first(1e-2) == ()


def test_a_pair_that_no_list_holds_ends_a_forecast():
    """One comes in from beyond the list: with a thin skin a large displacement may bring it inside."""
    ahead = forecast(crystal(neighbors__skin=0.1, cutoff__kind="force-shifted"), 60, seed=0)
    assert [ahead.good_until(size).ends for size in (1e-9, 4e-3)] == ["end", "list"]
    assert (ahead.room <= 0.1).all() and (ahead.listed > 0).all()


def test_the_predicted_amplitude_is_the_one_at_which_a_run_flips():
    a = crystal()
    ahead = forecast(a, 300, seed=1)
    plain = MdProgram(a).history(300)
    nearest = ahead.nearest(1)[0]
    for share, flips in ((0.98, False), (1.02, True)):
        positions = a.positions + share * nearest.amplitude * ahead.dx
        step = plain.first_difference(MdProgram(replace(a, positions=positions)).history(300))
        assert (step == nearest.step) is flips and (step is None) is not flips
    assert nearest.ulps == pytest.approx(abs(nearest.amplitude) / np.spacing(a.positions.max()))
    assert ahead.first(0.98 * nearest.amplitude) == ()
    assert ahead.first(1.02 * nearest.amplitude)[0] == nearest


def test_a_crossing_in_closed_form_is_predicted_to_rounding():
    # free flight until the first step inside: at step 7 the distance is 2.5 + 1/1024
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [2.9384765625, 0, 0]], masses=[1.0, 1.0])
    atoms.set_velocities([[0, 0, 0], [-1.25, 0, 0]])
    tables = {"kind": "nve", "timestep": 0.05, "steps": 20}
    cutoff = {"kind": "hard", "radius": 2.5}
    # a list that holds the pair from the start: what is not listed is not predicted
    simulation = build(make(atoms, LENNARD_JONES, cutoff, dynamics=tables, neighbors={"skin": 1.0}))
    outwards = np.array([[0.0, 0, 0], [1, 0, 0]])
    flip = forecast(simulation, 7, dx=outwards).nearest(1)[0]
    # r² - 6.25 over its slope 2 r
    r = 2.5 + 1 / 1024
    assert (flip.step, flip.i, flip.j) == (7, 0, 1)
    assert flip.amplitude == pytest.approx(-(r * r - 6.25) / (2 * r), rel=1e-12)
    assert flip.margin == pytest.approx(6.25 - r * r, rel=1e-12)
    faster = forecast(simulation, 7, dv=outwards).nearest(1)[0]
    # a velocity acts for seven steps
    assert faster.amplitude == pytest.approx(flip.amplitude / 0.35, rel=1e-12)


def test_the_tangent_is_the_difference_of_two_runs():
    a = crystal(neighbors__skin=0.1, cutoff__kind="force-shifted")
    u = np.random.default_rng(4).standard_normal(a.positions.shape)
    size = 1e-7
    # across lists: the tangent is handed from one order of atoms to another
    runs = [MdProgram(replace(a, positions=a.positions + sign * size * u)).history(200) for sign in (1, -1)]
    assert runs[0].first_difference(runs[1]) is None
    seen = np.sqrt(((runs[0].x - runs[1].x) ** 2).sum(axis=1)).max() / (2 * size)
    parts = list(tangents(a, 200, u, 0 * u))
    assert len({part.segment.epoch for part in parts}) > 1
    assert np.exp(parts[-1].furthest[-1]) == pytest.approx(seen, rel=1e-5)


def test_bad_input_is_refused():
    zero = np.zeros_like(crystal().positions)
    for words, call in (
        ("is zero", lambda: forecast(crystal(), 10, dx=zero)),
        ("same shape", lambda: forecast(crystal(), 10, dx=zero[:5])),
        ("many-body", lambda: forecast(build("copper/eam-500"), 10)),
        ("too few", lambda: lyapunov(crystal(), 40)),
    ):
        with pytest.raises(InputError, match=words):
            call()
