"""What every check of a calculator is given, and what it gives back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from ase import Atoms
from jaxtyping import Float

#: (done, of how many, {"phase": words}) now and then.
Progress = Callable[[int, int, dict[str, Any]], None]


class Subject(Protocol):
    """The calculator under audit, and the structure it is asked about.

    Attributes:
        name: what the person called it.
        atoms: the structure, without a calculator; copy it before changing it.
        kT: energy that a jump is compared with, eV.
    """

    name: str
    atoms: Atoms
    kT: float

    def energy(self, atoms: Atoms) -> float:
        """Potential energy in eV.

        Raises:
            CalculatorError: the calculator raised, or answered with nan; the structure has been saved.
        """
        ...

    def forces(self, atoms: Atoms) -> Float[np.ndarray, "atoms 3"]:
        """Forces in eV/Å; raises as `energy` does."""
        ...

    def fresh(self) -> Subject:
        """The same with a calculator object of its own, which remembers nothing."""
        ...


@dataclass(frozen=True)
class Curve:
    """Something drawn against something.

    Attributes:
        title: what is seen.
        x_label: with its unit.
        y_label: with its unit.
        x: shared by all lines.
        lines: values by label.
        marks: places on x with a word each (a threshold that was found, say).
        log_y: whether y spans decades.
    """

    title: str
    x_label: str
    y_label: str
    x: Float[np.ndarray, "points"]
    lines: Mapping[str, Float[np.ndarray, "points"]]
    marks: Mapping[str, float] = field(default_factory=dict)
    log_y: bool = False


@dataclass(frozen=True)
class Part:
    """What one check found.

    Attributes:
        name: a word, "smoothness" say.
        title: a heading.
        says: one sentence in words, with its numbers.
        findings: dictionaries as `mdnum.references.findings.finding` makes them.
        tables: records by title.
        curves: what to draw.
        numbers: figures for summary.json, plain values.
        skipped: (what, why) of what was not looked at.
        seconds: time it took.
    """

    name: str
    title: str
    says: str
    findings: Sequence[Mapping[str, str]] = ()
    tables: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    curves: Sequence[Curve] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)
    skipped: Sequence[tuple[str, str]] = ()
    seconds: float = 0.0


class Check(Protocol):
    """One question to a calculator."""

    name: str

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Ask it."""
        ...
