"""Small systems for tests: tables of a system file around a handful of atoms."""

from __future__ import annotations

from typing import Any

from ase import Atoms
from ase.build import bulk

from mdnum.systems import System, SystemSpec

LENNARD_JONES = {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0}
KOB_ANDERSEN = {
    "kind": "lennard-jones",
    "pairs": {
        "Ni-Ni": {"sigma": 1.0, "epsilon": 1.0},
        "P-Ni": {"sigma": 0.8, "epsilon": 1.5},
        "P-P": {"sigma": 0.88, "epsilon": 0.5},
    },
}


def make(
    atoms: Atoms,
    potential: dict[str, Any],
    cutoff: dict[str, Any] | None = None,
    units: str = "lj",
    **tables: Any,
) -> System:
    """A system from tables of a system file."""
    data = {"units": units, "structure": {"file": "none"}, "potential": potential, **tables}
    data.setdefault("dynamics", {"kind": "nve", "timestep": 0.004, "temperature": 1.0, "seed": 3})
    data.setdefault("neighbors", {"skin": 0.2})
    if cutoff is not None:
        data["cutoff"] = cutoff
    return System("test", SystemSpec.model_validate(data), None, atoms)


def crystal(repeat: int = 3, rattle: float = 0.05, lattice_constant: float = 1.8) -> Atoms:
    """fcc, by default 108 atoms in a box 5.4 wide, with unit masses."""
    atoms = bulk("Ar", "fcc", a=lattice_constant, cubic=True) * (repeat, repeat, repeat)
    if rattle:
        atoms.rattle(rattle, seed=2)
    atoms.set_masses([1.0] * len(atoms))
    return atoms


def mixture() -> Atoms:
    """The crystal with a fifth of its atoms replaced."""
    atoms = crystal()
    atoms.symbols[:] = "Ni"
    atoms.symbols[::5] = "P"
    atoms.set_masses([1.0] * len(atoms))
    return atoms
