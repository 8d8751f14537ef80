"""Prepare the structures of systems/ again: melt, equilibrate and write them, with their velocities.

Run it as `python scripts/makers/make_systems.py [NAME ...]`; without names it makes all of them, in about a
minute. The shipped structures are the input of the systems, so their exact bits matter more than how they
came about: a small self-contained Langevin integrator makes them, independent of the code they are used to
test.
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
from vesin import NeighborList

from mdnum import units
from mdnum.systems.load import BALL_SCHEMA, json_schema
from mdnum.systems.structures import to_extxyz

ROOT = Path(__file__).resolve().parents[2] / "systems"
SIGMA, EPSILON = 3.405, 0.0103235
ARGON_MASS = 39.95


@njit(cache=True)
def lj_forces(x, i, j, cell, inverse, pbc, kind, sigma, epsilon, r_cut):
    """Forces of the listed pairs, nearest image, truncated at r_cut."""
    forces = np.zeros(x.shape)
    for k in range(len(i)):
        p, q = i[k], j[k]
        dx, dy, dz = x[q, 0] - x[p, 0], x[q, 1] - x[p, 1], x[q, 2] - x[p, 2]
        for axis in range(3):
            if pbc[axis]:
                s = np.floor(dx * inverse[0, axis] + dy * inverse[1, axis] + dz * inverse[2, axis] + 0.5)
                dx -= s * cell[axis, 0]
                dy -= s * cell[axis, 1]
                dz -= s * cell[axis, 2]
        r2 = dx * dx + dy * dy + dz * dz
        a, b = kind[p], kind[q]
        if r2 < r_cut[a, b] * r_cut[a, b]:
            s2 = sigma[a, b] * sigma[a, b] / r2
            s6 = s2 * s2 * s2
            f = 24 * epsilon[a, b] * (2 * s6 * s6 - s6) / r2
            forces[p, 0] -= f * dx
            forces[p, 1] -= f * dy
            forces[p, 2] -= f * dz
            forces[q, 0] += f * dx
            forces[q, 1] += f * dy
            forces[q, 2] += f * dz
    return forces


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
    skin = 0.3 * sigma.max()
    finder = NeighborList(cutoff=float(r_cut.max()) + skin, full_list=False)
    listed = np.full_like(x, np.inf)

    def force() -> np.ndarray:
        nonlocal pairs, listed
        if not ((x - listed) ** 2).sum(axis=1).max() < skin**2 / 4:
            found = finder.compute(points=x, box=cell, periodic=pbc, quantities="ij")
            pairs, listed = [index.astype(np.int64) for index in found], x.copy()
        return lj_forces(x, pairs[0], pairs[1], cell, inverse, pbc, kind, sigma, epsilon, r_cut)

    pairs: list[np.ndarray] = []
    f = force()
    for temperature, steps in schedule:
        width = np.sqrt(unit.k_B * temperature * (1 - decay**2) / mass)
        for _ in range(steps):
            v += 0.5 * h * f / mass
            x += 0.5 * h * v
            v = decay * v + width * rng.normal(size=v.shape)
            x += 0.5 * h * v
            f = force()
            v += 0.5 * h * f / mass
    v -= (mass * v).sum(axis=0) / mass.sum()
    wanted = schedule[-1][0]
    v *= np.sqrt(wanted * 3 * (len(x) - 1) * unit.k_B / (mass * v**2).sum())
    done = atoms.copy()
    done.positions = x
    done.wrap()
    done.set_velocities(v)
    return done


def argon(atoms: Atoms, schedule: list[tuple[float, int]], seed: int) -> Atoms:
    """Equilibrate Lennard-Jones argon in metal units, cutoff 2.5 σ, steps of 5 fs."""
    one = np.ones((1, 1))
    atoms.set_array("masses", np.full(len(atoms), ARGON_MASS))
    return equilibrate(
        atoms,
        schedule,
        unit=units.METAL,
        timestep=0.005,
        friction=1.0,
        sigma=SIGMA * one,
        epsilon=EPSILON * one,
        r_cut=2.5 * SIGMA * one,
        seed=seed,
    )


def fcc(lattice_constant: float, cells: int) -> Atoms:
    """A cube of an fcc crystal of argon."""
    return bulk("Ar", "fcc", a=lattice_constant, cubic=True).repeat(cells)


def liquid_864() -> Atoms:
    """Rahman's box of 10.229 times 3.4 Å: melted at 300 K, then at 94.4 K."""
    return argon(fcc(34.78 / 6, 6), [(300.0, 2000), (94.4, 8000)], seed=864)


def langevin_500() -> Atoms:
    """A smaller box of the same density and temperature."""
    return argon(fcc(34.78 / 6, 5), [(300.0, 2000), (94.4, 8000)], seed=500)


def crystal_500() -> Atoms:
    """fcc at 20 K; 5.30 Å puts the fifth shell at 5.30 sqrt(5/2) = 8.380 Å."""
    return argon(fcc(5.30, 5), [(20.0, 4000)], seed=20)


def tilted_500() -> Atoms:
    """The same crystal, sheared, so that no two cell vectors are orthogonal, at 40 K."""
    atoms = fcc(5.30, 5)
    shear = np.array([[1.0, 0.0, 0.0], [0.08, 1.0, 0.0], [-0.05, 0.06, 1.0]])
    atoms.set_cell(np.asarray(atoms.cell) @ shear, scale_atoms=True)
    return argon(atoms, [(40.0, 4000)], seed=40)


def reduced(
    atoms: Atoms, schedule: list[tuple[float, int]], seed: int, sigma: np.ndarray, epsilon: np.ndarray
) -> Atoms:
    """Equilibrate a Lennard-Jones system in reduced units, cutoff 2.5 σ of each pair where the box allows."""
    atoms.set_array("masses", np.ones(len(atoms)))
    half = min(atoms.cell.lengths()) / 2
    return equilibrate(
        atoms,
        schedule,
        unit=units.LJ,
        timestep=0.004,
        friction=1.0,
        sigma=sigma,
        epsilon=epsilon,
        r_cut=np.minimum(2.5 * sigma, half - 0.3 * sigma.max()),
        seed=seed,
    )


def crystal_108() -> Atoms:
    """fcc at density 1 and T = 0.02."""
    one = np.ones((1, 1))
    return reduced(fcc(4 ** (1 / 3), 3), [(0.02, 5000)], 108, one, one)


def lj_liquid_500() -> Atoms:
    """About the density that the pressure of its file gives, 0.735; melted at 1.6."""
    one = np.ones((1, 1))
    return reduced(fcc((4 / 0.735) ** (1 / 3), 5), [(1.6, 4000), (0.8, 10000)], 500, one, one)


def kob_andersen_1000() -> Atoms:
    """Kob and Andersen's mixture (Phys. Rev. E 51, 4626, 1995), 80:20 at density 1.2; melted at 3, then 1."""
    edge = (1000 / 1.2) ** (1 / 3)
    atoms = bulk("Ni", "sc", a=edge / 10).repeat(10)
    chosen = np.random.default_rng(1995).choice(1000, 200, replace=False)
    atoms.symbols[chosen] = "P"
    sigma = np.array([[1.0, 0.8], [0.8, 0.88]])
    epsilon = np.array([[1.0, 1.5], [1.5, 0.5]])
    return reduced(atoms, [(3.0, 4000), (1.0, 10000)], 1000, sigma, epsilon)


def at_cutoff() -> Atoms:
    """Two atoms that part at relative speed 1 in a box periodic along x, and so meet again."""
    atoms = Atoms("Ar2", positions=[[3.5, 4.0, 4.0], [5.5, 4.0, 4.0]], cell=[9.0, 8.0, 8.0])
    atoms.pbc = (True, False, False)
    atoms.set_array("masses", np.array([1.0, 1.0]))
    atoms.set_velocities([[-0.8, 0.0, 0.0], [0.8, 0.0, 0.0]])
    return atoms


def leaving_well() -> Atoms:
    """Relative coordinate 1.8, relative speed 1, reduced mass 1."""
    atoms = Atoms("Ar2", positions=[[-0.9, 0.0, 0.0], [0.9, 0.0, 0.0]])
    atoms.set_array("masses", np.array([2.0, 2.0]))
    atoms.set_velocities([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    return atoms


STRUCTURES: dict[str, Callable[[], Atoms]] = {
    "argon/liquid-864": liquid_864,
    "argon/langevin-500": langevin_500,
    "argon/crystal-500": crystal_500,
    "argon/tilted-500": tilted_500,
    "argon/crystal-108": crystal_108,
    "binary/kob-andersen-1000": kob_andersen_1000,
    "lj/liquid-npt-500": lj_liquid_500,
    "pair/at-cutoff": at_cutoff,
    "pair/leaving-well": leaving_well,
}


def main() -> None:
    """Make the structures named on the command line, or all, and the schemas."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(STRUCTURES)}")
    parser.add_argument("--schema", action="store_true", help="write the JSON schemas only")
    arguments = parser.parse_args()
    names = [] if arguments.schema else arguments.names or list(STRUCTURES)
    unknown = [name for name in names if name not in STRUCTURES]
    if unknown:
        parser.error(f"no structure called {', '.join(unknown)}; there are {', '.join(STRUCTURES)}")
    for name in names:
        atoms = STRUCTURES[name]()
        path = ROOT / f"{name}.extxyz"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(to_extxyz(atoms), encoding="utf-8")
        print(f"{path.relative_to(ROOT.parent)}: {len(atoms)} atoms, {path.stat().st_size / 1024:.0f} kB")
    for file in ("schema.json", BALL_SCHEMA):
        (ROOT / file).write_text(json.dumps(json_schema(file), indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
