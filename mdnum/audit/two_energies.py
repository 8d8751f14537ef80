"""Calculators that know two energies: the one forces belong to, and the one that a run is told."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit import transformations
from mdnum.audit.base import Subject
from mdnum.audit.noise import Noise, displaced
from mdnum.audit.subject import CalculatorError, CalculatorSubject, only_trying
from mdnum.references.findings import finding

#: How many times the noise the difference of the two may change by.
_ALLOWED = 40.0
#: Of kT: a change below is one of precision rather than of physics.
_SMALL = 1e-6
#: Of kT: a jump, or a difference between two ways of writing one structure down, above is an error.
_LARGE = 1e-3
#: Å to either side, for the derivative of their difference.
_STEP = 1e-3
#: Of such a derivative: its error, roughly.
_CENTRAL = 1e-3
#: How far off a derivative may be, in units of its error, as in `mdnum.audit.forces`.
_SIGNIFICANT = 10.0


def two_energies(
    subject: Subject,
    atoms: Atoms,
    noise: Noise,
    line: Float[np.ndarray, "atoms 3"],
    apart: float,
    error: float,
) -> Iterator[dict[str, str]]:
    """A finding where `energy` and `free_energy` differ by what is not constant.

    Every other check is about the free energy, which forces belong to by ASE's definition; where the two
    differ by a constant at most, what they find holds for both.

    Args:
        subject: the calculator; what has been asked about it so far is looked at as well.
        atoms: a structure away from thresholds.
        noise: of the answers there.
        line: a displacement of it, per Å.
        apart: derivative of the free energy along it minus that of the forces, eV/Å.
        error: of that.
    """
    if not isinstance(subject, CalculatorSubject) or subject.energies(atoms)[1] is None:
        return
    ways = _written_otherwise(subject, atoms)
    jumps = _jumps(subject)
    forward, back = (_difference(subject, displaced(atoms, step * line)) for step in (_STEP, -_STEP))
    slope = (forward - back) / (2 * _STEP)
    allowed = max(_ALLOWED * noise.energy, _SMALL * subject.kT)
    worst = max(subject.ledger.apart.values(), key=lambda one: abs(one.change))
    if abs(worst.change) <= allowed:
        return
    wrong = [f"{what}, by {size:.3g} eV" for what, size in (*ways, *jumps) if size > _LARGE * subject.kT]
    kT = f" ({abs(worst.change) / subject.kT:.2g} kT)" if subject.kT else ""
    yield finding(
        "TWO_ENERGIES",
        "error" if wrong else "warning",
        "energy and free_energy differ, and not by a constant",
        f"For {worst.formula} their difference is {worst.first:.6g} eV in one place and changes by "
        f"{worst.change:.3g} eV{kT}. {_belong(apart, slope, error)}"
        + (f" It changes where nothing may: {'; '.join(wrong)}." if wrong else "")
        + " Every other check is about free_energy: what it finds, or does not, says nothing of energy, "
        "which is what a run logs and a derivative of get_potential_energy() sees.",
        "Where the two are meant to be one, hand over the same number; where they are not (an entropy of "
        "electrons), follow free_energy in runs: get_potential_energy(force_consistent=True).",
    )


def _difference(subject: CalculatorSubject, atoms: Atoms) -> float:
    free, told = subject.energies(atoms)
    return 0.0 if told is None else told - free


def _written_otherwise(subject: CalculatorSubject, atoms: Atoms) -> list[tuple[str, float]]:
    """(another way to write the structure down, how much the difference of the two changes with it)."""
    rng = np.random.default_rng(0)
    kinds = (transformations.translated, transformations.imaged, transformations.permuted)
    here, found = _difference(subject, atoms), []
    for same in (one for kind in kinds for one in islice(kind(atoms, rng), 1)):
        try:
            with only_trying(subject):
                found.append((f"with {same.what}", abs(_difference(subject, same.atoms) - here)))
        except CalculatorError:
            continue  # told elsewhere
    return found


def _jumps(subject: CalculatorSubject) -> list[tuple[str, float]]:
    """(a threshold of two particles, how much the difference of the two jumps there)."""
    from mdnum.audit.thresholds import known_walks

    found = []
    for walk in known_walks(subject):
        for one in walk.thresholds:
            sides = [_difference(subject, walk.pair.at(place)) for place in (one.inside, one.outside)]
            found.append((f"between {walk.pair.name} at {one.radius:.8g} Å", abs(sides[1] - sides[0])))
    return found


def _belong(apart: float, slope: float, error: float) -> str:
    """Whose derivative the forces are, along a line on which the difference of the two has a slope."""
    free = abs(apart) <= _SIGNIFICANT * error
    told = abs(apart + slope) <= max(_SIGNIFICANT * error, _CENTRAL * abs(slope))
    if free and told:
        return "Where it was looked at, the forces are the derivative of both."
    if free or told:
        return f"The forces are the derivative of {'free_energy' if free else 'energy'}."
    return "The forces are the derivative of neither."
