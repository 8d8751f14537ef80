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
from mdnum.forks.exact.bounds import certified_horizon, exact_margin, margin_bounds, shadow_horizon
from mdnum.forks.exact.program import with_policy
from mdnum.md.cell import Cell, HostCell
from mdnum.md.decide import CONVENTIONS, PairDecider
from mdnum.precision import PrecisionPolicy
from mdnum.systems.build import Simulation, build

CUBE = np.diag([6.0, 7.1, 5.3])
TILTED = np.array([[6.0, 0.0, 0.0], [1.1, 6.3, 0.0], [-0.9, 0.8, 5.7]])


def rational_square(start, end, matrix, dtype) -> Fraction:
    """The nearest image's squared distance by trying all images around, in rationals."""
    rows = [[Fraction(float(c)) for c in row] for row in np.asarray(matrix, dtype)]
    d = [Fraction(float(b)) - Fraction(float(a)) for a, b in zip(start, end, strict=True)]
    best = None
    for n in np.ndindex(5, 5, 5):
        m = [k - 2 for k in n]
        image = [d[c] - sum(m[k] * rows[k][c] for k in range(3)) for c in range(3)]
        square = sum((c * c for c in image), start=Fraction(0))
        best = square if best is None or square < best else best
    assert best is not None
    return best


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    offset=st.floats(-4, 4),
    compare=st.sampled_from(CONVENTIONS),
    roles=st.sampled_from([("float64", "float64"), ("float32", "float32"), ("float64", "float32")]),
    tilted=st.booleans(),
)
def test_the_bound_holds_near_the_cutoff(seed, offset, compare, roles, tilted):
    state, dtype = roles
    matrix = TILTED if tilted else CUBE
    cell = Cell.create(matrix, True)
    extent = tuple(float(c) for c in np.abs(matrix).sum(axis=0))
    radius = 2.3
    decider = PairDecider((radius,), compare, dtype, extent)
    rng = np.random.default_rng(seed)
    start = rng.random(3) @ matrix
    direction = rng.standard_normal(3)
    # some roundings away from the cutoff, across a face or not
    r = radius * (1 + offset * float(np.finfo(dtype).eps))
    end = start + r * direction / np.linalg.norm(direction)
    end = end - np.floor(end @ np.asarray(cell.inverse)) @ matrix
    start, end = (a.astype(state) for a in (start, end))
    d = HostCell(cell, dtype).displacement(start[None], end[None])
    quantity = decider.host_quantity(*d)[0]
    value = decider.thresholds[0].value
    margin = Fraction(value) - Fraction(float(quantity))
    largest = float(np.abs(np.stack([start, end])).max())
    bound = margin_bounds(decider, state, largest)[0]
    exact, inside = exact_margin(decider, cell, start, end)
    assert abs(margin - exact) <= bound
    # and the exact margin is the one of the nearest of 125 images
    square = rational_square(start, end, matrix, dtype)
    if decider.space == "r2":
        assert exact == Fraction(value) - square
    else:
        root = Fraction(value) - exact
        assert root**2 <= square < (root + Fraction(1, 2**390)) ** 2
    against = Fraction(value) ** (2 if decider.space == "r" else 1)
    assert inside == (square <= against if compare.endswith("<=") else square < against)
    # a decision that is further away than the bound is the exact one
    if abs(margin) > bound:
        assert bool(decider.inside(float(quantity), value)) == inside


def test_the_bound_is_not_far_too_large():
    """The largest error of 2,000 random pairs is within a factor 30 of the bound."""
    cell = Cell.create(TILTED, True)
    decider = PairDecider((2.3,), "r2 <", "float32", tuple(np.abs(TILTED).sum(axis=0).tolist()))
    rng = np.random.default_rng(1)
    start = (rng.random((2000, 3)) @ TILTED).astype(np.float32)
    direction = rng.standard_normal((2000, 3))
    end = start + 2.3 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    end = (end - np.floor(end @ np.asarray(cell.inverse)) @ TILTED).astype(np.float32)
    d = HostCell(cell, "float32").displacement(start, end)
    margin = decider.thresholds[0].value - decider.host_quantity(*d).astype(np.float64)
    exact = [float(exact_margin(decider, cell, a, b)[0]) for a, b in zip(start, end, strict=True)]
    bound = margin_bounds(decider, "float32")[0]
    assert bound / 30 < np.max(np.abs(margin - exact)) <= bound


def system(policy: PrecisionPolicy | None = None, kind: str = "hard") -> Simulation:
    cutoff = {"kind": kind, "radius": 1.55}
    dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 2.9, "seed": 3}
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


def test_ambiguous_decisions_agree_with_the_recorders_count():
    """The recorder counts by the older, narrower bound: never more than are listed here."""
    from mdnum.rollout.engine import Engine
    from mdnum.rollout.flips import PairRecorder

    simulation = system(NARROW)
    recorder = PairRecorder(simulation)
    counted = sum(int(recorder.ambiguous(segment).sum()) for segment in Engine(simulation, 400).segments())
    found = certified_horizon(simulation, 400)
    assert abs(found.bounds[0] / simulation.decider.bounds[0] - 1) < 0.01
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


def test_a_state_wider_than_the_decision_is_off_by_its_narrowing():
    """Far from the origin nearly all of the error is in the cast of the positions."""
    cell = Cell.create(np.zeros((3, 3)), False)
    decider = PairDecider((2.3,), "r2 <", "float32", (3.0, 3.0, 3.0))
    rng = np.random.default_rng(5)
    start = 3000 + rng.random((200, 3))
    direction = rng.standard_normal((200, 3))
    end = start + 2.3 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    d = HostCell(cell, "float32").displacement(start, end)
    margin = decider.thresholds[0].value - decider.host_quantity(*d).astype(np.float64)
    exact = [float(exact_margin(decider, cell, a, b)[0]) for a, b in zip(start, end, strict=True)]
    error = np.abs(margin - exact).max()
    assert margin_bounds(decider, "float32")[0] < error
    assert error <= margin_bounds(decider, "float64", np.full(3, 3004.0))[0] < 30 * error
