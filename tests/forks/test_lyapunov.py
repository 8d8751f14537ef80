"""The exponent beside two runs an ulp apart, and of motion that is not chaotic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from mdnum.forks.lyapunov import lyapunov
from small_systems import LENNARD_JONES, make

from mdnum.errors import InputError
from mdnum.events.forks import Growth, growth
from mdnum.rollout.lockstep import lockstep
from mdnum.systems.build import build

# long tangent runs
pytestmark = pytest.mark.slow


def liquid():
    """A hot dense fluid of 108 atoms."""
    edge = (4 / 0.85) ** (1 / 3)
    atoms = bulk("Ar", "fcc", a=edge, cubic=True) * (3, 3, 3)
    atoms.positions += np.random.default_rng(1).normal(0, 0.1, atoms.positions.shape)
    atoms.set_masses([1.0] * len(atoms))
    dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 1.5, "seed": 3}
    return build(
        make(
            atoms,
            LENNARD_JONES,
            {"kind": "switched", "radius": 2.2},
            neighbors={"skin": 0.25},
            dynamics=dynamics,
        )
    )


def test_the_exponent_is_the_rate_at_which_two_runs_part():
    a = liquid()
    found = lyapunov(a, 2000)
    assert found.chaotic and found.error < 0.1 * found.rate
    place = np.unravel_index(np.argmax(a.positions), a.positions.shape)
    moved = a.positions.copy()
    moved[place] = np.nextafter(moved[place], np.inf)
    stretches = list(lockstep(a, replace(a, positions=moved), 2000, handed=False))
    apart = np.concatenate([stretch.separation["B"] for stretch in stretches])
    seen = growth(apart, 0.088)
    assert seen.r_squared > 0.98
    assert found.rate == pytest.approx(seen.rate, rel=0.2)
    assert found.ratio(seen) == pytest.approx(1, rel=0.25)
    assert found.rate_time == pytest.approx(found.rate / 0.004)
    # beyond the run at the rate
    far = found.steps_to(1e-30, 1.0)
    assert far is not None and far > 2000
    assert far - 2000 == pytest.approx((np.log(1e30) - found.furthest[-1]) / found.rate)


def test_a_size_is_reached_when_two_runs_reach_it():
    a = liquid()
    found = lyapunov(a, 800)
    noise = np.random.default_rng(7).standard_normal(a.positions.shape)
    noise *= 1e-9 / np.sqrt((noise**2).sum(axis=1)).max()
    stretches = lockstep(a, replace(a, positions=a.positions + noise), 800, handed=False)
    apart = np.concatenate([stretch.separation["B"] for stretch in stretches])
    # along another direction: what is left of the start is its share of the one that grows fastest
    for end in (1e-8, 1e-7):
        reached = int((apart > end).argmax())
        assert reached > 100 and found.steps_to(1e-9, end) == pytest.approx(reached, rel=0.3)


def test_a_tangent_does_not_overflow():
    found = lyapunov(liquid(), 400)
    assert np.isfinite(found.size).all() and found.size[0] == pytest.approx(0.0, abs=1e-12)


def test_a_cold_crystal_is_not_chaotic():
    found = lyapunov(build("argon/crystal-108", {"cutoff.radius": 1.35}), 2000)
    assert not found.chaotic and abs(found.rate) < 3e-4
    assert np.isnan(found.ratio(Growth(0.1, 1.0, 0, 100)))
    assert found.steps_to(1e-16, 1.0) is None


def test_two_atoms_in_a_well_part_in_proportion_to_time():
    # one degree of freedom: a perturbation changes the period, so it grows linearly and no faster
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [1.5, 0, 0]], masses=[1.0, 1.0])
    atoms.set_velocities(np.zeros((2, 3)))
    found = lyapunov(build(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": 2.5})), 4000)
    assert found.size.max() > 1 and not found.chaotic
    assert found.steps_to(1e-16, 1.0) is None


def test_too_few_steps_are_refused():
    with pytest.raises(InputError, match="too few"):
        lyapunov(build("argon/crystal-108"), 40)
