"""An ASE calculator that computes energies and forces with mdnum."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Parameters
from ase.stress import full_3x3_to_voigt_6_stress

from mdnum import systems, units
from mdnum.errors import InputError, NumericalError
from mdnum.md.potentials import PairPotential
from mdnum.references.independent import ClassicalCalculator
from mdnum.systems import System
from mdnum.systems.build import interaction, model_of
from mdnum.systems.construct import Cut, cut, of_atoms, with_atoms
from mdnum.systems.describe import program
from mdnum.systems.evaluate import Evaluator
from mdnum.systems.schema import DEFAULT_SKIN
from mdnum.systems.simulation import Simulation
from mdnum.systems.structures import species_of

# a change of either is another program; positions and cell are arguments of it
_REBUILD = {"numbers", "pbc"}
_SAID = {"potential", "cutoff", "terms", "units"}


class _Recipe(NamedTuple):
    """Recipe for building a simulation of given atoms with a given potential."""

    make: Callable[[Atoms], Simulation]  # without a skin: the evaluator keeps what the box has room for
    skin: float  # length
    tables: Mapping[str, Any]  # what it says of itself; a cutoff or terms where energies belong to atoms


def _of_system(system: Simulation | System) -> _Recipe:
    if isinstance(system, Simulation):
        tables = {key: table for key, table in program(system).items() if key in _SAID and table is not None}
        return _Recipe(lambda atoms: with_atoms(system, atoms, 0.0), system.rule.skin, tables)
    tables = system.spec.model_dump(exclude_none=True, include=_SAID)
    bare = system.without_skin
    return _Recipe(lambda atoms: systems.build(replace(bare, atoms=atoms)), system.spec.skin, tables)


def _of_potential(potential: Any, cutoff: Any, unit: str) -> _Recipe:
    """Return a recipe for simulations with a potential."""
    if isinstance(potential, Mapping):
        made = interaction(potential, cutoff)
        end, model = made.cutoff, lambda atoms: model_of(made, atoms, Path())
        said = {name: table and table.model_dump(exclude_none=True) for name, table in made._asdict().items()}
    else:
        if isinstance(potential, PairPotential) != isinstance(cutoff, Cut):
            message = "a pair potential needs cutoff=mdnum.Cut(kind, radius), but no other takes a cutoff"
            raise InputError(message, where="MdnumCalculator")
        end, said = cutoff, {"potential": potential, "cutoff": cutoff}

        def model(atoms: Atoms) -> Any:
            if end is None:
                return potential
            return cut(potential, end.kind, species_of(atoms)[0], end.radius, end.onset)

    compare = "r <" if end is None else end.compare
    tables = {name: table for name, table in said.items() if table is not None}
    return _Recipe(
        lambda atoms: of_atoms(atoms, model(atoms), compare, unit),
        DEFAULT_SKIN[units.get(unit).name],
        {**tables, "units": unit},
    )


class MdnumCalculator(ClassicalCalculator):
    """ASE calculator that evaluates a potential with mdnum.

    Use this calculator to relax structures with ase.optimize, or to compute stress and equations of state.
    The Verlet list is kept until atoms or box have moved too far for its skin. For molecular dynamics, use
    the function `rollout` of mdnum to record flips.

    Args:
        system: a `Simulation`, a `System`, or the name or path of a system file; the evaluated atoms may
            differ from those of the system.
        overrides: keys of the system file to change, as `--set` does.
        potential, cutoff: instead of a system: objects as for `mdnum.simulation`, or the tables of a system
            file as dictionaries.
        units: "metal" (Å, eV) or "lj".
    Raises:
        InputError: both system and potential are given, or neither; or the tables are invalid. At the first
            use: species without constants, a cell narrower than two cutoffs, a coordinate that is not finite.
        NumericalError: an energy or a force that is not finite, such as that of two atoms at one place.
        TypeError: an unknown keyword.

    Example:
        >>> argon = MdnumCalculator(
        ...     potential=mdnum.LennardJones(sigma=3.405, epsilon=0.0103235),
        ...     cutoff=mdnum.Cut("switched", 8.5, onset=7.0),
        ... )
    """

    def __init__(
        self,
        system: Simulation | System | str | None = None,
        *,
        overrides: Mapping[str, Any] | None = None,
        potential: Any = None,
        cutoff: Any = None,
        units: str = "metal",
    ):
        super().__init__()
        self._evaluator: Evaluator | None = None
        where = "MdnumCalculator"
        if (system is None) == (potential is None):
            remedy = "Write MdnumCalculator('argon/liquid-864'), or potential=... and cutoff=..."
            raise InputError("give either a system or a potential, and not both", remedy=remedy, where=where)
        if isinstance(system, System | Simulation) and overrides:
            remedy = "Pass the name of the system, or load it with the overrides"
            raise InputError("keys of a loaded system cannot be overridden", remedy=remedy, where=where)
        if system is not None and not isinstance(system, System | Simulation):
            system = systems.load(str(system), overrides, world="md")
        self._recipe = _of_potential(potential, cutoff, units) if system is None else _of_system(system)
        self._given = system if isinstance(system, Simulation) else None
        self.parameters = Parameters(self._recipe.tables)
        if not {"cutoff", "terms"} & self._recipe.tables.keys():
            # a potential of many bodies need not split its energy by atom
            self.implemented_properties = [one for one in self.implemented_properties if one != "energies"]

    @property
    def simulation(self) -> Simulation | None:
        """The simulation evaluated by the last call. None before the first call."""
        return None if self._evaluator is None else self._evaluator.simulation

    def set(self, **changes: Any) -> dict[str, Any]:
        """Raise an error if a parameter is changed. Another potential needs another calculator.

        Raises:
            TypeError: a parameter was given.
        """
        if changes:
            raise TypeError(f"{', '.join(changes)} cannot be changed; create a new MdnumCalculator")
        return {}

    def evaluated(self, atoms, changes):
        numbers = {"atom": atoms.positions, "lattice vector": np.asarray(atoms.cell)}
        for what, rows in numbers.items():
            if (bad := np.flatnonzero(~np.isfinite(rows).all(axis=1))).size:
                place = f"{what} {bad[0]} is {rows[bad[0]].tolist()}"
                raise InputError(f"{place}; expected finite numbers", where="MdnumCalculator")
        if self._evaluator is None or _REBUILD & set(changes):
            self._evaluator = self._made_for(atoms)
        evaluation = self._evaluator(atoms.get_positions(), np.asarray(atoms.cell))
        results = {"energy": float(evaluation.energy), "forces": np.array(evaluation.forces)}
        if not all(np.isfinite(value).all() for value in results.values()):
            pair = ""
            if len(r := evaluation.distance):
                near = int(np.argmin(r))
                pair = f"; the closest pair is {evaluation.i[near]}-{evaluation.j[near]} at {r[near]:.4g}"
            raise NumericalError(
                f"the computed energy or a force is not finite{pair}", where="MdnumCalculator",
                remedy="Relax the structure with a softer potential, or move the atoms apart",
            )  # fmt: skip
        if "energies" in self.implemented_properties:
            results["energies"] = np.array(evaluation.energies)
        if atoms.cell.rank == 3 and atoms.pbc.any():
            results["stress"] = full_3x3_to_voigt_6_stress(np.asarray(evaluation.stress))
        return results

    def _made_for(self, atoms: Atoms) -> Evaluator:
        """Return a function that evaluates the atoms at any positions and in any cell."""
        # only what the forces depend on: constraints and the like stay with ASE
        bare = Atoms(numbers=atoms.numbers, positions=atoms.positions, cell=atoms.cell, pbc=atoms.pbc)
        if self._given is not None:
            own = self._given.structure
            if np.array_equal(own.numbers, bare.numbers) and np.array_equal(own.pbc, bare.pbc):
                return Evaluator(self._given)
        return Evaluator(self._recipe.make(bare), skin=self._recipe.skin)
