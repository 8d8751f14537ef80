"""ASE calculators: the one that corresponds to a system, and mdnum as one.

What differs between the codes, and what is done about it:

| system file | ASE | conversion |
|---|---|---|
| lennard-jones, shifted | LennardJones(smooth=False) | none: ASE always shifts the energy to zero at rc |
| lennard-jones, hard | LennardJones(smooth=False) | + u(r_cut) for every pair inside; same forces |
| lennard-jones, switched | LennardJones(smooth=True, ro=onset) | none: the same cubic in r² |
| lennard-jones, several species | one LennardJones has one sigma | all minus like pairs |
| morse, hard or shifted | MorsePotential | its own switch moved beyond the list; shifted: - u(r_cut) a pair |
| morse, quintic | MorsePotential(rcut1, rcut2) | alpha = rho0 / r0; the switch is the same quintic in r |
| eam | EAM(potential=file) | none |
| tersoff | Tersoff | none: the same 14 constants |
| all others | no ASE class | plain numpy on ASE's neighbor list (`independent.py`), and labeled so |

ASE's LennardJones keeps a pair at r == rc (r² > rc² is dropped), its neighbor lists do not (r < rc). In the
shifted and switched forms such a pair has no energy, so only its force can differ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, Parameters, PropertyNotImplementedError
from ase.calculators.tersoff import Tersoff, TersoffParameters
from ase.stress import full_3x3_to_voigt_6_stress, voigt_6_to_full_3x3_stress
from numpy import ndarray
from pydantic import ValidationError

from mdnum import systems
from mdnum.errors import InputError, NumericalError
from mdnum.references.independent import (
    ClassicalCalculator,
    OnNeighborList,
    PairForm,
    PairModel,
    StillingerWeberModel,
    TersoffModel,
    edges_of,
    pair_forms,
)
from mdnum.systems import System, SystemSpec

if TYPE_CHECKING:
    from mdnum.systems.build import Evaluator, Simulation


@dataclass(frozen=True)
class Reference:
    """A calculator to compare with."""

    label: str  # what it is, for people: "ASE LennardJones" or "plain numpy on ASE's neighbor list"
    is_ase: bool  # whether the numbers come from a class of ASE
    conversion: str  # what was done to make the conventions equal
    make: Callable[[], Calculator]  # a fresh calculator


def reference(system: System) -> Reference:
    """The best judge there is for a system: ASE where it has the class, else plain numpy."""
    kind = system.spec.potential.kind
    if kind == "eam":
        (file,) = system.tables
        return Reference("ASE EAM", True, "none", lambda: _short_listed_eam(file))
    if kind == "tersoff":
        constants = TersoffParameters(**asdict(TersoffModel()))
        return Reference(
            "ASE Tersoff", True, "none", lambda: Tersoff({("Si", "Si", "Si"): constants}, skin=0.0)
        )
    if kind == "stillinger-weber":
        return independent(system)
    species = system.species
    forms = pair_forms(system.spec, species)
    cutoff = forms[species[0], species[0]].cutoff
    if (kind, cutoff) not in _ASE_PAIR:
        return independent(system)
    label, conversion, build = _ASE_PAIR[kind, cutoff]
    if len(species) == 1:
        form = forms[species[0], species[0]]
        return Reference(label, True, conversion, lambda: build(form))
    return Reference(
        f"{label}, a sum over species",
        True,
        f"{conversion}; unlike pairs as all minus like (ASE's class has one set of constants)",
        lambda: SpeciesSum(
            [(build(forms[a, b]), a, b) for a, b in combinations_with_replacement(species, 2)]
        ),
    )


def independent(system: System) -> Reference:
    """A judge in plain numpy, for every kind but eam: a third opinion where ASE is the second."""
    kind = system.spec.potential.kind
    models: dict[str, Callable[[], Any]] = {"stillinger-weber": StillingerWeberModel, "tersoff": TersoffModel}
    make_model = models.get(kind) or (lambda: PairModel(pair_forms(system.spec, system.species)))
    return Reference(
        "plain numpy on ASE's neighbor list",
        False,
        "none: the formulas of the system file, written a second time",
        lambda: OnNeighborList(make_model()),
    )


class StepAtCutoff(ClassicalCalculator):
    """One of ASE's calculators with a constant added for each pair inside the cutoff.

    Args:
        inner: the calculator.
        form: which pairs count as inside.
        step: energy of a pair.
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
    """A mixture from calculators that know one species: unlike pairs a-b are all minus a-a minus b-b.

    Args:
        parts: (calculator, species a, species b) for every pair of species present.
    Error: the subtraction costs the digits by which the sum over like pairs exceeds that over unlike
        pairs; about one for the mixtures shipped.
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
    """energy, forces, energies where there are any and, as six numbers, stress of atoms."""
    bare = Atoms(numbers=atoms.numbers, positions=atoms.positions, cell=atoms.cell, pbc=atoms.pbc)
    results: dict[str, Any] = {"energy": float(np.asarray(calculator.get_property("energy", bare)))}
    for name in ("energies", "forces", *(["stress"] if stress else [])):
        try:
            results[name] = np.array(calculator.get_property(name, bare))
        except PropertyNotImplementedError:
            if name != "energies":  # ASE's EAM has the total only
                raise
    return results


def evaluate(calculator: Calculator, atoms: Atoms) -> dict[str, Any]:
    """energy, forces, stress (3, 3) and energies of atoms; None for what there is not."""
    # ASE gives a stress for a molecule in a box, of the box's volume
    results = _results(calculator, atoms, atoms.cell.rank == 3 and bool(atoms.pbc.all()))
    if "stress" in results:
        results["stress"] = voigt_6_to_full_3x3_stress(results["stress"])
    return {"energies": None, "stress": None, **results}


def _lennard_jones(form: PairForm, **options: Any) -> Calculator:
    from ase.calculators.lj import LennardJones

    return LennardJones(**form.constants, rc=form.r_cut, **options)


def _inside_list(form: PairForm) -> Callable[..., Any]:
    """A neighbor list for ASE's MorsePotential that lists what the system file calls inside, no more."""

    def listed(quantities: str, atoms: Atoms, cutoff: float) -> tuple[ndarray, ...]:
        edges = edges_of(atoms, form.r_cut)
        keep = form.inside(edges.r)
        table = {"i": edges.i[keep], "j": edges.j[keep], "d": edges.r[keep], "D": edges.d[keep]}
        return tuple(table[quantity] for quantity in quantities)

    return listed


def _morse(form: PairForm, begin: float, end: float) -> Calculator:
    from ase.calculators.morse import MorsePotential

    depth, alpha, r0 = (form.constants[key] for key in ("depth", "alpha", "r0"))
    return MorsePotential(
        epsilon=depth,
        rho0=alpha * r0,
        r0=r0,
        rcut1=begin / r0,
        rcut2=end / r0,
        neighbor_list=_inside_list(form),
    )


def _at_cutoff(form: PairForm) -> float:
    return float(form.bare(np.array([form.r_cut]))[0][0])


#: (label, conversion, calculator) by potential and cutoff.
_ASE_PAIR: dict[tuple[str, str], tuple[str, str, Callable[[PairForm], Calculator]]] = {
    ("lennard-jones", "hard"): (
        "ASE LennardJones",
        "energy + u(r_cut) for each pair inside; forces as they are",
        lambda form: StepAtCutoff(_lennard_jones(form), form, _at_cutoff(form)),
    ),
    ("lennard-jones", "shifted"): ("ASE LennardJones", "none", lambda form: _lennard_jones(form)),
    ("lennard-jones", "switched"): (
        "ASE LennardJones (smooth)",
        "none: ro is the onset",
        lambda form: _lennard_jones(form, ro=form.r_onset, smooth=True),
    ),
    ("morse", "hard"): (
        "ASE MorsePotential",
        "its own switch moved beyond the pairs listed",
        lambda form: _morse(form, 2.0 * form.r_cut, 3.0 * form.r_cut),
    ),
    ("morse", "shifted"): (
        "ASE MorsePotential",
        "its own switch moved away; energy - u(r_cut) for each pair inside",
        lambda form: StepAtCutoff(_morse(form, 2.0 * form.r_cut, 3.0 * form.r_cut), form, -_at_cutoff(form)),
    ),
    ("morse", "quintic"): (
        "ASE MorsePotential",
        "rho0 = alpha r0, rcut1 = onset / r0, rcut2 = r_cut / r0",
        lambda form: _morse(form, form.r_onset, form.r_cut),
    ),
}


def _short_listed_eam(file: Path) -> Calculator:
    """ASE's EAM with a list of the length it needs: its own reaches 2 (cutoff + skin) and takes minutes."""
    from ase.calculators.eam import EAM
    from ase.neighborlist import NeighborList

    class ShortListed(EAM):
        def update(self, atoms):
            self.Nelements = len(self.elements)
            self.index = np.array([self.elements.index(symbol) for symbol in atoms.get_chemical_symbols()])
            self.pbc = atoms.get_pbc()
            self.neighbors = NeighborList(
                np.full(len(atoms), 0.5 * self.cutoff * (1 + 1e-12)),
                skin=0.0,
                self_interaction=False,
                bothways=True,
            )
            self.neighbors.update(atoms)

    return ShortListed(potential=str(file), form="alloy", skin=0.0)


# --- the other way round: mdnum as an ASE calculator, for anything in ASE that wants one ----------------

# a change of either is another program; positions and cell are arguments of it
_REBUILD = {"numbers", "pbc"}


class MdnumCalculator(ClassicalCalculator):
    """What mdnum computes for a system file, wherever ASE takes a calculator.

    For relaxing with ase.optimize, for stress and equations of state, and for holding mdnum's forces
    against ASE's own tools. A Verlet list is kept between calls until motion and box strain have used its
    skin; for molecular dynamics use mdnum's rollout, which records its flips.

    Args:
        system: a `System`, or the name or path of one, whose structure is not used; or a `Simulation`, for
            its own atoms at other places.
        overrides: keys of the system file to change, as `--set` does.
        potential, cutoff, units: instead of a system: the tables of a system file as dictionaries, and
            "metal" (Å, eV) or "lj".
    Raises:
        InputError: neither or both of system and potential; tables that a system file could not hold. At the
            first use: species without constants, a cell narrower than two cutoffs; a coordinate that is not
            finite.
        NumericalError: an energy or a force that is not finite, as of two atoms at one place.
        TypeError: another keyword.

    Example:
        >>> argon = MdnumCalculator(
        ...     potential={"kind": "lennard-jones", "sigma": 3.405, "epsilon": 0.0103235},
        ...     cutoff={"kind": "switched", "radius": 8.5, "onset": 7.0},
        ... )
    """

    def __init__(
        self,
        system: System | Simulation | str | None = None,
        *,
        overrides: Mapping[str, Any] | None = None,
        potential: Mapping[str, Any] | None = None,
        cutoff: Mapping[str, Any] | None = None,
        units: str = "metal",
    ):
        from mdnum.systems.build import Simulation

        super().__init__()
        self._evaluator: Evaluator | None = None
        self._given: Simulation | None = None
        where = "MdnumCalculator"
        if (system is None) == (potential is None):
            remedy = "Say MdnumCalculator('argon/liquid-864'), or potential=... and cutoff=..."
            raise InputError("give either a system or a potential", remedy=remedy, where=where)
        if potential is not None:
            self._template = System("calculator", _spec(potential, cutoff, units), None, Atoms())
        elif isinstance(system, System | Simulation):
            if overrides:
                remedy = "Pass the name of the system, or load it with the overrides"
                raise InputError("overrides change a system while it is loaded", remedy=remedy, where=where)
            self._template = system if isinstance(system, System) else system.system
            self._given = system if isinstance(system, Simulation) else None
        else:
            self._template = systems.load(str(system), overrides, world="md")
        if not (self._template.spec.cutoff if self._given is None else self._given.pairwise):
            # a potential of many bodies need not split its energy by atom
            self.implemented_properties = [one for one in self.implemented_properties if one != "energies"]
        kept = self._template.spec.model_dump(exclude_none=True, include={"potential", "cutoff", "units"})
        self.parameters = Parameters(kept)

    @property
    def system(self) -> System:
        """What is evaluated: the tables of the system file with the atoms of the last call."""
        return self._template if self._evaluator is None else self._evaluator.simulation.system

    def set(self, **changes: Any) -> dict[str, Any]:
        """Changes nothing: another potential is another calculator.

        Raises:
            TypeError: something is to be changed.
        """
        if changes:
            raise TypeError(f"MdnumCalculator has no {', '.join(changes)} to set; make another calculator")
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
                f"an energy or a force is not finite{pair}", where="MdnumCalculator",
                remedy="Relax the structure with a softer potential, or move the atoms apart",
            )  # fmt: skip
        if "energies" in self.implemented_properties:
            results["energies"] = np.array(evaluation.energies)
        if atoms.cell.rank == 3 and atoms.pbc.any():
            results["stress"] = full_3x3_to_voigt_6_stress(np.asarray(evaluation.stress))
        return results

    def _made_for(self, atoms: Atoms) -> Evaluator:
        """What evaluates these atoms, wherever they are and in whatever box."""
        from mdnum.systems.build import Evaluator

        # only what the forces depend on: constraints and the like stay with ASE
        bare = Atoms(numbers=atoms.numbers, positions=atoms.positions, cell=atoms.cell, pbc=atoms.pbc)
        if self._given is not None:
            own = self._given.system.atoms
            if not (np.array_equal(own.numbers, bare.numbers) and np.array_equal(own.pbc, bare.pbc)):
                raise InputError(
                    "these are other atoms than the simulation's", where="MdnumCalculator",
                    remedy="Give the system instead: MdnumCalculator(mdnum.load(...))",
                )  # fmt: skip
            return Evaluator(self._given)
        # the evaluator keeps as much of the skin as the box has room for; it must not be refused for it
        neighbors = self._template.spec.neighbors.model_copy(update={"skin": 0.0})
        spec = self._template.spec.model_copy(update={"neighbors": neighbors})
        simulation = systems.build(replace(self._template, spec=spec, atoms=bare))
        return Evaluator(simulation, skin=self._template.spec.skin)


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
