"""Rounding bounds of decisions against rationals, and the horizons of single runs."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import hypothesis.strategies as st
import numpy as np
import pytest
import small_systems
from hypothesis import given, settings

from mdnum.errors import InputError
from mdnum.forks.exact import bounds as exact_bounds
from mdnum.forks.exact.bounds import certified_horizon, exact_margin, shadow_horizon
from mdnum.forks.exact.program import with_policy
from mdnum.md.cell import Cell, HostCell
from mdnum.md.decide import CONVENTIONS, PairDecider
from mdnum.precision import PrecisionPolicy
from mdnum.systems.build import Simulation, build

TILTED = np.array([[6.0, 0.0, 0.0], [1.1, 6.3, 0.0], [-0.9, 0.8, 5.7]])


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    offset=st.floats(-4, 4),
    compare=st.sampled_from(CONVENTIONS),
    roles=st.sampled_from([("float64", "float64"), ("float32", "float32"), ("float64", "float32")]),
)
def test_a_decision_further_away_than_its_bound_is_the_exact_one(seed, offset, compare, roles):
    state, dtype = roles
    cell = Cell.create(TILTED)
    radius = 2.3
    decider = PairDecider((radius,), compare, dtype, cell.reach(np.zeros((0, 3))), state)
    rng = np.random.default_rng(seed)
    start = rng.random(3) @ TILTED
    direction = rng.standard_normal(3)
    # some roundings away from the cutoff, across a face or not
    r = radius * (1 + offset * float(np.finfo(dtype).eps))
    end = start + r * direction / np.linalg.norm(direction)
    end = end - np.floor(end @ np.asarray(cell.inverse)) @ TILTED
    start, end = (a.astype(state) for a in (start, end))
    d = HostCell(cell, dtype).displacement(start[None], end[None])
    quantity = float(decider.host_quantity(*d)[0])
    value = decider.thresholds[0].value
    margin = Fraction(value) - Fraction(quantity)
    exact, inside = exact_margin(decider, cell, start, end)
    # the sign of the exact margin is the exact decision
    assert inside == (exact >= 0 if compare.endswith("<=") else exact > 0)
    assert abs(margin - exact) <= decider.bounds[0]
    if abs(margin) > decider.bounds[0]:
        assert bool(decider.inside(quantity, value)) == inside


def system(policy: PrecisionPolicy | None = None, kind: str = "hard") -> Simulation:
    cutoff = {"kind": kind, "radius": 1.55}
    dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 2.9, "seed": 11}
    simulation = build(
        small_systems.make(
            small_systems.crystal(2, 0.02, 1.68),
            small_systems.LENNARD_JONES,
            cutoff,
            dynamics=dynamics,
            neighbors={"skin": 0.1},
        )
    )
    return simulation if policy is None else with_policy(simulation, policy)


NARROW = PrecisionPolicy("float32", "float32", "float32", "float32")


def test_horizons_of_a_narrow_run_and_a_wide_one():
    narrow = certified_horizon(system(NARROW), 400)
    wide = certified_horizon(system(), 400)
    assert wide.horizon is None and wide.wrong is None and wide.total == 0
    assert narrow.horizon is not None and narrow.total == len(narrow.decisions) > 0
    first = narrow.decisions[0]
    assert first.step == narrow.horizon and abs(first.margin) <= first.bound
    assert narrow.closest[: narrow.horizon].min() > narrow.bounds[0]
    for one in narrow.decisions:
        assert abs(one.margin - one.exact) <= one.bound
        # r2 < : inside where the exact margin is above zero
        assert one.wrong == (one.inside != (one.exact > 0))
    if narrow.wrong is not None:
        assert narrow.wrong >= narrow.horizon


def test_the_recorder_counts_what_is_listed():
    from mdnum.rollout.engine import Engine
    from mdnum.rollout.flips import PairRecorder

    simulation = system(NARROW)
    recorder = PairRecorder(simulation)
    counted = sum(int(recorder.ambiguous(segment).sum()) for segment in Engine(simulation, 400).segments())
    found = certified_horizon(simulation, 400)
    assert found.bounds == simulation.decider.bounds
    assert counted == found.total


def test_a_wrong_decision_is_told(monkeypatch: pytest.MonkeyPatch):
    """Margins of the opposite sign, planted: every ambiguous decision is then wrong."""
    honest = certified_horizon(system(NARROW), 400)
    assert honest.total

    def planted(*given):
        margin, inside = exact_margin(*given)
        return -margin, not inside

    monkeypatch.setattr(exact_bounds, "exact_margin", planted)
    told = certified_horizon(system(NARROW), 400)
    assert [one.wrong for one in told.decisions] == [not one.wrong for one in honest.decisions]


def test_shadows():
    pytest.importorskip("flint", reason="exact runs need python-flint")
    wide = shadow_horizon(system(), 30)
    assert wide.shadow == "exact" and wide.horizon is None
    narrow = shadow_horizon(system(NARROW), 400)
    assert narrow.shadow == "float64" and narrow.steps == 400
    assert narrow.horizon is not None and 20 < narrow.horizon < 350


def test_what_gives_no_bound_is_refused():
    simulation = system()
    unsafe = replace(simulation, rule=replace(simulation.rule, every=5))
    with pytest.raises(InputError, match="may leave pairs out"):
        certified_horizon(unsafe, 10)
