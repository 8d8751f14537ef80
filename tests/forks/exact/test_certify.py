"""Horizons of real runs against the exact history, and rounding bounds of decisions against rationals."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import small_systems

from mdnum.errors import InputError
from mdnum.forks import certified
from mdnum.forks.certified import certified_horizon, exact_margin
from mdnum.forks.exact.certify import BALL_POLICIES, MD_POLICIES, certify
from mdnum.numerics import PrecisionPolicy
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import PairRecorder
from mdnum.systems import System, load
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation

NARROW = PrecisionPolicy("float32", "float32", "float32", "float32")


@cache
def liquid(seed: int = 3) -> System:
    return small_systems.make(
        small_systems.crystal(2, 0.02, 1.68),
        small_systems.LENNARD_JONES,
        {"kind": "hard", "radius": 1.55},
        dynamics={"kind": "nve", "timestep": 0.004, "temperature": 2.9, "seed": seed},
        neighbors={"skin": 0.1},
    )


@cache
def simulation(policy: PrecisionPolicy | None = None) -> Simulation:
    whole = build(liquid(11))
    return whole if policy is None else whole.with_policy(policy)


@pytest.fixture
def flint():
    return pytest.importorskip("flint", reason="exact runs need python-flint")


# --- horizons -----------------------------------------------------------------------------------------


@pytest.mark.nightly
def test_single_precision_leaves_early_and_double_does_not(flint):
    names = ("float64", "float32", "float32, accumulate float64", "float64, force bfloat16")
    found = certify(liquid(), 400, {name: MD_POLICIES[name] for name in names})
    assert found.ranking[0].name == "float64"
    rows = {row.name: row for row in found.ranking}
    wide, narrow = rows["float64"], rows["float32"]
    assert wide.horizon is None and wide.decision is None and np.isnan(wide.margin)
    assert wide.separation.max() < 1e-9 < narrow.separation.max()
    decision = narrow.decision
    assert decision is not None and decision.step == narrow.horizon and 20 < narrow.horizon < 400
    i, j = decision.subject
    inside = i * len(liquid().atoms) + j in found.exact.tape.inside(narrow.horizon)
    assert (decision.a, decision.b) == (inside, not inside) and inside == (narrow.margin > 0)
    # a margin of the size of the separation by then
    assert abs(narrow.margin) < 10 * narrow.separation[narrow.horizon]
    promoted = rows["float32, accumulate float64"]
    assert narrow.gain == 0 and np.isnan(wide.gain) and narrow.closer == 0
    # 29 bits more, of which some are lost in rounding more than one number a step
    assert 24 < wide.closer < 34 and abs(promoted.closer) < 1
    short = rows["float64, force bfloat16"]
    assert found.ranking[-1] is short and short.horizon is not None
    # eight bits instead of twenty-four, in the pair forces alone
    assert 3 <= short.horizon < narrow.horizon / 5 and short.closer < -6
    assert found.steps_per_bit == pytest.approx(np.log(2) / 0.024, rel=0.3)


def test_steps_and_systems_that_cannot_be_certified(flint):
    with pytest.raises(InputError, match="steps = 0"):
        certify(liquid(), 0)
    with pytest.raises(InputError, match="864 atoms"):
        certify(load("argon/liquid-864", world="md"), 10)


def test_narrow_balls_leave_and_wide_ones_stay():
    """The steps at which plain rationals say that 16 bits leave (tests of the ball's record)."""
    given = {
        "contact.k": 512.0, "integrator.timestep": 2.0**-6, "start.height": 0.40625, "flight.gravity": 9.75
    }  # fmt: skip
    system = load("ball/drop", given, world="ball")
    found = certify(system, 300, {name: BALL_POLICIES[name] for name in ("float16", "float64")})
    horizons = {row.name: row.horizon for row in found.ranking}
    assert list(horizons.items()) == [("float64", None), ("float16", 170)]
    row = found.ranking[1]
    assert (row.decision.channel, row.decision.subject) == ("contact", (0,)) and abs(row.margin) < 0.05
    assert row.separation[0] == 0 and row.separation[-1] > 0 and found.exact.contact.sum() > 30
    (cannot,) = certify(load("ball/stiff", world="ball"), 2, {"float16": BALL_POLICIES["float16"]}).ranking
    assert cannot.reason_unavailable is not None and cannot.horizon is None


# --- bounds -------------------------------------------------------------------------------------------


def test_horizons_of_a_narrow_run_and_a_wide_one_and_a_wrong_decision_that_is_found(monkeypatch):
    narrow, wide = (certified_horizon(simulation(policy), 400) for policy in (NARROW, None))
    assert wide.horizon is None and wide.wrong is None and wide.total == 0
    assert narrow.horizon is not None and narrow.total == len(narrow.decisions) > 0
    first = narrow.decisions[0]
    assert first.step == narrow.horizon and abs(first.margin) <= first.bound
    for one in narrow.decisions:
        assert abs(one.margin - one.exact) <= one.bound
        # r2 < : inside where the exact margin is above zero
        assert one.wrong == (one.inside != (one.exact > 0))
    # the recorder counts what is listed
    recorder = PairRecorder(simulation(NARROW))
    segments = Engine(simulation(NARROW), 400).segments()
    assert sum(int(recorder.ambiguous(segment).sum()) for segment in segments) == narrow.total
    assert {one.bound for one in narrow.decisions} == {*simulation(NARROW).decider.bounds}

    # margins of the opposite sign, planted: every ambiguous decision is then wrong
    def planted(*given):
        margin, inside = exact_margin(*given)
        return -margin, not inside

    monkeypatch.setattr(certified, "exact_margin", planted)
    found = certified_horizon(simulation(NARROW), 400)
    assert [one.wrong for one in found.decisions] == [not one.wrong for one in narrow.decisions]
    assert found.wrong == min(one.step for one in found.decisions if one.wrong)


def test_what_gives_no_bound_is_refused():
    unsafe = replace(simulation(), rule=replace(simulation().rule, every=5))
    with pytest.raises(InputError, match="may lack pairs"):
        certified_horizon(unsafe, 10)
