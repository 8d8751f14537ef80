"""Derivatives of the steps against answers that no code of the package enters: fifty digits, normal modes."""

from __future__ import annotations

import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from ase import Atoms
from small_systems import LENNARD_JONES, make

from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import Forward, Symmetric
from mdnum.gradients.tape import RunTape
from mdnum.gradients.unrolled import Unrolled
from mdnum.systems import build

METHODS = (Symmetric(), Forward(), Unrolled(), Unrolled(snapshots=2))


def in_fifty_digits(problem: Problem, changes: dict[str, mp.mpf]) -> mp.mpf:
    """The loss of velocity Verlet in mpmath, with some numbers shifted."""
    simulation = problem.simulation
    sigma, epsilon, h = (1 + changes.get(k, mp.mpf(0)) for k in ("sigma", "epsilon", "timestep"))
    h = h * mp.mpf(float(simulation.integrator.timestep))
    stretch = 1 + changes.get("scale", mp.mpf(0))
    heat = mp.sqrt(1 + changes.get("temperature", mp.mpf(0)))
    x = [[mp.mpf(float(c)) * stretch for c in row] for row in simulation.positions]
    v = [[mp.mpf(float(c)) * heat for c in row] for row in simulation.velocities]
    x[0][1] += changes.get("x0", mp.mpf(0))
    v[2][0] += changes.get("v0", mp.mpf(0))
    cut = mp.mpf(float(simulation.r_cut))
    atoms = range(len(x))

    def forces():
        out = [[mp.mpf(0)] * 3 for _ in atoms]
        for i in atoms:
            for j in range(i + 1, len(x)):
                d = [b - a for a, b in zip(x[i], x[j], strict=True)]
                r2 = mp.fsum(c * c for c in d)
                if mp.sqrt(r2) >= cut:
                    continue
                s6 = (sigma * sigma / r2) ** 3
                pull = 24 * epsilon * (s6 - 2 * s6 * s6) / r2
                for k in range(3):
                    out[i][k] += pull * d[k]
                    out[j][k] -= pull * d[k]
        return out

    f = forces()
    for _ in range(problem.steps):
        for i in atoms:
            for k in range(3):
                v[i][k] += h / 2 * f[i][k]
                x[i][k] += h * v[i][k]
        f = forces()
        for i in atoms:
            for k in range(3):
                v[i][k] += h / 2 * f[i][k]
    way = np.asarray(problem.loss.direction)
    return mp.fsum(mp.mpf(float(way[k, i])) * x[i][k] for i in atoms for k in range(3)) / len(x)


@pytest.mark.slow
def test_four_atoms_have_the_derivatives_of_fifty_digits():
    """A hard cutoff that pairs cross on the way: the derivative of the steps, decisions held."""
    places = np.array([[0, 0, 0], [1.1, 0.1, 0], [0.4, 1.2, 0.2], [0.3, 0.3, 1.9]])
    atoms = Atoms("Ar4", positions=places, pbc=False)
    atoms.set_masses([1.0] * 4)
    dynamics = {"kind": "nve", "timestep": 0.01, "temperature": 1.5, "seed": 3}
    simulation = build(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": 2.0}, dynamics=dynamics))
    way = jnp.asarray(np.random.default_rng(5).standard_normal((3, 4)))
    problem = Problem(simulation, FinalProjection(direction=way), 60)
    names = ("sigma", "epsilon", "timestep", "temperature", "scale")
    tape = RunTape(simulation, problem.loss, problem.steps, flips=True)
    assert sum(len(stretch.ledger) for stretch in tape.backward()) > 1
    mp.mp.dps = 50
    assert problem.value() == pytest.approx(float(in_fifty_digits(problem, {})), rel=1e-11)
    step = mp.mpf(10) ** -18
    expected = {}
    for name in (*names, "x0", "v0"):
        high, low = (in_fifty_digits(problem, {name: q}) for q in (step, -step))
        expected[name] = float((high - low) / (2 * step))
    expected["timestep"] /= 0.01
    expected["temperature"] /= 1.5
    for method in METHODS:
        found = method(problem, (*names, "x0", "v0"))
        seen = dict(zip((*names, "x0", "v0"), found.gradient.values(), strict=True))
        seen["x0"], seen["v0"] = seen["x0"][0, 1], seen["v0"][2, 0]
        for name, value in expected.items():
            assert float(seen[name]) == pytest.approx(value, rel=1e-10), (method.name, name)


@pytest.mark.slow
def test_a_harmonic_ring_has_the_derivatives_of_its_normal_modes():
    """Soft spheres in touch are springs: velocity Verlet turns each mode by a known angle a step."""
    count, spacing, sigma, epsilon, h, steps = 6, 0.8, 1.0, 3.0, 0.02, 150
    rng = np.random.default_rng(4)
    u0 = 0.02 * rng.standard_normal(count)
    places = np.zeros((count, 3))
    places[:, 0] = spacing * np.arange(count) + u0
    atoms = Atoms(f"Ar{count}", positions=places, cell=[spacing * count, 9, 9], pbc=[True, False, False])
    atoms.set_masses([1.0] * count)
    v0 = 0.02 * rng.standard_normal(count)
    atoms.set_velocities(np.stack([v0, 0 * v0, 0 * v0], axis=1))
    potential = {"kind": "soft-sphere", "sigma": sigma, "epsilon": epsilon, "alpha": 2.0}
    system = make(
        atoms,
        potential,
        {"kind": "hard", "radius": sigma},
        dynamics={"kind": "nve", "timestep": h, "temperature": 1.0, "seed": 1, "remove_drift": False},
    )
    simulation = build(system)
    moving = simulation.velocities[:, 0]
    way = rng.standard_normal(count)
    direction = np.zeros((3, count))
    direction[0] = way
    problem = Problem(simulation, FinalProjection(direction=jnp.asarray(direction)), steps)

    # second differences around the ring
    ring = 2 * np.eye(count) - np.roll(np.eye(count), 1, axis=0) - np.roll(np.eye(count), -1, axis=0)
    stiffness, modes = np.linalg.eigh(ring)

    def turned(epsilon, h):
        """Factors of position and velocity of each mode after all steps."""
        w2 = epsilon / sigma**2 * stiffness[1:]
        angle = np.arccos(1 - w2 * h * h / 2 + 0j)
        speed = np.sqrt(w2 * (1 - w2 * h * h / 4) + 0j)
        a = np.concatenate([[1.0], np.cos(steps * angle)])
        b = np.concatenate([[steps * h], np.sin(steps * angle) / speed])
        return modes * a @ modes.T, modes * b @ modes.T

    def loss(epsilon, h):
        a, b = turned(epsilon, h)
        rest = spacing * np.arange(count)
        return way @ (rest + a @ u0 + b @ moving) / count

    # no difference is taken: the step is imaginary
    tiny = 1e-30
    a, b = (part.real for part in turned(epsilon, h))
    by_x, by_v = np.zeros((count, 3)), np.zeros((count, 3))
    by_x[:, 0], by_v[:, 0] = a @ way / count, b @ way / count
    expected = {
        "epsilon": np.asarray(loss(epsilon + 1j * tiny, h).imag / tiny),
        "timestep": np.asarray(loss(epsilon, h + 1j * tiny).imag / tiny),
        "x0": by_x,
        "v0": by_v,
    }
    assert problem.value() == pytest.approx(float(loss(epsilon, h).real), rel=1e-11)
    for method in (Symmetric(), Forward()):
        found = method(problem, tuple(expected))
        for name, value in zip(found.gradient, expected.values(), strict=True):
            # across the ring there are forces in one direction alone
            seen = found.gradient[name][:, 0] if value.ndim else found.gradient[name]
            mine = value[:, 0] if value.ndim else value
            assert np.max(np.abs(seen - mine)) <= 1e-9 * np.max(np.abs(mine)), (method.name, name)
