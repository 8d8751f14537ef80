"""mdnum as an ASE calculator: energy, forces and stress for anything in ASE that wants them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.stress import full_3x3_to_voigt_6_stress
from pydantic import ValidationError

from mdnum import systems
from mdnum.errors import InputError
from mdnum.systems import System, SystemSpec

# a change of either is another program; positions and cell are arguments of it
_REBUILD = {"numbers", "pbc"}


class MdnumCalculator(Calculator):
    """What mdnum computes for a system file, wherever ASE takes a calculator.

    For relaxing with ase.optimize, for stress and equations of state, and for holding mdnum's forces
    against ASE's own tools. A Verlet list is kept between calls until motion and box strain have used its
    skin; for molecular dynamics use mdnum's rollout, which records its flips.

    Args:
        system: a `System`, or the name or path of one; its structure is not used.
        overrides: keys of the system file to change, as `--set` does.
        potential, cutoff, units: instead of a system: the tables of a system file as dictionaries, and
            "metal" (Å, eV) or "lj".
    Raises:
        InputError: neither or both of system and potential; tables that a system file could not hold. At the
            first use: species without constants, a cell narrower than two cutoffs.

    Example:
        >>> argon = MdnumCalculator(
        ...     potential={"kind": "lennard-jones", "sigma": 3.405, "epsilon": 0.0103235},
        ...     cutoff={"kind": "switched", "radius": 8.5, "onset": 7.0},
        ... )
    """

    implemented_properties = ["energy", "energies", "free_energy", "forces", "stress"]  # noqa: RUF012
    nolabel = True

    def __init__(
        self,
        system: System | str | None = None,
        *,
        overrides: Mapping[str, Any] | None = None,
        potential: Mapping[str, Any] | None = None,
        cutoff: Mapping[str, Any] | None = None,
        units: str = "metal",
        **kwargs: Any,
    ):
        super().__init__(**kwargs)
        if (system is None) == (potential is None):
            raise InputError(
                "give either a system or a potential",
                remedy="Say MdnumCalculator('argon/liquid-864'), or potential=... and cutoff=...",
                where="MdnumCalculator",
            )
        if potential is not None:
            self._template = System("calculator", _spec(potential, cutoff, units), None, Atoms())
        else:
            self._template = systems.load(system or "", overrides, world="md")
        self._evaluator: Any = None

    @property
    def system(self) -> System:
        """What is evaluated: the tables of the system file with the atoms of the last call."""
        return self._template if self._evaluator is None else self._evaluator.simulation.system

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        """Evaluate (see ase.calculators.calculator.Calculator)."""
        super().calculate(atoms, properties or ["energy"], system_changes)
        atoms = cast(Atoms, self.atoms)
        if self._evaluator is None or _REBUILD & set(system_changes):
            from mdnum.systems.build import Evaluator

            # only what the forces depend on: constraints and the like stay with ASE
            bare = Atoms(numbers=atoms.numbers, positions=atoms.positions, cell=atoms.cell, pbc=atoms.pbc)
            # the evaluator keeps as much of the skin as the box has room for; it must not be refused for it
            neighbors = self._template.spec.neighbors.model_copy(update={"skin": 0.0})
            spec = self._template.spec.model_copy(update={"neighbors": neighbors})
            simulation = systems.build(replace(self._template, spec=spec, atoms=bare))
            self._evaluator = Evaluator(simulation, skin=self._template.spec.skin)
        evaluation = self._evaluator(atoms.get_positions(), np.asarray(atoms.cell))
        energy = float(evaluation.energy)
        self.results = {
            "energy": energy,
            "free_energy": energy,  # no electrons, no entropy: the same number
            "forces": np.array(evaluation.forces),
        }
        if np.isfinite(evaluation.energies).all():  # a many-body potential need not split by atom
            self.results["energies"] = np.array(evaluation.energies)
        if atoms.cell.rank == 3 and atoms.pbc.all():
            self.results["stress"] = full_3x3_to_voigt_6_stress(np.asarray(evaluation.stress))


def _spec(potential: Mapping[str, Any], cutoff: Mapping[str, Any] | None, units: str) -> SystemSpec:
    """The tables of a system file around a potential; structure and dynamics are never looked at."""
    data: dict[str, Any] = {
        "units": units,
        "structure": {"file": "none"},
        "potential": dict(potential),
        "dynamics": {"kind": "nve", "timestep": 1.0},
    }
    if cutoff is not None:
        data["cutoff"] = dict(cutoff)
    try:
        return SystemSpec.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(first["msg"], where=f"MdnumCalculator: {where}") from None
