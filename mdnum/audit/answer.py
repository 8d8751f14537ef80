"""An answer or why there is none, where either is of interest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import Subject
from mdnum.audit.subject import CalculatorError, only_trying


@dataclass(frozen=True)
class Answer:
    """Energy and forces.

    Attributes:
        energy: eV.
        forces: eV/Å.
    """

    energy: float
    forces: Float[np.ndarray, "atoms 3"]


@dataclass(frozen=True)
class Refusal:
    """Why there is no answer.

    Attributes:
        why: in words.
        not_finite: it answered, with what is not a number.
    """

    why: str
    not_finite: bool


def ask(subject: Subject, atoms: Atoms) -> Answer | Refusal:
    """What a calculator says to a structure, of which it may be unable to say anything."""
    try:
        with only_trying(subject):
            return Answer(subject.energy(atoms), subject.forces(atoms))
    except CalculatorError as error:
        return Refusal(error.message, error.cause is None)
