"""Prepare the structures of systems/ again: melt, equilibrate and write them, with their velocities.

Run it as `python scripts/make_systems.py [NAME ...]`; without names it makes all of them, in a few minutes.
The shipped structures are the input of the systems, so their exact bits matter more than how they came
about: a small self-contained Langevin integrator over all pairs (no neighbor list, no cutoff decisions to
get wrong) makes them, independent of the code they are used to test.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from ase import Atoms
from ase.build import bulk
from numba import njit

from mdnum import units
from mdnum.systems.schema import json_schema
from mdnum.systems.structures import to_extxyz

ROOT = Path(__file__).resolve().parents[1] / "systems"
SIGMA, EPSILON = 3.405, 0.0103235
ARGON_MASS = 39.95


@njit(cache=True, fastmath=False)
def lj_forces(x, cell, inverse, pbc, kind, sigma, epsilon, r_cut):
    """Potential energy (shifted) and forces over all pairs, nearest image."""
    n = len(x)
    forces = np.zeros((n, 3))
    energy = 0.0
    for i in range(n):
        for j in range(i + 1, n):
            d = x[j] - x[i]
            for axis in range(3):
                if pbc[axis]:
                    fraction = d[0] * inverse[0, axis] + d[1] * inverse[1, axis] + d[2] * inverse[2, axis]
                    d -= np.round(fraction) * cell[axis]
            a, b = kind[i], kind[j]
            r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            if r2 < r_cut[a, b] ** 2:
                s6 = (sigma[a, b] ** 2 / r2) ** 3
                c6 = (sigma[a, b] / r_cut[a, b]) ** 6
                energy += 4 * epsilon[a, b] * (s6 * s6 - s6 - c6 * c6 + c6)
                f = 24 * epsilon[a, b] * (2 * s6 * s6 - s6) / r2
                forces[i] -= f * d
                forces[j] += f * d
    return energy, forces


def equilibrate(
    atoms: Atoms,
    schedule: list[tuple[float, int]],
    *,
    unit: units.Units,
    timestep: float,
    friction: float,
    sigma: np.ndarray,
    epsilon: np.ndarray,
    r_cut: np.ndarray,
    seed: int,
) -> Atoms:
    """Langevin (BAOAB) through stages of (temperature, steps), then velocities without drift at the last one.

    Args:
        atoms: start; positions in the unit system's length, masses set.
        schedule: stages, temperature in the unit system's temperature.
        timestep: in the unit system's time; friction: in one over it.
        sigma: (species, species); epsilon and r_cut likewise; species in sorted order.
        seed: of velocities and noise.
    """
    rng = np.random.default_rng(seed)
    symbols = np.array(atoms.get_chemical_symbols())
    kind = np.searchsorted(np.unique(symbols), symbols)
    cell = np.array(atoms.cell)
    inverse = np.linalg.inv(cell)
    pbc = np.array(atoms.pbc)
    mass = atoms.get_masses()[:, None]
    h = timestep * unit.time_factor
    decay = np.exp(-friction * timestep)
    x = atoms.positions.copy()
    v = rng.normal(size=x.shape) * np.sqrt(unit.k_B * schedule[0][0] / mass)
    _, f = lj_forces(x, cell, inverse, pbc, kind, sigma, epsilon, r_cut)
    for temperature, steps in schedule:
        width = np.sqrt(unit.k_B * temperature * (1 - decay**2) / mass)
        for _ in range(steps):
            v += 0.5 * h * f / mass
            x += 0.5 * h * v
            v = decay * v + width * rng.normal(size=v.shape)
            x += 0.5 * h * v
            _, f = lj_forces(x, cell, inverse, pbc, kind, sigma, epsilon, r_cut)
            v += 0.5 * h * f / mass
    v -= (mass * v).sum(axis=0) / mass.sum()
    wanted = schedule[-1][0]
    v *= np.sqrt(wanted * 3 * (len(x) - 1) * unit.k_B / (mass * v**2).sum())
    done = atoms.copy()
    done.positions = x
    done.wrap()
    done.set_velocities(v)
    return done


def argon(atoms: Atoms, schedule: list[tuple[float, int]], seed: int, timestep: float = 0.005) -> Atoms:
    """Equilibrate Lennard-Jones argon in metal units with a 2.5 σ cutoff."""
    one = np.ones((1, 1))
    atoms.set_masses(np.full(len(atoms), ARGON_MASS))
    return equilibrate(
        atoms,
        schedule,
        unit=units.METAL,
        timestep=timestep,
        friction=1.0,
        sigma=SIGMA * one,
        epsilon=EPSILON * one,
        r_cut=2.5 * SIGMA * one,
        seed=seed,
    )


def fcc(edge: float, cells: int) -> Atoms:
    """An fcc crystal of argon in a cube of this edge (Å)."""
    return bulk("Ar", "fcc", a=edge / cells, cubic=True).repeat(cells)


def liquid_864() -> Atoms:
    """Rahman's box of 10.229 times 3.4 Å: melted at 300 K, cooled to 94.4 K, 50 ps in all."""
    return argon(fcc(34.78, 6), [(300.0, 2000), (94.4, 8000)], seed=864)


STRUCTURES: dict[str, Callable[[], Atoms]] = {
    "argon/liquid-864": liquid_864,
}


def main() -> None:
    """Make the structures named on the command line, or all, and the schema."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(STRUCTURES)}")
    names = parser.parse_args().names or list(STRUCTURES)
    for name in names:
        atoms = STRUCTURES[name]()
        path = ROOT / f"{name}.extxyz"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(to_extxyz(atoms), encoding="utf-8")
        print(f"{path.relative_to(ROOT.parent)}: {len(atoms)} atoms, {path.stat().st_size / 1024:.0f} kB")
    (ROOT / "schema.json").write_text(json.dumps(json_schema(), indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
