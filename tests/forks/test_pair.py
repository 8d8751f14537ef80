"""Verdicts at both ends: a crystal whose flips are the cause, one without flips, a run and itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mdnum.forks.repeats import nudged, seed_size

from mdnum.errors import InputError
from mdnum.forks import Twin, fork
from mdnum.rollout.engine import first_state
from mdnum.systems.build import Simulation, build


def moved(simulation: Simulation, size: float) -> Simulation:
    noise = np.random.default_rng(0).standard_normal(simulation.positions.shape)
    return replace(simulation, positions=simulation.positions + size * noise)


def test_in_a_cold_crystal_the_flips_are_the_cause():
    a = build("argon/crystal-108")
    found = fork(Twin(a, moved(a, 1e-6), "start"), 3000, split=0.03, back=True)
    assert found.verdict.word == "cause"
    assert found.splits["B"] is not None and found.splits["B|A"] is None and found.splits["A|B"] is None
    assert np.nanmax(found.series["B|A"]) < 1e-5
    decision = found.decision
    assert decision is not None and decision.step == found.dates.fork
    # the margin is of the size of what separates the runs, and far above rounding
    assert abs(decision.margin) < 20 * decision.separation
    assert not decision.ambiguous and found.dates.seed == 0


def test_between_shells_nothing_forks():
    a = build("argon/crystal-108", {"cutoff.radius": 1.35})
    found = fork(Twin(a, moved(a, 1e-6), "start"), 1500, split=0.03)
    assert found.verdict.word == "no fork"
    assert found.dates.fork is None and found.dates.split is None and found.decision is None


def test_the_same_program_is_the_same():
    a = build("argon/crystal-108")
    found = fork(Twin(a, build("argon/crystal-108"), "nothing"), 200)
    assert found.verdict.word == "same"


def test_every_series_ends_at_the_last_step_wherever_the_stretches_end():
    """A's stretches are as long as its program makes them: no 37 steps."""
    a = build("argon/crystal-108")
    found = fork(Twin(a, moved(a, 1e-6), "start"), 37, back=True, repeats=0)
    assert {name: len(values) for name, values in found.series.items()} == dict.fromkeys(found.series, 38)


def test_a_horizon_too_short_is_open():
    a = build("argon/crystal-108")
    found = fork(Twin(a, moved(a, 1e-6), "start"), 120, split=0.03, repeats=0)
    assert found.verdict.word == "open"
    assert found.dates.fork is not None


def test_nudged_starts_differ_by_the_size_asked_for_and_never_by_nothing():
    a = build("argon/crystal-108", {"precision.state": "float32"})
    start = first_state(a)
    for size in (0.0, 1e-3):
        for one in nudged(a, start, size, 3, 1):
            d = np.asarray(one.state.x, np.float64) - np.asarray(start.state.x, np.float64)
            largest = np.sqrt((d**2).sum(axis=0)).max()
            assert largest > 0
            if size:
                assert largest == pytest.approx(size, rel=1e-3)


def test_the_seed_of_a_choice_is_measured():
    a = build("argon/crystal-108")
    b = moved(a, 1e-7)
    assert 1e-7 < seed_size(Twin(a, b, "start")) < 1e-5


def test_what_cannot_be_compared_is_refused():
    a = build("argon/crystal-108")
    with pytest.raises(InputError, match="108 and 864 atoms"):
        fork(Twin(a, build("argon/liquid-864"), "another system"), 10)
    with pytest.raises(InputError, match="steps = 0"):
        fork(Twin(a, a, "nothing"), 0)
    with pytest.raises(InputError, match="split = -1"):
        fork(Twin(a, a, "nothing"), 10, split=-1.0)


@pytest.mark.slow
def test_a_run_that_ends_before_any_decision_differs_is_a_fork_by_itself():
    b = build("argon/crystal-108", overrides={"dynamics.timestep": 2.0})
    found = fork(Twin(build("argon/crystal-108"), b, "time step"), 4, repeats=0, counterfactual=False)
    assert found.failed.keys() == {"B"} and not found.flips
    assert found.dates.seed == found.dates.fork == found.steps
    assert found.verdict.word == "open" and "that is the fork" in found.verdict.reasons[0]
