"""Flips foretold by one linearized run, beside the runs, a closed form, and differences of runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ase import Atoms
from mdnum.forks.histories import history
from small_systems import LENNARD_JONES, make

from mdnum.errors import InputError
from mdnum.forks.forecast import forecast, trial
from mdnum.forks.tangent import tangents
from mdnum.systems.build import build


@pytest.fixture(scope="module")
def crystal():
    return build("argon/crystal-108")


SYSTEMS = {
    "cold": {},
    "hot": {"dynamics.temperature": 1.5, "neighbors.skin": 0.2},
    "continuous": {"cutoff.kind": "force-shifted", "dynamics.temperature": 0.3},
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_no_flip_foretold_is_contradicted_by_the_run(name):
    sizes = [1e-8, -1e-6, 1e-5, -1e-4, 1e-3]
    cases = trial(build("argon/crystal-108", SYSTEMS[name]), 200, sizes, seeds=range(2))
    wrong = [(case.seed, case.amplitude, case.good, case.contradicted) for case in cases if case.contradicted]
    assert not wrong
    # and something is foretold, late and early, and much of it
    told = [flip for case in cases for flip in case.foretold]
    assert len({flip.step for flip in told}) >= 3
    assert {case.good.ends for case in cases} & {"flip", "end"}
    if name == "continuous":
        # a flip is no reason to end where it does not kick
        assert not {case.good.ends for case in cases} & {"flip", "close"}
        assert len(told) > 30
    else:
        assert all(len({flip.step for flip in case.foretold}) <= 1 for case in cases)
        assert sum(case.good.ends == "flip" for case in cases) >= 4


def test_a_forecast_ends_with_the_flip_that_kicks(crystal):
    """Beyond it runs decide otherwise than the tangent has it, so nothing is told of that."""
    told = forecast(crystal, 300, seed=0)
    amplitude = 1e-5
    good = told.good_until(amplitude)
    assert good.ends == "flip" and good.step < 300 == told.linear_until(amplitude)
    assert {flip.step for flip in told.first(amplitude, 10)} == {good.step}
    # between what surely flips and what surely does not
    nearest = told.nearest(1)[0]
    at_edge = told.good_until(nearest.amplitude)
    assert (at_edge.ends, at_edge.step) == ("close", nearest.step - 1)
    assert told.first(nearest.amplitude) == ()


def test_a_pair_that_no_list_holds_ends_a_forecast():
    """One comes in from beyond the list: with a thin skin a large displacement may bring it inside."""
    told = forecast(
        build("argon/crystal-108", {"neighbors.skin": 0.1, "cutoff.kind": "force-shifted"}), 60, seed=0
    )
    assert [told.good_until(size).ends for size in (1e-9, 4e-3)] == ["end", "list"]
    assert (told.room <= 0.1).all() and (told.listed > 0).all()


def test_the_amplitude_foretold_is_the_one_at_which_a_run_flips(crystal):
    told = forecast(crystal, 300, seed=1)
    plain = history(crystal, 300)
    nearest = told.nearest(1)[0]
    for share, flips in ((0.98, False), (1.02, True)):
        positions = crystal.positions + share * nearest.amplitude * told.dx
        step = plain.first_difference(history(replace(crystal, positions=positions), 300))
        assert (step == nearest.step) is flips and (step is None) is not flips
    assert nearest.ulps == pytest.approx(abs(nearest.amplitude) / np.spacing(crystal.positions.max()))
    assert told.first(0.98 * nearest.amplitude) == ()
    assert told.first(1.02 * nearest.amplitude)[0] == nearest


def test_a_crossing_in_closed_form_is_foretold_to_rounding():
    # free flight until the first step inside: at step 7 the distance is 2.5 + 1/1024
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [2.9384765625, 0, 0]], masses=[1.0, 1.0])
    atoms.set_velocities([[0, 0, 0], [-1.25, 0, 0]])
    tables = {"kind": "nve", "timestep": 0.05, "steps": 20}
    cutoff = {"kind": "hard", "radius": 2.5}
    # a list that holds the pair from the start: what is not listed is not foretold
    simulation = build(make(atoms, LENNARD_JONES, cutoff, dynamics=tables, neighbors={"skin": 1.0}))
    outwards = np.array([[0.0, 0, 0], [1, 0, 0]])
    told = forecast(simulation, 7, dx=outwards)
    step = told.nearest(1)[0]
    # r² - 6.25 over its slope 2 r
    r = 2.5 + 1 / 1024
    assert (step.step, step.i, step.j) == (7, 0, 1)
    assert step.amplitude == pytest.approx(-(r * r - 6.25) / (2 * r), rel=1e-12)
    assert step.margin == pytest.approx(6.25 - r * r, rel=1e-12)
    faster = forecast(simulation, 7, dv=outwards).nearest(1)[0]
    # a velocity acts for seven steps
    assert faster.amplitude == pytest.approx(step.amplitude / 0.35, rel=1e-12)


def test_the_tangent_is_the_difference_of_two_runs():
    crystal = build("argon/crystal-108", {"neighbors.skin": 0.1})
    u = np.random.default_rng(4).standard_normal(crystal.positions.shape)
    size = 1e-7
    # across lists: the tangent is handed from one order of atoms to another
    runs = [history(replace(crystal, positions=crystal.positions + sign * size * u), 250) for sign in (1, -1)]
    assert runs[0].first_difference(runs[1]) is None
    seen = np.sqrt(((runs[0].x - runs[1].x) ** 2).sum(axis=1)).max() / (2 * size)
    parts = list(tangents(crystal, 250, u, 0 * u, clock=0.1))
    assert len({part.segment.epoch for part in parts}) > 1
    assert np.exp(parts[-1].furthest[-1]) == pytest.approx(seen, rel=1e-5)


def test_too_large_to_be_linear_is_told(crystal):
    told = forecast(crystal, 100)
    assert told.linear_until(1e-6) == 100
    assert told.linear_until(1e-2) == -1
    assert told.good_until(1e-2) == (-1, "size") and told.first(1e-2) == ()


def test_bad_input_is_refused(crystal):
    zero = np.zeros_like(crystal.positions)
    with pytest.raises(InputError, match="nothing"):
        forecast(crystal, 10, dx=zero)
    with pytest.raises(InputError, match="shape of the start"):
        forecast(crystal, 10, dx=zero[:5])
    with pytest.raises(InputError, match="many-body"):
        forecast(build("copper/eam-500"), 10)
