"""What every check of a calculator is given, and what it gives back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.deadline import Deadline

#: (done, of how many, {"phase": words}) now and then.
Progress = Callable[[int, int, dict[str, Any]], None]


#: Why something was not asked that would have been.
TIME_UP = "the time was up"


class TimeUp(Exception):
    """The time that a person gave has passed: what is in progress is left."""


@dataclass
class Meter:
    """Calls of a calculator by all of its objects, and the time that is left for more.

    Evidence is counted in calls, so that it does not depend on the load of a machine; a deadline cuts it
    short.

    Attributes:
        calls: so far.
        deadline: a person's; by default there is none.
    """

    calls: int = 0
    deadline: Deadline = field(default_factory=Deadline)
    _limited: int = 0

    def count(self) -> None:
        """Counts a call.

        Raises:
            TimeUp: the deadline has passed, and what is in progress may be left.
        """
        if self._limited and self.deadline.passed:
            raise TimeUp
        self.calls += 1

    @contextmanager
    def limited(self) -> Iterator[None]:
        """One way of many is asked here: no call is made after the deadline.

        Raises:
            TimeUp: the deadline has passed, now or before the end.
        """
        if self.deadline.passed:
            raise TimeUp
        self._limited += 1
        try:
            yield
        finally:
            self._limited -= 1


def meter_of(subject: Subject) -> Meter:
    """A subject's meter; of one that has none, one that counts nothing."""
    return getattr(subject, "meter", None) or Meter()


def again(
    subject: Subject,
    atoms: Atoms,
    energy: float | None = None,
    forces: Float[np.ndarray, "atoms 3"] | None = None,
) -> bool:
    """Whether a subject that is asked again gives another answer; one that cannot tell gives the same."""
    ask = getattr(subject, "again", None)
    return ask is not None and ask(atoms, energy, forces)


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
        asked: ways of asking that were gone, those on which the calculator failed included.
        possible: ways that there are in all; more than asked where the time was up.
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
    asked: int = 1
    possible: int = 1


class Check(Protocol):
    """One question to a calculator."""

    name: str

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Ask it."""
        ...
