"""Energies and forces of single configurations, with a Verlet list that is kept while it serves."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.md.cell import Cell, wrap_positions
from mdnum.md.decide import Tables
from mdnum.md.neighbors import PairTable
from mdnum.md.pairforce import ManyBodyForce, PairForce
from mdnum.systems.build import Simulation


@dataclass(frozen=True)
class Evaluation:
    """Energies and forces of one configuration.

    Attributes:
        energy: total energy.
        forces: shape (atoms, 3), energy/length.
        stress: dE/dstrain / volume (ASE's sign), shape (3, 3), energy/length³; NaN without a volume.
        energies: per atom, shape (atoms,), pair terms split evenly; NaN for many-body potentials.
        i, j: pairs inside the (longest) cutoff, i < j.
        distance: of those pairs, length.
    """

    energy: float
    forces: Float[np.ndarray, "atoms 3"]
    stress: Float[np.ndarray, "3 3"]
    energies: Float[np.ndarray, "atoms"]
    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    distance: Float[np.ndarray, "pairs"]


class Evaluator:
    """Evaluates one configuration after another, with a list rebuilt once motion and strain used its skin.

    Args:
        simulation: the system as objects.
        skin: skin of the list, length; default the system's. A box too narrow for it gets what fits.
    """

    def __init__(self, simulation: Simulation, skin: float | None = None):
        self.simulation = simulation
        self.skin = simulation.rule.skin if skin is None else skin
        self.builds = 0
        self._verlet = simulation.verlet_list(self.skin)
        self._kept: tuple[PairTable, Tables, Float[np.ndarray, "atoms 3"], Cell] | None = None

    def __call__(
        self,
        positions: Float[np.ndarray, "atoms 3"] | None = None,
        cell: Float[np.ndarray, "3 3"] | None = None,
    ) -> Evaluation:
        """Energy, forces, stress and pairs.

        Args:
            positions: length; default the structure's.
            cell: lattice vectors as rows; default the system's.

        Raises:
            InputError: the cutoff exceeds half the smallest perpendicular width.
        """
        own = self.simulation
        same_box = cell is None or np.array_equal(cell, np.asarray(own.cell.matrix))
        here = own if same_box else own.with_cell(Cell.create(cell, own.pbc))
        at = np.asarray(own.positions if positions is None else positions, np.float64)
        wrapped, _ = wrap_positions(here.cell, at)
        table, tables = self._list(here, wrapped)
        x = jnp.asarray(wrapped[table.order].T, here.policy.dtype("state"))
        result, bits, virial = _evaluate(here.force, x, tables)
        forces = np.empty((here.atoms, 3))
        forces[table.order] = np.asarray(result.force, np.float64).T
        energies = np.full(here.atoms, np.nan)
        if here.pairwise:
            energies[table.order] = np.asarray(result.energy, np.float64)
        i, j, distance = here.inside(wrapped, table, np.asarray(bits))
        return Evaluation(
            float(jnp.sum(result.energy, dtype=jnp.float64)),
            forces,
            -np.asarray(virial) / here.cell.volume,
            energies,
            i,
            j,
            distance,
        )

    def _list(self, here: Simulation, wrapped) -> tuple[PairTable, Tables]:
        """The list in use, rebuilt where it no longer holds every pair inside."""
        if self._kept is not None:
            table, tables, reference, reference_cell = self._kept
            if self._verlet.consumed(wrapped, here.cell, reference, reference_cell) <= 1.0:
                return table, tables
        slots = self._verlet.slots
        self._verlet = here.verlet_list(min(self.skin, float(here.cell.widths.min()) / 2 - here.r_cut))
        # capacity only grows: each new size would be compiled for
        self._verlet.slots = slots
        table = self._verlet.build(wrapped, here.cell)
        self._kept = table, here.tables(table), wrapped, here.cell
        self.builds += 1
        return table, self._kept[1]


@eqx.filter_jit
def _evaluate(force: PairForce | ManyBodyForce, x, tables: Tables):
    """Forces, decisions, and the virial tensor sum r_ij ⊗ F_ij."""
    result = force(x, tables, decisions=True)
    assert result.decisions is not None
    return result, result.decisions.bits, force.virial_tensor(x, tables)
