"""Choice of the reference calculator for a simulation: an ASE class or plain numpy.

ASE's results are converted where ASE differs from mdnum:

| system file | ASE | conversion |
|---|---|---|
| lennard-jones, shifted | LennardJones(smooth=False) | none; ASE always shifts the energy to zero at rc |
| lennard-jones, hard | LennardJones(smooth=False) | + u(r_cut) for every pair inside; same forces |
| lennard-jones, switched | LennardJones(smooth=True, ro=onset) | none; the switch is the same cubic in r² |
| lennard-jones, several species | one sigma only | energy of all pairs minus like pairs |
| morse, hard or shifted | MorsePotential | ASE's switch beyond the list; if shifted, - u(r_cut) per pair |
| morse, quintic | MorsePotential(rcut1, rcut2) | alpha = rho0 / r0; the switch is the same quintic in r |
| eam | EAM(potential=file) | none |
| tersoff | Tersoff | none; the same 14 constants |
| an energy function | no ASE class | the function on ASE's neighbor list, named in the label |
| all others | no ASE class | plain numpy on ASE's neighbor list (`independent.py`), named in the label |

ASE's LennardJones keeps a pair at r == rc, but ASE's neighbor lists omit it. For shifted and switched
cutoffs, the energy of this pair is zero. Only the force can differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

from ase.calculators.calculator import Calculator
from ase.calculators.tersoff import Tersoff, TersoffParameters

from mdnum.md import tetrahedral
from mdnum.md.embedded_atom import EmbeddedAtom
from mdnum.md.energies import EnergyFunction
from mdnum.md.potentials import LennardJones, Morse, PairFunction
from mdnum.references.adapted import (
    EnergyOnNeighborList,
    SpeciesSum,
    StepAtCutoff,
    lennard_jones,
    morse,
    short_listed_eam,
)
from mdnum.references.independent import (
    OnNeighborList,
    PairForm,
    PairModel,
    StillingerWeberModel,
    TersoffModel,
    pair_forms,
)
from mdnum.systems import System, build
from mdnum.systems.simulation import Simulation

#: Labels of the reference calculations for a user-defined pair function and energy function.
ITSELF, ENERGY = (
    "the function itself on ASE's neighbor list",
    "the energy function itself on ASE's neighbor list",
)


@dataclass(frozen=True)
class Reference:
    """A reference calculator, with its label and the conversions applied to its results."""

    label: str  # what it is, for people: "ASE LennardJones" or "plain numpy on ASE's neighbor list"
    is_ase: bool  # whether the numbers come from a class of ASE
    conversion: str  # what was done to make the conventions equal
    make: Callable[[], Calculator]  # a fresh calculator


def reference(subject: Simulation | System) -> Reference:
    """Return an ASE class as reference for a simulation, or plain numpy if there is none.

    Args:
        subject: a `Simulation`, or a `System`, whose box may be too small for its skin.
    """
    simulation = _objects(subject)
    species, model = simulation.symbols, simulation.model
    if isinstance(model, EmbeddedAtom):
        return Reference("ASE EAM", True, "none", lambda: short_listed_eam(Path(model.file)))
    if isinstance(model, tetrahedral.Tersoff):
        names = TersoffParameters.__dataclass_fields__
        own = TersoffParameters(**{name: float(getattr(model, name)) for name in names})
        constants = {("Si", "Si", "Si"): own}
        return Reference("ASE Tersoff", True, "none", lambda: Tersoff(constants, skin=0.0))
    # a sum of terms has no class there
    plain = simulation.pairwise and "" in model.terms
    known = _ASE_PAIR.get((type(model.potential), model.cutoff.name)) if plain else None
    if known is None:
        return independent(simulation)
    label, conversion, made = known
    forms = pair_forms(model, simulation.symbols, simulation.decider.compare)
    if len(species) == 1:
        return Reference(label, True, conversion, lambda: made(forms[species[0], species[0]]))
    return Reference(
        f"{label}, a sum over species",
        True,
        f"{conversion}; unlike pairs as all minus like (ASE's class has one set of constants)",
        lambda: SpeciesSum([(made(forms[a, b]), a, b) for a, b in combinations_with_replacement(species, 2)]),
    )


def independent(subject: Simulation | System) -> Reference:
    """Return a plain-numpy reference for any potential except eam, even if ASE has a class."""
    simulation = _objects(subject)
    model, compare = simulation.model, simulation.decider.compare
    if isinstance(model, EnergyFunction):
        conversion = "none: the function, compiled for itself alone"
        return Reference(ENERGY, False, conversion, lambda: EnergyOnNeighborList(model))
    again = TersoffModel if isinstance(simulation.model, tetrahedral.Tersoff) else StillingerWeberModel
    own = simulation.pairwise and all(isinstance(one.potential, PairFunction) for one in model.terms.values())
    return Reference(
        ITSELF if own else "plain numpy on ASE's neighbor list",
        False,
        "none: the function, called pair by pair outside of the loop" if own
        else "none: the formulas of the system file, written a second time",
        lambda: OnNeighborList(
            PairModel.of(model, simulation.symbols, compare) if simulation.pairwise else again(model)
        ),
    )  # fmt: skip


def _objects(subject: Simulation | System) -> Simulation:
    return subject if isinstance(subject, Simulation) else build(subject.without_skin)


#: (label, conversion, calculator) by potential and cutoff.
_ASE_PAIR: dict[tuple[type, str], tuple[str, str, Callable[[PairForm], Calculator]]] = {
    (LennardJones, "hard"): (
        "ASE LennardJones",
        "u(r_cut) added to the energy for each pair inside the cutoff; forces unchanged",
        lambda form: StepAtCutoff(lennard_jones(form), form, form.at_cutoff[0]),
    ),
    (LennardJones, "shifted"): ("ASE LennardJones", "none", lennard_jones),
    (LennardJones, "switched"): (
        "ASE LennardJones (smooth)",
        "none: ro is the onset",
        lambda form: lennard_jones(form, ro=form.r_onset, smooth=True),
    ),
    (Morse, "hard"): (
        "ASE MorsePotential",
        "ASE's own switch moved beyond all listed pairs",
        lambda form: morse(form, 2.0 * form.r_cut, 3.0 * form.r_cut),
    ),
    (Morse, "shifted"): (
        "ASE MorsePotential",
        "ASE's own switch moved beyond all listed pairs; "
        "u(r_cut) subtracted from the energy for each pair inside the cutoff",
        lambda form: StepAtCutoff(morse(form, 2.0 * form.r_cut, 3.0 * form.r_cut), form, -form.at_cutoff[0]),
    ),
    (Morse, "quintic"): (
        "ASE MorsePotential",
        "rho0 = alpha r0, rcut1 = onset / r0, rcut2 = r_cut / r0",
        lambda form: morse(form, form.r_onset, form.r_cut),
    ),
}
