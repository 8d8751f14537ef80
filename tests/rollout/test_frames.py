"""What the frames of a run hold beside positions, against calculators that share no code with the loop."""

from __future__ import annotations

import itertools

import ase.io
import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.calculator import PropertyNotImplementedError
from ase.calculators.lj import LennardJones
from rollout.harness import go, liquid, write_system
from small_systems import make, mixture

from mdnum.references.ase_models import reference
from mdnum.systems import load

SILICON = {"potential": {"kind": "stillinger-weber"}, "cutoff": None, "units": "metal",
           "dynamics": {"temperature": 1500.0, "timestep": 0.002}}  # fmt: skip


def periodic(*axes: bool, box: bool = True) -> Atoms:
    """The liquid with faces along some axes, and room beyond the others where there is a box."""
    atoms = liquid()
    if not all(axes):
        atoms.center(vacuum=3.0, axis=[k for k in range(3) if not axes[k]])
    atoms.pbc = axes
    if not box:
        atoms.cell = None
    return atoms


def silicon() -> Atoms:
    atoms = bulk("Si", "diamond", a=5.43, cubic=True) * 2
    atoms.rattle(0.05, seed=4)
    return atoms


@pytest.mark.parametrize(
    ("atoms", "tables", "error"),
    [
        (periodic(True, True, True), {}, 1e-11),
        (liquid(tilt=True), {"cutoff": {"kind": "switched", "radius": 2.0, "onset": 1.7}}, 1e-11),
        (periodic(True, True, False), {"cutoff": {"kind": "shifted", "radius": 1.9}}, 1e-11),
        (periodic(False, False, False, box=False), {}, 1e-11),
        (periodic(True, True, True), {"precision": {"state": "lattice"}}, 1e-6),
        (silicon(), SILICON, 1e-10),
    ],
    ids=["hard", "tilted", "slab", "cluster", "lattice", "many bodies"],
)
def test_frames_have_the_energies_forces_and_stress_of_another_calculator(tmp_path, atoms, tables, error):
    system = load(write_system(tmp_path, atoms, **{"neighbors": {"skin": 0.1}, **tables}))
    # several lists, in whose orders atoms stand differently, and frames at either end of one
    _, folder = go(tmp_path, system, 40, save_every=3)
    assert len(folder.read("epochs")["epoch"]) > 2
    frames = ase.io.read(folder.path / "trajectory.traj", index=":")
    assert [frame.info["step"] for frame in frames] == list(range(0, 41, 3))
    for frame in (frames[0], frames[1], frames[7], frames[-1]):
        other = frame.copy()
        other.calc = reference(system).make()
        forces = other.get_forces()
        np.testing.assert_allclose(frame.get_forces(), forces, atol=error * np.abs(forces).max())
        assert frame.get_potential_energy() == pytest.approx(other.get_potential_energy(), rel=error)
        if not frame.pbc.any():
            with pytest.raises(PropertyNotImplementedError):
                frame.get_stress()
            assert "stress" not in frame.calc.results
            continue
        # of the volume that the cell has, as ASE counts it
        stress = other.get_stress()
        np.testing.assert_allclose(frame.get_stress(), stress, atol=error * np.abs(stress).max())


def test_forces_are_those_of_the_list_that_was_used(tmp_path):
    """Where a list that is not rebuilt in time has lost pairs, the frames have what the steps acted on."""
    system = load(write_system(tmp_path, liquid(), neighbors={"skin": 0.05, "rebuild": {"every": 40}}))
    _, folder = go(tmp_path, system, 60, save_every=1)
    frames = ase.io.read(folder.path / "trajectory.traj", index=":")
    timestep, missed = 0.004, 0.0
    for frame, after in itertools.pairwise(frames[1:]):
        # velocity Verlet: v(t + dt) - v(t) is half of dt times both forces, of unit masses
        kick = after.get_velocities() - frame.get_velocities()
        mean = 0.5 * timestep * (frame.get_forces() + after.get_forces())
        np.testing.assert_allclose(kick, mean / frame.get_masses()[:, None], atol=1e-10)
        other = frame.copy()
        other.calc = LennardJones(sigma=1.0, epsilon=1.0, rc=2.0)
        missed = max(missed, np.abs(other.get_forces() - frame.get_forces()).max())
    assert missed > 1e-3


def test_frames_of_two_species_have_forces_in_the_order_of_the_atoms(tmp_path):
    atoms = mixture()
    atoms.set_masses(np.where(atoms.symbols == "Ni", 1.0, 2.0))
    potential = {"kind": "lennard-jones", "pairs": {
        "Ni-Ni": {"sigma": 1.0, "epsilon": 1.0}, "P-Ni": {"sigma": 0.8, "epsilon": 1.5},
        "P-P": {"sigma": 0.88, "epsilon": 0.5},
    }}  # fmt: skip
    system = make(atoms, potential, {"kind": "hard", "radius": 2.2})
    _, folder = go(tmp_path, system, 20, save_every=20)
    frame = ase.io.read(folder.path / "trajectory.traj")
    other = frame.copy()
    other.calc = reference(system).make()
    np.testing.assert_allclose(frame.get_forces(), other.get_forces(), atol=1e-10)
