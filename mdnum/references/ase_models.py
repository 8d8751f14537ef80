"""ASE calculators: the one that corresponds to a simulation.

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

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator
from ase.calculators.tersoff import Tersoff, TersoffParameters
from ase.stress import voigt_6_to_full_3x3_stress
from numpy import ndarray

from mdnum.errors import InputError
from mdnum.md.potentials import PairFunction
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
from mdnum.systems import System, build
from mdnum.systems.simulation import Simulation

#: Label of the judge of a pair function that a person wrote.
ITSELF = "the function itself on ASE's neighbor list"


@dataclass(frozen=True)
class Reference:
    """A calculator to compare with."""

    label: str  # what it is, for people: "ASE LennardJones" or "plain numpy on ASE's neighbor list"
    is_ase: bool  # whether the numbers come from a class of ASE
    conversion: str  # what was done to make the conventions equal
    make: Callable[[], Calculator]  # a fresh calculator


def reference(subject: Simulation | System) -> Reference:
    """The best judge there is for a simulation: ASE where it has the class, else plain numpy.

    Args:
        subject: a `Simulation`, or a `System`, whose box need not have room for its skin.
    """
    simulation = _objects(subject)
    kind, species, model = simulation.potential.name, simulation.symbols, simulation.model
    if kind == "eam":
        return Reference("ASE EAM", True, "none", lambda: _short_listed_eam(Path(model.file)))
    if kind == "tersoff":
        constants = {("Si", "Si", "Si"): TersoffParameters(**asdict(TersoffModel()))}
        return Reference("ASE Tersoff", True, "none", lambda: Tersoff(constants, skin=0.0))
    # a sum of terms has no class there
    plain = simulation.pairwise and "" in model.terms
    known = _ASE_PAIR.get((kind, model.cutoff.name)) if plain else None
    if known is None or isinstance(simulation.potential, PairFunction):
        return independent(simulation)
    label, conversion, made = known
    forms = _forms(simulation)
    if len(species) == 1:
        return Reference(label, True, conversion, lambda: made(forms[species[0], species[0]]))
    return Reference(
        f"{label}, a sum over species",
        True,
        f"{conversion}; unlike pairs as all minus like (ASE's class has one set of constants)",
        lambda: SpeciesSum([(made(forms[a, b]), a, b) for a, b in combinations_with_replacement(species, 2)]),
    )


def independent(subject: Simulation | System) -> Reference:
    """A judge in plain numpy, for every kind but eam: a third opinion where ASE is the second.

    Args:
        subject: as for `reference`.

    Raises:
        InputError: of an energy function, which nothing here evaluates a second time.
    """
    simulation = _objects(subject)
    kind = simulation.potential.name
    models: dict[str, Callable[[], Any]] = {"stillinger-weber": StillingerWeberModel, "tersoff": TersoffModel}
    if not simulation.pairwise and kind not in models:
        raise InputError("nothing here evaluates an energy function a second time", where=kind)
    model, compare = simulation.model, simulation.decider.compare
    own = simulation.pairwise and all(isinstance(one.potential, PairFunction) for one in model.terms.values())
    make_model = models[kind] if kind in models else lambda: PairModel.of(model, simulation.symbols, compare)
    return Reference(
        ITSELF if own else "plain numpy on ASE's neighbor list",
        False,
        "none: the function, called pair by pair outside of the loop" if own
        else "none: the formulas of the system file, written a second time",
        lambda: OnNeighborList(make_model()),
    )  # fmt: skip


def _objects(subject: Simulation | System) -> Simulation:
    return subject if isinstance(subject, Simulation) else build(subject.without_skin)


def _forms(simulation: Simulation) -> dict[tuple[str, str], PairForm]:
    return pair_forms(simulation.model, simulation.symbols, simulation.decider.compare)


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
    names = ["energy", "forces", *(["stress"] if stress else [])]
    if "energies" in calculator.implemented_properties:  # ASE's EAM has the total only
        names.append("energies")
    results: dict[str, Any] = {name: np.array(calculator.get_property(name, bare)) for name in names}
    return {**results, "energy": float(results["energy"])}


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
    lengths = {"rho0": alpha * r0, "r0": r0, "rcut1": begin / r0, "rcut2": end / r0}
    return MorsePotential(epsilon=depth, **lengths, neighbor_list=_inside_list(form))


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
            reach = np.full(len(atoms), 0.5 * self.cutoff * (1 + 1e-12))
            self.neighbors = NeighborList(reach, skin=0.0, self_interaction=False, bothways=True)
            self.neighbors.update(atoms)

    return ShortListed(potential=str(file), form="alloy", skin=0.0)
