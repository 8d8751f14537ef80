"""Verdicts on a liquid: what flips do at a violent cutoff, at its switched twin, and at the usual one.

Liquid argon at 94.4 K with 256 atoms, at the density of argon/liquid-864. It is judged from several starts,
because one may be lucky; that would take minutes with 864 atoms.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from forks.harness import made
from small_systems import make

from mdnum.forks import Fork, fork
from mdnum.rollout.engine import Engine
from mdnum.systems import System
from mdnum.systems.build import build

pytestmark = [pytest.mark.slow, pytest.mark.nightly]

SIGMA = 3.405
POTENTIAL = {"kind": "lennard-jones", "sigma": SIGMA, "epsilon": 0.0103235}
#: Rahman's box, scaled to 256 atoms.
EDGE = 10.229 * 3.4 * (256 / 864) ** (1 / 3)
STARTS = (0, 1, 2)
CUTS = {
    "usual": {"kind": "hard", "radius": 2.5 * SIGMA},
    "violent": {"kind": "hard", "radius": 1.5 * SIGMA},
    "switched": {"kind": "switched", "radius": 1.5 * SIGMA, "onset": 1.35 * SIGMA},
}


def argon(atoms: Atoms, cut: str, **dynamics) -> System:
    # Rahman's time step
    dynamics = {"kind": "nve", "timestep": 0.01, "temperature": 94.4, "seed": 1} | dynamics
    return make(atoms, POTENTIAL, CUTS[cut], "metal", neighbors={"skin": 1.0}, dynamics=dynamics)


@cache
def liquid(seed: int) -> Atoms:
    """Melted at 300 K and cooled to 94.4 K, 15 ps each."""
    atoms = bulk("Ar", "fcc", a=EDGE / 4, cubic=True) * (4, 4, 4)
    for kelvin in (300.0, 94.4):
        thermostat = {"kind": "langevin", "friction": 2.0, "temperature": kelvin, "seed": seed}
        simulation = build(argon(atoms, "usual", **thermostat))
        *_, last = Engine(simulation, 1500, record=False).segments()
        atoms = atoms.copy()
        atoms.positions = np.asarray(last.state.x).T
        atoms.set_velocities(np.asarray(last.state.v).T)
    return atoms


@pytest.fixture(scope="module")
def forks() -> dict[str, list[Fork]]:
    """Float32 arithmetic beside float64, by cutoff and start."""
    return {
        cut: [fork(made("precision", argon(liquid(seed), cut)), 1000, back=False) for seed in STARTS]
        for cut in CUTS
    }


def test_flips_accelerate_at_a_violent_cutoff_alone(forks):
    """E-foldings that flips were worth, at eight to thirteen starts: violent 1.5 to 21, 4.4 in the median;
    usual 0.06 to 1.9, 0.26 in the median (0.8 with 864 atoms and a fifth of the time step); switched -0.5 to
    0.15. One is what "accelerated" asks for.
    """
    words = {cut: [one.verdict.word for one in found] for cut, found in forks.items()}
    worth = {cut: float(np.median([one.verdict.e_foldings for one in found])) for cut, found in forks.items()}
    assert words["violent"] == ["accelerated"] * len(STARTS)
    assert worth["violent"] > 2.5 and worth["violent"] > 2 * worth["usual"]
    # switched off smoothly they only come along
    assert words["switched"] == ["bystander"] * len(STARTS)
    for found in forks["switched"]:
        assert found.dates.fork < found.dates.split
        assert abs(found.verdict.e_foldings) < 1
    # chaos would have done: bystander at two of the three starts, where no pair of 6 is delayed; at the third
    # 6 of 16 are
    assert set(words["usual"]) <= {"bystander", "undecided"} and words["usual"].count("bystander") >= 1
    assert worth["usual"] < 1.5
