"""The Lennard-Jones liquid that molecular-dynamics codes are compared on, at any size, without a file."""

from __future__ import annotations

from functools import cache

import numpy as np
from ase import Atoms
from ase.build import bulk

from mdnum.rollout import Engine
from mdnum.systems import System, SystemSpec, build

DENSITY, R_CUT, SKIN, TIMESTEP, TEMPERATURE = 0.8442, 2.5, 0.3, 0.005, 0.72
"""LAMMPS's bench/in.lj, near the triple point, with the cutoff that most papers use."""

_MELT = 1.44  # half of it becomes potential energy as the crystal melts
_LARGEST_MELT = 12  # cells along an edge; larger liquids are tiled from a smaller one


def liquid(atoms: int) -> System:
    """A melted liquid of about so many atoms (4 k³), hard cutoff, float64, NVE.

    Large ones are copies of a smaller one side by side, with velocities of their own that tell the copies
    apart: their energies and list lengths are those of a liquid from the first step on.
    """
    cells = max(4, round((atoms / 4) ** (1 / 3)))
    # thirteen cells, say, are no copies of anything that a cutoff fits into
    while not (sizes := [size for size in range(4, _LARGEST_MELT + 1) if cells % size == 0]):
        cells += 1
    melted = _melt(sizes[-1]).repeat(cells // sizes[-1])
    return _system(melted, TEMPERATURE, seed=2)


def _system(atoms: Atoms, temperature: float, seed: int) -> System:
    spec = SystemSpec.model_validate(
        {
            "units": "lj",
            "structure": {"file": "made in memory"},
            "potential": {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0},
            "cutoff": {"kind": "hard", "radius": R_CUT},
            "neighbors": {"skin": SKIN},
            "dynamics": {"kind": "nve", "timestep": TIMESTEP, "temperature": temperature, "seed": seed},
        }
    )
    return System(f"liquid-{len(atoms)}", spec, None, atoms)


@cache
def _melt(cells: int) -> Atoms:
    crystal = bulk("Ar", "fcc", a=(4 / DENSITY) ** (1 / 3), cubic=True).repeat(cells)
    crystal.set_array("masses", np.ones(len(crystal)))
    simulation = build(_system(crystal, _MELT, seed=1))
    *_, last = Engine(simulation, 400, record=False).segments()
    melted = crystal.copy()
    melted.set_positions(np.asarray(last.state.x, np.float64).T)
    return melted
