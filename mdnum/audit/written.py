"""Whether a calculator writes to the atoms that it is given."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from ase import Atoms

from mdnum.audit.base import Subject
from mdnum.audit.noise import displaced
from mdnum.audit.subject import CalculatorError, CalculatorSubject, only_trying
from mdnum.references.findings import finding


def written(subject: Subject, atoms: Atoms) -> Iterator[dict[str, str]]:
    """What the calculator does to the atoms that it is handed, and not a copy of.

    Args:
        subject: a new object of it is asked.
        atoms: asked about as they are, and a cell further, which many calculators wrap.
    """
    outside = displaced(atoms, np.tile((atoms.pbc * 1.0) @ atoms.cell.array, (len(atoms), 1)))
    for there, words in ((atoms, "the structure"), (outside, "the structure one cell further")):
        other = subject.fresh()
        if not isinstance(other, CalculatorSubject):
            return
        try:
            with only_trying(other):
                changed = other.writes(there)
        except CalculatorError:
            continue  # told elsewhere
        if changed:
            yield finding(
                "CHANGED_INPUT",
                "error",
                "the calculator writes to the atoms it is given",
                f"Asked about {words}, other {' and '.join(changed)} were in the object that it was given. "
                "A run then goes on from what its integrator never chose. Every check hands over a copy, so "
                "that the others do not see it.",
                "Copy the atoms before wrapping or moving them: atoms = atoms.copy().",
            )
            return
