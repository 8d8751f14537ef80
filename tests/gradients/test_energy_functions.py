"""Gradients through energy functions that lose neighbors, against an integrator with events in numpy."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from scipy.integrate import solve_ivp

import mdnum
from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import EventAware, Symmetric
from mdnum.md.energies import EnergyFunction
from mdnum.md.jaxmd import neighbor_vectors

RADIUS, TIME = 1.9, 1.2
PLACES = np.array([[0, 0, 0], [1.2, 0.1, 0], [0.5, 1.3, 0.2], [0.6, 0.5, 1.35]])
SPEEDS = np.array([[-0.3, 0, 0.1], [0.9, -0.4, 0], [0, 0.8, 0.1], [-0.2, 0.1, 0.7]])
SPEEDS = SPEEDS - SPEEDS.mean(axis=0)
A, B = 1.5, 0.8
WAY = np.random.default_rng(5).standard_normal((3, 4))


def truncated(parameters, R, neighbor, cell):
    """An embedded atom whose pair energy and density both end where they are not 0."""
    real = neighbor.idx < len(R)
    d = neighbor_vectors(R, neighbor.idx, cell, (False, False, False))
    r = jnp.sqrt(jnp.where(real, jnp.sum(d * d, axis=-1), 1.0))
    pair = jnp.where(real, parameters["a"] * jnp.exp(-2 * r), 0.0)
    density = jnp.sum(jnp.where(real, parameters["b"] * jnp.exp(-r), 0.0), axis=1)
    return 0.5 * jnp.sum(pair) - jnp.sum(jnp.sqrt(0.1 + density))


def pull(x: np.ndarray, inside: np.ndarray, a: float, b: float) -> np.ndarray:
    """Its forces with some pairs, by hand."""
    d = x[None] - x[:, None]
    r = np.sqrt(np.sum(d * d, axis=-1) + np.eye(len(x)))
    density = np.sum(np.where(inside, b * np.exp(-r), 0), axis=1)
    slope = -0.5 / np.sqrt(0.1 + density)
    along = np.where(inside, -2 * a * np.exp(-2 * r) - (slope[:, None] + slope) * b * np.exp(-r), 0)
    return np.sum((along / r)[..., None] * d, axis=1)


def flow(x0: np.ndarray, v0: np.ndarray, a: float, b: float) -> tuple[float, int]:
    """The loss at the end of the exact motion, and how many pairs crossed on the way."""
    i, j = np.triu_indices(len(x0), 1)

    def distances(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x[j] - x[i], axis=1)

    def crossing(k: int):
        def margin(t, y):
            return distances(y[:12].reshape(4, 3))[k] - RADIUS

        margin.terminal = True
        return margin

    y, t, crossed = np.concatenate([x0.ravel(), v0.ravel()]), 0.0, 0
    near = distances(x0) < RADIUS
    while t < TIME:
        inside = np.zeros((4, 4), bool)
        inside[i[near], j[near]] = inside[j[near], i[near]] = True

        def rate(t, y, inside=inside):
            return np.concatenate([y[12:], pull(y[:12].reshape(4, 3), inside, a, b).ravel()])

        events = [crossing(k) for k in range(6)]
        made = solve_ivp(rate, (t, TIME), y, "DOP853", rtol=1e-11, atol=1e-12, events=events)
        t, y = made.t[-1], made.y[:, -1]
        met = [k for k in range(6) if len(made.t_events[k]) and made.t_events[k][-1] == t]
        for k in met:
            near[k], crossed = not near[k], crossed + 1
        # beyond the event, so that it is not met again
        y[:12] += 1e-9 * y[12:]
        t += 1e-9
    return float(np.sum(WAY.T * y[:12].reshape(4, 3)) / 4), crossed


@pytest.mark.jax_md
def test_what_a_lost_neighbor_does_to_an_embedded_atom_is_part_of_the_gradient():
    atoms = Atoms("Ar4", positions=PLACES, pbc=False)
    atoms.set_masses([1.0] * 4)
    atoms.set_velocities(SPEEDS)
    parameters = {"a": jnp.asarray(A), "b": jnp.asarray(B)}
    function = EnergyFunction(parameters, truncated, RADIUS, format="dense")
    dt = 0.001
    one = mdnum.simulation(atoms, function, units="lj", timestep=dt, skin=0.3)
    assert one.imposable and one.model.smoothness.order == -1
    problem = Problem(one, FinalProjection(direction=jnp.asarray(WAY)), round(TIME / dt))
    names = ("potential.parameters.a", "potential.parameters.b", "initial.positions")
    aware, steps = EventAware()(problem, names), Symmetric()(problem, names)
    value, crossed = flow(PLACES, SPEEDS, A, B)
    assert aware.value == pytest.approx(value, rel=1e-3)
    assert aware.details["crossings"] == crossed > 1
    h = 1e-4
    true = {
        names[0]: (flow(PLACES, SPEEDS, A + h, B)[0] - flow(PLACES, SPEEDS, A - h, B)[0]) / (2 * h),
        names[1]: (flow(PLACES, SPEEDS, A, B + h)[0] - flow(PLACES, SPEEDS, A, B - h)[0]) / (2 * h),
    }
    along = np.random.default_rng(2).standard_normal((4, 3))
    shifted = [flow(PLACES + s * h * along, SPEEDS, A, B)[0] for s in (1, -1)]
    true[names[2]] = (shifted[0] - shifted[1]) / (2 * h)
    for name, expected in true.items():
        found, without = (
            float(np.sum(one.gradient[name] * (along if name == names[2] else 1.0))) for one in (aware, steps)
        )
        print(name, expected, found, without)
        assert found == pytest.approx(expected, rel=5e-3)
        assert abs(without - expected) > 5 * abs(found - expected)
