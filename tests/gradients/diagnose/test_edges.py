"""Boundaries of decisions along a parameter, against where free flight puts them."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from small_systems import LENNARD_JONES, make

from mdnum.errors import InputError
from mdnum.gradients import Problem
from mdnum.gradients.diagnose.edges import edges
from mdnum.gradients.losses import MeanSquaredDisplacement
from mdnum.gradients.parameters import with_values
from mdnum.systems import build

APART, RADIUS, SPEED, STEPS = 2.3, 2.2, 1.0, 20


# each compiles passes of its own
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def problem():
    """Two atoms that fly toward one another and enter their cutoff at step 13, and do nothing else."""
    atoms = Atoms("Ar2", positions=[[1, 3, 3], [1 + APART, 3, 3]], cell=[9, 9, 9], pbc=True)
    atoms.set_array("masses", np.ones(2))
    simulation = build(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": RADIUS}))
    velocities = np.array([[SPEED, 0, 0], [-SPEED, 0, 0]])
    return Problem(
        with_values(simulation, {"initial.velocities": velocities}), MeanSquaredDisplacement(), STEPS
    )


@pytest.fixture(scope="module")
def found(problem):
    return edges(problem, "temperature", reach=0.5)


def test_boundaries_lie_where_free_flight_puts_them(problem, found):
    """The pair enters at the first step k with APART - 2 v k dt < RADIUS, and v goes with the root of T."""
    timestep = float(problem.simulation.integrator.timestep)
    entered = int(np.ceil((APART - RADIUS) / (2 * SPEED * timestep)))
    assert entered == 13
    for edge, k in ((found.above, entered - 1), (found.below, entered)):
        speed = (APART - RADIUS) / (2 * k * timestep)
        expected = (speed / SPEED) ** 2 * found.value
        assert edge.found and (edge.i, edge.j) == (0, 1)
        assert edge.inside == pytest.approx(expected, rel=1e-12)
        assert edge.beyond == np.nextafter(edge.inside, np.inf if edge.side == "above" else -np.inf)
        assert edge.distance == abs(edge.inside - found.value)
        # hotter, it is inside a step earlier
        assert edge.step == k


def test_the_gradient_jumps_where_the_kicks_do(found):
    """One more or one fewer kick inside the cutoff."""
    for edge in (found.below, found.above):
        inside, beyond = edge.gradient_inside["symmetric"], edge.gradient_beyond["symmetric"]
        assert abs(beyond - inside) > 1e-6 * abs(inside)
        assert edge.value_beyond != edge.value_inside


def test_where_nothing_changes_within_reach_that_is_said(problem):
    near = edges(problem, "temperature", reach=1e-6)
    assert not near.below.found and not near.above.found and np.isnan(near.above.inside)


def test_along_the_radius_a_boundary_is_where_the_distance_is(problem):
    found = edges(problem, "r_cut", reach=0.02)
    timestep = float(problem.simulation.integrator.timestep)
    # the pair is outside at step 12 and inside at step 13
    outside, inside = (APART - 2 * SPEED * k * timestep for k in (12, 13))
    assert found.above.beyond == pytest.approx(outside, rel=1e-12)
    assert found.below.inside == pytest.approx(inside, rel=1e-12)
    assert found.above.gradient_inside["symmetric"] == 0.0


def test_bad_input_is_refused(problem):
    with pytest.raises(InputError, match="6 entries"):
        edges(problem, "v0")
    with pytest.raises(InputError, match="reach"):
        edges(problem, "sigma", reach=2.0)
