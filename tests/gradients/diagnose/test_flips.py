"""Contributions of single flips, against the two gradients between which they stand; boundaries of decisions,
against where free flight puts them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from ase import Atoms
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients import Problem
from mdnum.gradients.diagnose import diagnose, edges, flips
from mdnum.gradients.losses import MeanSquaredDisplacement
from mdnum.gradients.parameters import with_values
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
def whole(problem) -> Any:
    parts = ("growth", "agreement", "flips", "detective", "scaling")
    return diagnose(problem, (*NAMES, "v0"), parts=parts, methods=["event-aware", "symmetric"])


def test_all_parts_tell_of_one_run(problem, whole):
    assert not whole.failed and whole.value == problem.value()
    means = {(one.name, one.meaning) for one in whole.agreement.comparisons}
    assert ("cutoff.radius", "missing saltation") in means
    assert not whole.detective.found and whole.scaling.format == "float16"
    written = json.loads(json.dumps(plain(whole), allow_nan=False))
    assert written["growth"]["word"] == whole.growth.word and written["trust"] is None
    with pytest.raises(InputError, match="324 entries"):
        flips(problem, ("v0",))


def test_contributions_sum_to_what_event_aware_adds_the_heaviest_first(whole):
    """The two gradients come from reverse passes, the contributions from tangents too."""
    aware, steps = (whole.agreement.gradient(word).gradient for word in ("event-aware", "symmetric"))
    found, heaviest = whole.flips, 0.0
    assert found.flips > 100 and {len(column) for column in found.table.values()} == {found.flips}
    for name in NAMES:
        parts = found.table[f"contribution.{name}"]
        heaviest = np.maximum(heaviest, np.abs(parts) / np.abs(parts).sum())
        assert parts.sum() == pytest.approx(float(aware[name] - steps[name]), rel=1e-9), name
        assert found.smooth[name] == pytest.approx(float(steps[name]), rel=1e-9, abs=1e-12), name
        assert sum(found.share[name].values()) == pytest.approx(1.0, rel=1e-9), name
        assert found.total[name] == pytest.approx(float(aware[name]), rel=1e-12)
        assert whole.growth.table[f"gradient.{name}"][-1] == pytest.approx(found.total[name], rel=1e-12)
    assert found.smooth["cutoff.radius"] == 0.0 and found.half["cutoff.radius"] < found.flips
    assert np.all(np.diff(heaviest) <= 0) and found.skipped == {"initial.velocities": 324}


def test_what_grazes_contributes_nothing(problem, whole):
    """With a guard above most speeds."""
    guarded = flips(problem, NAMES, guard=1.0)
    grazing, speed = guarded.table["grazing"], np.abs(guarded.table["radial_speed"])
    assert 0 < guarded.grazing == grazing.sum() < guarded.flips and not whole.flips.grazing
    assert not guarded.table["contribution.cutoff.radius"][grazing].any()
    assert np.all(speed[grazing] < speed[~grazing].min())


# --- boundaries --------------------------------------------------------------------------------------

APART, RADIUS, SPEED, STEPS = 2.3, 2.2, 1.0, 20


@pytest.fixture(scope="module")
def flying():
    """Two atoms that fly toward one another and enter their cutoff at step 13, and do nothing else."""
    atoms = Atoms("Ar2", positions=[[1, 3, 3], [1 + APART, 3, 3]], cell=[9, 9, 9], pbc=True)
    atoms.set_array("masses", np.ones(2))
    simulation = build(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": RADIUS}))
    velocities = np.array([[SPEED, 0, 0], [-SPEED, 0, 0]])
    return Problem(
        with_values(simulation, {"initial.velocities": velocities}), MeanSquaredDisplacement(), STEPS
    )


def test_boundaries_lie_where_free_flight_puts_them(flying):
    """The pair enters at the first step k with APART - 2 v k dt < RADIUS, and v goes with the root of T."""
    near = edges(flying, "temperature", reach=0.5)
    timestep = float(flying.simulation.integrator.timestep)
    entered = int(np.ceil((APART - RADIUS) / (2 * SPEED * timestep)))
    assert entered == 13
    for edge, k in ((near.above, entered - 1), (near.below, entered)):
        speed = (APART - RADIUS) / (2 * k * timestep)
        expected = (speed / SPEED) ** 2 * near.value
        assert edge.found and (edge.i, edge.j) == (0, 1)
        assert edge.inside == pytest.approx(expected, rel=1e-12)
        assert edge.beyond == np.nextafter(edge.inside, np.inf if edge.side == "above" else -np.inf)
        assert edge.distance == abs(edge.inside - near.value)
        # hotter, it is inside a step earlier
        assert edge.step == k
        # the gradient jumps where the kicks do: one more or one fewer inside the cutoff
        within, beyond = edge.gradient_inside["symmetric"], edge.gradient_beyond["symmetric"]
        assert abs(beyond - within) > 1e-6 * abs(within) and edge.value_beyond != edge.value_inside


@pytest.mark.nightly
def test_along_the_radius_a_boundary_is_where_the_distance_is(flying):
    found = edges(flying, "r_cut", reach=0.02)
    timestep = float(flying.simulation.integrator.timestep)
    # the pair is outside at step 12 and inside at step 13
    outside, inside = (APART - 2 * SPEED * k * timestep for k in (12, 13))
    assert found.above.beyond == pytest.approx(outside, rel=1e-12)
    assert found.below.inside == pytest.approx(inside, rel=1e-12)
    assert found.above.gradient_inside["symmetric"] == 0.0


def test_where_nothing_changes_within_reach_that_is_said(flying):
    found = edges(flying, "temperature", reach=1e-6)
    assert not found.below.found and not found.above.found and np.isnan(found.above.inside)
    for name, reach, text in (("v0", 0.01, "6 entries"), ("sigma", 2.0, "reach")):
        with pytest.raises(InputError, match=text):
            edges(flying, name, reach=reach)
