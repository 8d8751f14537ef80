"""Singular values against those of a matrix that finite differences of runs make, column by column."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from small_systems import LENNARD_JONES, make

from mdnum.errors import InputError
from mdnum.gradients import Problem
from mdnum.gradients.diagnose.growth import CLOCK_STEPS
from mdnum.gradients.diagnose.spectrum import Jacobian, spectrum
from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.parameters import with_values
from mdnum.gradients.tape import RunTape
from mdnum.rollout.engine import Engine
from mdnum.systems import build

STEPS = 60


# each compiles passes of its own
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def problem():
    """Four atoms that collide."""
    places = [[2, 2, 2], [3.2, 2.1, 2], [2, 3.2, 2.1], [3.1, 3.1, 2.9]]
    atoms = Atoms("Ar4", positions=places, cell=[6, 6, 6], pbc=True)
    atoms.set_array("masses", np.ones(4))
    simulation = build(make(atoms, LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}))
    return Problem(simulation, FinalProjection(), STEPS)


def matrix(problem: Problem, clock: float) -> np.ndarray:
    """The Jacobian by central differences of the state with which step T begins."""
    simulation = problem.simulation

    def end(flat: np.ndarray) -> np.ndarray:
        x, v = flat.reshape(2, 3, -1)
        moved = with_values(simulation, {"initial.positions": x.T, "initial.velocities": v.T / clock})
        *_, segment = Engine(moved, STEPS - 1).segments()
        whole = np.asarray(segment.state.x) + np.asarray(simulation.cell.matrix).T @ np.asarray(
            segment.state.images
        )
        return np.concatenate([whole.ravel(), clock * np.asarray(segment.state.v).ravel()])

    start = np.concatenate([simulation.positions.T.ravel(), clock * simulation.velocities.T.ravel()])
    h, columns = 1e-6, []
    for k in range(len(start)):
        step = np.zeros_like(start)
        step[k] = h
        columns.append((end(start + step) - end(start - step)) / (2 * h))
    return np.stack(columns, axis=1)


@pytest.fixture(scope="module")
def dense(problem):
    """Singular values of the matrix of differences."""
    clock = CLOCK_STEPS * float(problem.simulation.integrator.timestep)
    return np.linalg.svd(matrix(problem, clock), compute_uv=False)


def test_singular_values_are_those_of_the_matrix_of_differences(problem, dense):
    # as many vectors as coordinates: nothing is left to convergence
    found = spectrum(problem, values=4, extra=20, rounds=1)
    assert dense[0] > 3
    np.testing.assert_allclose(np.exp(found.log_singular), dense[:4], rtol=1e-6)
    assert np.all(found.residual < 1e-9) and found.transposed < 1e-12
    np.testing.assert_allclose(found.exponents * STEPS, found.log_singular)


def test_a_few_vectors_find_the_largest_within_their_residual(problem, dense):
    found = spectrum(problem, values=1, extra=3, rounds=4)
    assert abs(np.exp(found.log_singular[0]) / dense[0] - 1) < found.residual[0] < 0.1


def test_energy_keeping_steps_come_in_pairs(problem):
    """With unit masses every step is symplectic in (x, v): singular values of the map are s and 1/s."""
    tape = RunTape(problem.simulation, problem.loss, STEPS)
    identity = Jacobian(tape, 1.0).forward(np.eye(24))
    sizes = np.linalg.svd(identity.basis @ identity.mixing, compute_uv=False) * np.exp(identity.log_scale)
    np.testing.assert_allclose(sizes * sizes[::-1], 1.0, rtol=1e-8)
    assert sizes[0] > 3


def test_bad_input_is_refused(problem):
    with pytest.raises(InputError, match="singular values"):
        spectrum(problem, values=25)
