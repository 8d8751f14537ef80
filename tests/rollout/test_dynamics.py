"""Dynamics: order and reversibility of the integrator, temperature and noise of the thermostat."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rollout.harness import liquid, shaken, write_system

from mdnum.md.cell import Cell, wrap_positions
from mdnum.md.integrators import Langevin
from mdnum.rollout.engine import Engine, unwrapped
from mdnum.systems import load
from mdnum.systems.build import build

BATH = {"kind": "langevin", "friction": 2.0, "temperature": 1.3, "timestep": 0.005}
QUINTIC = {"kind": "quintic", "onset": 1.5}


def end_of(simulation, last):
    """Velocities and unwrapped positions at the last step."""
    *_, segment = Engine(simulation, last).segments()
    x, v, images = (segment.unsorted(name, segment.rows - 1) for name in ("x", "v", "images"))
    return v, unwrapped(simulation.cell.matrix, x, images)


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    """A fluid whose potential has two continuous derivatives."""
    path = write_system(tmp_path_factory.mktemp("smooth"), liquid(), cutoff=QUINTIC)
    return build(shaken(load(path), 4, 0.7, 0.02))


def test_against_a_plain_velocity_verlet(smooth):
    """Numpy, all pairs, textbook order of operations."""
    box, h = np.diag(smooth.cell.matrix), 0.004
    i, j = np.triu_indices(108, 1)

    def force(x):
        d = x[j] - x[i]
        d -= np.rint(d / box) * box
        r = np.linalg.norm(d, axis=1)
        t = np.clip((r - 1.5) / 0.5, 0, 1)
        s, ds = 1 - 10 * t**3 + 15 * t**4 - 6 * t**5, -30 * t**2 * (1 - t) ** 2 / 0.5
        u, du = 4 * (r**-12 - r**-6), -24 * (2 * r**-13 - r**-7)
        pull = ((du * s + u * ds) / r)[:, None] * d
        total = np.zeros_like(x)
        np.add.at(total, i, pull)
        np.add.at(total, j, -pull)
        return total

    x, v = smooth.positions.copy(), smooth.velocities.copy()
    f = force(x)
    for _ in range(70):
        v = v + 0.5 * h * f
        x = x + h * v
        f = force(x)
        v = v + 0.5 * h * f
    found_v, found = end_of(smooth, 70)
    assert np.max(np.abs(found - x)) < 1e-10
    assert np.max(np.abs(found_v - v)) < 1e-9
    # pairs take from one what they give to the other
    assert np.max(np.abs(found_v.sum(axis=0) - smooth.velocities.sum(axis=0))) < 1e-11


def test_what_is_wrapped_into_a_tilted_box_is_unwrapped_to_where_it_was():
    matrix = np.array([[9.0, 0, 0], [2.5, 8.0, 0], [-1.5, 3.0, 7.0]])
    x = np.random.default_rng(3).normal(0, 40, (50, 3))
    wrapped, images = wrap_positions(Cell.create(matrix, np.ones(3, bool)), x)
    assert (np.abs(images).max(axis=0) > 3).all()
    np.testing.assert_allclose(unwrapped(matrix, wrapped, images), x, rtol=0, atol=1e-12)


def test_noise_and_drift_of_an_atom_do_not_depend_on_its_place_in_the_list():
    """The same atoms in another order: every number of an atom goes with it."""
    rng = np.random.default_rng(2)
    x, v, masses = rng.normal(size=(3, 7)), rng.normal(size=(3, 7)), rng.uniform(0.5, 20.0, 7)
    integrator = Langevin(*map(jnp.float64, (0.01, 2.0, 1.3)), jax.random.key(4))
    order = np.array([3, 0, 6, 1, 5, 2, 4])
    drift = eqx.filter_jit(integrator.drift)
    drifts = [
        [np.asarray(one) for one in drift(x[:, k], v[:, k], masses[k], np.int64(9), k)]
        for k in (np.arange(7), order)
    ]
    for ours, theirs in zip(*drifts, strict=True):
        np.testing.assert_allclose(ours[..., order] if ours.ndim else ours, theirs, rtol=1e-14)
    # the noise itself: one number for each component, none twice
    noise = drifts[0][1] - np.exp(-0.02) * v
    assert len(np.unique(noise)) == 21 and np.abs(noise).min() > 1e-6


@pytest.fixture(scope="module")
def bath(tmp_path_factory):
    return write_system(tmp_path_factory.mktemp("bath"), liquid(rattle=0.03), dynamics=BATH)


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    """Energies of 3000 steps in the bath, of a fluid whose energy does not jump."""
    path = write_system(tmp_path_factory.mktemp("warm"), liquid(rattle=0.03), dynamics=BATH, cutoff=QUINTIC)
    columns = {name: [] for name in ("potential", "kinetic", "heat")}
    for segment in Engine(build(load(path)), 3000, record=False).segments():
        for name, parts in columns.items():
            parts.append(np.array(segment.rows_of(name)))
    return {name: np.concatenate(parts)[500:] for name, parts in columns.items()}


def test_a_thermostat_holds_its_temperature_and_keeps_the_books(warm):
    settled = 2 * warm["kinetic"] / (3 * 108)
    # error of the mean from the means of stretches much longer than the correlation time 1/(2 friction)
    stretches = settled[: len(settled) // 20 * 20].reshape(20, -1).mean(axis=1)
    error = stretches.std(ddof=1) / np.sqrt(20)
    assert error < 0.03
    assert abs(settled.mean() - 1.3) < 4 * error + 0.01
    # heat is all that comes and goes: the conserved energy wanders far less than the total one
    total = warm["potential"] + warm["kinetic"]
    assert np.ptp(total - warm["heat"]) < 0.2 * np.ptp(total)


def test_kinetic_energies_are_those_of_a_canonical_ensemble(warm):
    # variance of a gamma distribution; many correlated samples, hence the room
    assert np.var(warm["kinetic"]) == pytest.approx(3 * 108 / 2 * 1.3**2, rel=0.35)


@pytest.mark.nightly
@pytest.mark.jax_md
@pytest.mark.filterwarnings("ignore:scatter inputs")
def test_noise_belongs_to_the_atom_and_the_step(bath):
    """Neither the skin nor the order in which the list sorts the atoms has a say."""
    plain, *others, drawn = (
        end_of(build(load(bath, overrides)), 63)[1]
        for overrides in (
            {}, {"neighbors.skin": 0.1}, {"neighbors.builder": "jax-md"},
            {"dynamics.seed": 4, "structure.velocities": "drawn"},
        )
    )  # fmt: skip
    assert all(np.max(np.abs(other - plain)) < 1e-9 for other in others)
    assert np.max(np.abs(drawn - plain)) > 1e-2


def test_velocities_drawn_have_the_temperature_and_no_drift(tmp_path):
    """Also where masses differ: the total momentum is zero, and not the mean velocity."""
    atoms = liquid(cells=3)
    atoms.set_masses(np.geomspace(0.1, 10.0, 108))
    simulation = build(load(write_system(tmp_path, atoms, dynamics={"temperature": 0.8, "seed": 5})))
    v, masses = simulation.velocities, atoms.get_masses()
    assert np.array_equal(simulation.masses, masses)
    assert np.max(np.abs(masses @ v)) < 1e-12 < 1e-3 < np.max(np.abs(v.mean(axis=0)))
    thermal = masses[:, None] * v**2
    assert thermal.sum() / (3 * 107) == pytest.approx(0.8, rel=0.15)
    # light atoms are as warm as heavy ones
    assert thermal[:54].sum() / thermal[54:].sum() == pytest.approx(1.0, rel=0.4)
    again = build(load(write_system(tmp_path / "again", atoms, dynamics={"temperature": 0.8, "seed": 5})))
    assert np.array_equal(again.velocities, v)
