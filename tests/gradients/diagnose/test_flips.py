"""Contributions of single flips, against the two gradients between which they stand."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients import Problem
from mdnum.gradients.diagnose import GradientDiagnosis, diagnose, flips
from mdnum.gradients.diagnose.flips import FlipTerms
from mdnum.gradients.losses import MeanSquaredDisplacement
from mdnum.plain import plain
from mdnum.systems import build

# each compiles a reverse pass and one of tangents
pytestmark = pytest.mark.slow

NAMES = ("potential.sigma", "cutoff.radius", "dynamics.temperature")


@pytest.fixture(scope="module")
def problem():
    simulation = build(make(crystal(), LENNARD_JONES, {"kind": "hard", "radius": 2.2}))
    return Problem(simulation, MeanSquaredDisplacement(), 100)


@pytest.fixture(scope="module")
def whole(problem) -> GradientDiagnosis:
    parts = ("growth", "agreement", "flips", "detective", "scaling")
    return diagnose(problem, (*NAMES, "v0"), parts=parts, methods=["event-aware", "symmetric"])


@pytest.fixture(scope="module")
def found(whole) -> FlipTerms:
    return whole.flips


def test_all_parts_tell_of_one_run(problem, whole):
    assert not whole.failed and whole.value == problem.value()
    aware = whole.agreement.gradient("event-aware")
    for name in NAMES:
        value = float(aware.gradient[name])
        assert whole.growth.table[f"gradient.{name}"][-1] == pytest.approx(value, rel=1e-12)
        assert whole.flips.total[name] == pytest.approx(value, rel=1e-12)
    means = {(one.name, one.meaning) for one in whole.agreement.comparisons}
    assert ("cutoff.radius", "missing saltation") in means
    assert not whole.detective.found and whole.scaling.format == "float16"
    written = json.loads(json.dumps(plain(whole), allow_nan=False))
    assert written["growth"]["word"] == whole.growth.word and written["trust"] is None


def test_contributions_sum_to_what_event_aware_adds(whole, found):
    """The two gradients come from reverse passes, the contributions from tangents too."""
    aware, plain = (whole.agreement.gradient(word).gradient for word in ("event-aware", "symmetric"))
    assert found.flips > 100
    for name in NAMES:
        added = float(aware[name] - plain[name])
        assert found.contribution(name).sum() == pytest.approx(added, rel=1e-9), name
        assert found.smooth[name] == pytest.approx(float(plain[name]), rel=1e-9, abs=1e-12), name
        assert sum(found.share[name].values()) == pytest.approx(1.0, rel=1e-9), name
    assert found.smooth["cutoff.radius"] == 0.0 and found.half["cutoff.radius"] < found.flips


def test_the_heaviest_come_first_and_the_start_is_skipped(found):
    sizes = [np.abs(parts) / np.abs(parts).sum() for parts in map(found.contribution, found.total)]
    heaviest = np.max(sizes, axis=0)
    assert np.all(np.diff(heaviest) <= 0)
    assert found.skipped == {"initial.velocities": 324}
    assert {len(column) for column in found.table.values()} == {found.flips}


def test_by_the_start_alone_there_are_no_contributions(problem):
    with pytest.raises(InputError, match="324 entries"):
        flips(problem, ("v0",))


def test_what_grazes_contributes_nothing(problem, found):
    """With a guard above most speeds."""
    guarded = flips(problem, NAMES, guard=1.0)
    grazing, speed = guarded.table["grazing"], np.abs(guarded.table["radial_speed"])
    assert 0 < guarded.grazing == grazing.sum() < guarded.flips and not found.grazing
    assert not guarded.contribution("cutoff.radius")[grazing].any()
    assert np.all(speed[grazing] < speed[~grazing].min())
