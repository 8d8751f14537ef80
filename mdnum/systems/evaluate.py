"""Energies and forces of single configurations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.md.cell import Cell, wrap_positions
from mdnum.md.decide import Tables
from mdnum.md.energies import EnergyFunction
from mdnum.md.neighbors import PairTable
from mdnum.md.pairforce import ManyBodyForce, PairForce
from mdnum.numerics import check_not_forked

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation


@dataclass(frozen=True)
class Evaluation:
    """Energies and forces of one configuration."""

    energy: float  # total energy
    forces: Float[np.ndarray, "atoms 3"]  # shape (atoms, 3), energy/length
    # dE/dstrain / volume (ASE's sign), shape (3, 3), energy/length³; NaN without a volume, and where it was
    # not asked for
    stress: Float[np.ndarray, "3 3"]
    # per atom, shape (atoms,), pair terms split evenly; NaN for many-body potentials
    energies: Float[np.ndarray, "atoms"]
    # finds the pairs inside the (longest) cutoff, i < j, and their distances, once asked for
    find_pairs: Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]

    @cached_property
    def _pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.find_pairs()

    @property
    def i(self) -> Int[np.ndarray, "pairs"]:
        """Index of the first atom of each pair inside the cutoff."""
        return self._pairs[0]

    @property
    def j(self) -> Int[np.ndarray, "pairs"]:
        """Index of the second atom of each pair inside the cutoff."""
        return self._pairs[1]

    @property
    def distance(self) -> Float[np.ndarray, "pairs"]:
        """Distances of the pairs inside the cutoff, in length units."""
        return self._pairs[2]


class Evaluator:
    """Energies and forces of configurations. The Verlet list is rebuilt when its skin is used up.

    Args:
        simulation: the system as objects.
        skin: skin of the list, length; default the system's. A narrow box gets the largest possible skin.
        often: whether many calls are expected. If not, an energy function is compiled with few optimizations,
            which takes a quarter of the time.
    """

    def __init__(self, simulation: Simulation, skin: float | None = None, often: bool = True):
        self.simulation = simulation
        own = isinstance(simulation.model, EnergyFunction) and simulation.atoms <= _SMALL
        self._evaluate, self._numbers = _QUICKLY if own and not often else (evaluate_listed, _numbers)
        self.skin = simulation.rule.skin if skin is None else skin
        self.builds = 0
        self._verlet = simulation.verlet_list(self.skin)
        self._kept: tuple[PairTable, Tables, Float[np.ndarray, "atoms 3"], Cell] | None = None

    def __call__(
        self,
        positions: Float[np.ndarray, "atoms 3"] | None = None,
        cell: Float[np.ndarray, "3 3"] | None = None,
        stress: bool = True,
    ) -> Evaluation:
        """Compute energy, forces, stress and the pairs inside the cutoff of a configuration.

        Args:
            positions: positions, length; default the structure's.
            cell: lattice vectors as rows; default the system's.
            stress: whether to compute the stress, which takes about as long as the forces.

        Raises:
            InputError: the cutoff exceeds half the smallest perpendicular width.
        """
        here, wrapped, table, tables, x = self._sorted(positions, cell)
        result = self._evaluate(here.force, x, tables, stress)
        forces = np.empty((here.atoms, 3))
        forces[table.order] = np.asarray(result.force, np.float64).T
        energies = np.full(here.atoms, np.nan)
        if here.pairwise:
            energies[table.order] = np.asarray(result.energy, np.float64)
        return Evaluation(
            float(jnp.sum(result.energy, dtype=jnp.float64)),
            forces,
            -np.asarray(result.tensor) / here.cell.volume if stress else np.full((3, 3), np.nan),
            energies,
            lambda: here.inside(wrapped, table, np.asarray(result.decisions.bits)),
        )

    def numbers(self, positions: np.ndarray | None = None) -> tuple[float, dict[str, jax.Array]]:
        """Compute only the potential energy, forces, and smallest and largest pair distances."""
        own = self.simulation
        _, _, _, tables, x = self._sorted(positions, None)
        bare = own.potential if own.pairwise else None
        # the program that is there already, where its compilation is what takes the time
        made = None if self._numbers is _numbers else self._evaluate(own.force, x, tables, True)
        energy, found = self._numbers(own.force, bare, own.cell, own.pair_types, x, tables, made)
        return float(energy), found

    def _sorted(self, positions, cell) -> tuple[Simulation, np.ndarray, PairTable, Tables, jax.Array]:
        """Return the simulation in a cell, its neighbor list, and the sorted positions."""
        check_not_forked()
        own = self.simulation
        same_box = cell is None or np.array_equal(cell, np.asarray(own.cell.matrix))
        here = own if same_box else own.with_cell(Cell.create(cell, own.pbc))
        at = np.asarray(own.positions if positions is None else positions, np.float64)
        wrapped, _ = wrap_positions(here.cell, at)
        table, tables = self._list(here, wrapped)
        x = wrapped[table.order].T.astype(here.policy.dtype("state"), order="C")
        return here, wrapped, table, tables, jax.device_put(x)

    def _list(self, here: Simulation, wrapped) -> tuple[PairTable, Tables]:
        """Return the neighbor list. Rebuild the list if pairs could be missing."""
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


def _listed(force: PairForce | ManyBodyForce, x, tables: Tables, stress: bool) -> Any:
    """Compute forces, the pairs inside the cutoff and, if `stress` is True, the virial tensor."""
    return force(x, tables, decisions=True, tensor=stress)


def _numbers_of(force: PairForce | ManyBodyForce, bare, cell: Cell, types: int, x, tables: Tables, made=None):
    made = force(x, tables, decisions=False) if made is None else made
    cell = cell.astype(x.dtype)

    def wider(found, group):
        index, kind = group
        d = cell.minimum_image(*(x[:, index] - x[:, None]))
        r2, there = sum(c.astype(jnp.float64) ** 2 for c in d), index < x.shape[1]
        of_type = there & (jnp.arange(types, dtype=jnp.uint8)[:, None, None] == (0 if kind is None else kind))
        least = jnp.min(jnp.where(of_type, r2, jnp.inf), (1, 2))
        return (jnp.minimum(found[0], least), jnp.max(r2, where=there, initial=found[1])), None

    closest, furthest = jax.lax.scan(wider, (jnp.full(types, jnp.inf), jnp.zeros(())), tables.groups())[0]
    # of several terms their sum
    pair = jnp.zeros(types) if bare is None else sum(jax.tree.leaves(bare.evaluate(closest)[0]))
    closest, pair = (jnp.where(jnp.isinf(closest), 0.0, one) for one in (closest, pair))
    found = {"force": made.force, "r2": jnp.append(closest, furthest), "pair": pair}
    return jnp.sum(made.energy, dtype=jnp.float64), found


_HURRY: Any = {"compiler_options": {"xla_backend_optimization_level": 0}}
evaluate_listed, _numbers = eqx.filter_jit(_listed), eqx.filter_jit(_numbers_of)
_QUICKLY = eqx.filter_jit(_listed, **_HURRY), eqx.filter_jit(_numbers_of, **_HURRY)
#: Number of atoms up to which compiling takes longer than a few evaluations.
_SMALL = 1000
