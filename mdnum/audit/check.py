"""What a check of a calculator is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import ClassVar, TypeVar

from ase import Atoms

from mdnum.audit.base import TIME_UP, CheckResult, Progress, TimeUp
from mdnum.audit.checks import CHECKS
from mdnum.audit.subject import CalculatorError, CalculatorSubject

T = TypeVar("T")


def ask_each(
    subject: CalculatorSubject,
    ways: Sequence[tuple[str, Callable[[], T]]],
    progress: Progress,
    phase: str,
    skipped: list[tuple[str, str]],
    *,
    spread: bool = False,
    failed: Callable[[int, CalculatorError], None] | None = None,
) -> dict[int, T]:
    """The answers to many ways of asking, by their place; ways that come after the deadline are skipped.

    Args:
        subject: whose deadline it is.
        ways: (name, what asks).
        phase: words for the progress.
        skipped: gets (name, why) of ways that were left out.
        spread: ask in an order in which a few answers tell of the beginning, the middle and the end.
        failed: called where the calculator fails; otherwise that is raised.
    """
    found: dict[int, T] = {}
    stride = 4 if spread else 1
    for done, place in enumerate(k for first in range(stride) for k in range(first, len(ways), stride)):
        what, ask = ways[place]
        progress(done, len(ways), {"phase": phase, "unit": "ways"})
        try:
            with subject.meter.limited():
                found[place] = ask()
        except TimeUp:
            skipped.append((what, TIME_UP))
        except CalculatorError as error:
            if failed is None:
                raise
            failed(place, error)
    return dict(sorted(found.items()))


@dataclass(frozen=True)
class Settings:
    """Of the run of an audit, as a person gave them.

    Attributes:
        timestep: internal time; None for a fraction of the fastest vibration.
        steps: None for as many as a check thinks enough.
    """

    timestep: float | None = None
    steps: int | None = None


class AuditCheck:
    """One question to a calculator: a file in `mdnum.audit.checks`, or an entry point of another package.

    A subclass has a name, a title, a one-line docstring and `ask`; its sentences are in
    mdnum/verbs/audit.toml under the codes of its findings. To add one, add the file `checks/NAME.py`
    with the class `NameCheck`.

    Attributes:
        order: checks with a lower one are asked before.
        structures: that show a finding, by name; those of a pair end in -before and -after.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    order: ClassVar[int] = 100
    #: Answers that are not known without this check, "run" or "differentiate".
    needed_to: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: Settings | None = None):
        self.settings = settings or Settings()
        self.structures: dict[str, Atoms] = {}

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """The check itself.

        Raises:
            TimeUp: the time was up before anything was found out.
            CalculatorError: the calculator fails where the check cannot go on.
        """
        raise NotImplementedError

    def __call__(self, subject: CalculatorSubject, progress: Progress | None = None) -> CheckResult:
        """Ask it, with name, title and the time that it took."""
        began = perf_counter()
        found = self.ask(subject, progress or (lambda done, total, info: None))
        return replace(found, name=self.name, title=self.title, seconds=perf_counter() - began)


def in_order(names: Sequence[str]) -> list[str]:
    """Names of checks in the order in which they are asked: what tells most by a call first."""
    return sorted(names, key=lambda name: (CHECKS[name].order, name))


def needed_to(question: str) -> set[str]:
    """Checks without which a question ("run", "differentiate") has no answer."""
    return {name for name in CHECKS if question in CHECKS[name].needed_to}
