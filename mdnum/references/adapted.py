"""ASE calculators, adapted to the cutoff, species and neighbor list of a simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator
from ase.stress import full_3x3_to_voigt_6_stress, voigt_6_to_full_3x3_stress
from numpy import ndarray

from mdnum.md.energies import EnergyFunction
from mdnum.md.jaxmd import as_neighbor_list
from mdnum.references.independent import ClassicalCalculator, PairForm, edges_of


class StepAtCutoff(ClassicalCalculator):
    """An ASE calculator with a constant energy added for each pair inside the cutoff.

    Args:
        inner: the ASE calculator.
        form: pair interaction that defines which pairs are inside the cutoff.
        step: energy added per pair, energy unit of `inner`.
    """

    def __init__(self, inner: Calculator, form: PairForm, step: float, **kwargs: Any):
        super().__init__(**kwargs)
        self.inner, self.form, self.step = inner, form, step

    def evaluated(self, atoms, changes):
        # get_property, not calculate: it is what tells ASE's class that the atoms have changed
        results = _results(self.inner, atoms, atoms.cell.rank == 3)
        edges = edges_of(atoms, self.form.r_cut)
        inside = np.bincount(edges.i[self.form.inside(edges.r)], minlength=len(atoms))
        energy = results["energy"] + self.step * (inside.sum() // 2)
        energies = results["energies"] + 0.5 * self.step * inside
        return {**results, "energy": energy, "energies": energies}


class SpeciesSum(ClassicalCalculator):
    """ASE calculator of a mixture. The energy of unlike pairs is that of all pairs minus that of like pairs.

    Args:
        parts: (calculator, species a, species b) for every pair of species in the structure.
    Error: the subtraction loses the digits by which the sum over like pairs exceeds the sum over unlike
        pairs; about one digit for the mixtures of mdnum.
    """

    def __init__(self, parts: Sequence[tuple[Calculator, str, str]], **kwargs: Any):
        super().__init__(**kwargs)
        self.parts = tuple(parts)

    def evaluated(self, atoms, changes):
        symbols = np.array(atoms.get_chemical_symbols())
        n = len(symbols)
        total: dict[str, Any] = {"energy": 0.0, "energies": np.zeros(n), "forces": np.zeros((n, 3))}
        if atoms.cell.rank == 3:
            total["stress"] = np.zeros(6)
        for calculator, a, b in self.parts:
            first, second = symbols == a, symbols == b
            groups = [(first, 1.0)] if a == b else [(first | second, 1.0), (first, -1.0), (second, -1.0)]
            for chosen, sign in groups:
                if not chosen.any():
                    continue
                calculator.reset()
                for name, value in _results(calculator, atoms[chosen], "stress" in total).items():
                    if name in ("energies", "forces"):
                        total[name][chosen] += sign * value
                    else:
                        total[name] += sign * value
        return total


def _results(calculator: Calculator, atoms: Atoms, stress: bool) -> dict[str, Any]:
    """Return energy, forces, atomic energies (if available) and stress (six numbers)."""
    bare = Atoms(numbers=atoms.numbers, positions=atoms.positions, cell=atoms.cell, pbc=atoms.pbc)
    names = ["energy", "forces", *(["stress"] if stress else [])]
    if "energies" in calculator.implemented_properties:  # ASE's EAM has the total only
        names.append("energies")
    results: dict[str, Any] = {name: np.array(calculator.get_property(name, bare)) for name in names}
    return {**results, "energy": float(results["energy"])}


def evaluate(calculator: Calculator, atoms: Atoms) -> dict[str, Any]:
    """Return energy, forces, stress (3, 3) and atomic energies. Missing values are None."""
    # ASE gives a stress for a molecule in a box, of the box's volume
    results = _results(calculator, atoms, atoms.cell.rank == 3 and bool(atoms.pbc.all()))
    if "stress" in results:
        results["stress"] = voigt_6_to_full_3x3_stress(results["stress"])
    return {"energies": None, "stress": None, **results}


def lennard_jones(form: PairForm, **options: Any) -> Calculator:
    from ase.calculators.lj import LennardJones

    return LennardJones(**form.constants, rc=form.r_cut, **options)


def _inside_list(form: PairForm) -> Callable[..., Any]:
    """Return a neighbor list for ASE's MorsePotential with only pairs inside the cutoff."""

    def listed(quantities: str, atoms: Atoms, cutoff: float) -> tuple[ndarray, ...]:
        edges = edges_of(atoms, form.r_cut)
        keep = form.inside(edges.r)
        table = {"i": edges.i[keep], "j": edges.j[keep], "d": edges.r[keep], "D": edges.d[keep]}
        return tuple(table[quantity] for quantity in quantities)

    return listed


def morse(form: PairForm, begin: float, end: float) -> Calculator:
    from ase.calculators.morse import MorsePotential

    depth, alpha, r0 = (form.constants[key] for key in ("depth", "alpha", "r0"))
    lengths = {"rho0": alpha * r0, "r0": r0, "rcut1": begin / r0, "rcut2": end / r0}
    return MorsePotential(epsilon=depth, **lengths, neighbor_list=_inside_list(form))


def short_listed_eam(file: Path) -> Calculator:
    """Return ASE's EAM calculator with a short neighbor list. ASE's range of 2 (cutoff + skin) is slow."""
    from ase.calculators.eam import EAM
    from ase.neighborlist import NeighborList

    class ShortListed(EAM):
        def update(self, atoms):
            self.Nelements = len(self.elements)
            self.index = np.array([self.elements.index(symbol) for symbol in atoms.get_chemical_symbols()])
            self.pbc = atoms.get_pbc()
            reach = np.full(len(atoms), 0.5 * self.cutoff * (1 + 1e-12))
            self.neighbors = NeighborList(reach, skin=0.0, self_interaction=False, bothways=True)
            self.neighbors.update(atoms)

    return ShortListed(potential=str(file), form="alloy", skin=0.0)


class EnergyOnNeighborList(ClassicalCalculator):
    """ASE calculator for an energy function, evaluated on ASE's neighbor list.

    The calculator is a reference for neighbor lists, cutoff decisions and time steps. The energy function
    itself is not tested, because jax computes it here, too.
    """

    implemented_properties = ["energy", "free_energy", "forces", "stress"]  # noqa: RUF012

    def __init__(self, potential: EnergyFunction, **kwargs: Any):
        super().__init__(**kwargs)
        self.potential = own = potential

        def energy(x, strain, index, cell):
            neighbor = as_neighbor_list(index, x, own.format, own.self_edges)
            return own.deformed(x, neighbor, cell, jnp.eye(3) + strain)

        # hardly optimized: to compile takes less time than each operation by itself
        options: Any = {"xla_backend_optimization_level": 0}
        self._slopes = jax.jit(jax.value_and_grad(energy, argnums=(0, 1)), compiler_options=options)

    def evaluated(self, atoms, changes):
        edges, n, x = edges_of(atoms, self.potential.r_cut), len(atoms), jnp.asarray(atoms.positions)
        i, j = (ends[edges.r < self.potential.r_cut] for ends in (edges.i, edges.j))
        counts = np.bincount(i, minlength=n)
        # every width is compiled for
        index = np.full((n, -(-max(1, int(counts.max(initial=0))) // 8) * 8), n, np.int32)
        index[i, np.arange(len(i)) - (np.cumsum(counts) - counts)[i]] = j
        total, (slope, strain) = self._slopes(x, jnp.zeros((3, 3)), index, jnp.asarray(atoms.cell.array))
        results = {"energy": float(total), "forces": -np.asarray(slope)}
        if atoms.cell.rank == 3:
            results["stress"] = full_3x3_to_voigt_6_stress(np.asarray(strain) / atoms.get_volume())
        return results
