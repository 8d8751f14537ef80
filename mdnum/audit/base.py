"""What a check of a calculator is, what it gives back, and the registry of all checks."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from mdnum.deadline import Deadline
from mdnum.registry import Registry

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.audit.subject import CalculatorError, CalculatorSubject

#: (done, of how many, {"phase": words}) now and then.
Progress = Callable[[int, int, dict[str, Any]], None]
T = TypeVar("T")
Severity = Literal["info", "warning", "error"]

#: Why something was not asked that would have been.
TIME_UP = "the time was up"


class TimeUp(Exception):
    """The time that a person gave has passed: what is in progress is left."""


@dataclass
class Meter:
    """Calls of a calculator by all of its objects, and the time that is left for more.

    Evidence is counted in calls, so that it does not depend on the load of a machine; a deadline cuts it
    short.
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
        """One way of many is asked here: no call is made after the deadline, which raises `TimeUp`."""
        if self.deadline.passed:
            raise TimeUp
        self._limited += 1
        try:
            yield
        finally:
            self._limited -= 1


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
    from mdnum.audit.subject import CalculatorError

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
class Observed:
    """What a check found: a code, and values for its sentences in mdnum/workflow/audit.toml.

    Attributes:
        code: short stable name.
        severity: info (nothing to do), warning (look at it), error (the numbers are wrong).
        variants: of its sentences.
        values: their fields; of a code without sentences `title`, `text` and `remedy`.
    """

    code: str
    severity: Severity
    variants: list[str] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)


def finding(code: str, severity: Severity, *variants: str | None, **values: Any) -> Observed:
    """What was found, with those of its variants that are not None."""
    return Observed(code, severity, [one for one in variants if one], values)


@dataclass(frozen=True)
class Chart:
    """Something drawn against something.

    Attributes:
        x: shared by all lines.
        lines: values by label.
        marks: places on x by their label (a threshold, say).
        log_y: whether y spans decades.
    """

    title: str
    x_label: str
    y_label: str
    x: list[float]
    lines: dict[str, list[float]]
    marks: dict[str, float] = field(default_factory=dict)
    log_y: bool = False


@dataclass(frozen=True)
class CheckResult:
    """What one check found; all of it plain values, in eV and Å.

    Attributes:
        says: its summary: names of sentences, and values for all of them.
        tables: records by title.
        numbers: figures by name.
        skipped: (what, why) of what was not asked.
        asked: ways of asking that were gone, those on which the calculator failed included.
        possible: ways that there are in all; more than asked where the time was up.
        recorded: columns of further tables, by name of the table.
        name, title, seconds: of the check, filled in by it.
    """

    says: tuple[list[str], dict[str, Any]]
    findings: list[Observed] = field(default_factory=list)
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    charts: list[Chart] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)
    skipped: list[tuple[str, str]] = field(default_factory=list)
    asked: int = 1
    possible: int = 1
    recorded: dict[str, dict[str, list[Any]]] = field(default_factory=dict)
    name: str = ""
    title: str = ""
    seconds: float = 0.0


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
    mdnum/workflow/audit.toml under the codes of its findings. To add one, add the file `checks/NAME.py`
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


#: All checks by name, those of other packages included.
CHECKS: Registry[AuditCheck] = Registry("check", "mdnum.checks", AuditCheck)


def _register() -> None:
    from mdnum.audit import checks

    for module in pkgutil.iter_modules(checks.__path__):
        CHECKS.add(module.name, f"mdnum.audit.checks.{module.name}:{module.name.capitalize()}Check")


_register()


def in_order(names: Sequence[str]) -> list[str]:
    """Names of checks in the order in which they are asked: what tells most by a call first."""
    return sorted(names, key=lambda name: (CHECKS[name].order, name))


def needed_to(question: str, names: Mapping[str, Any] | Sequence[str] | None = None) -> set[str]:
    """Checks of these, or of all, without which a question ("run", "differentiate") has no answer."""
    return {name for name in (CHECKS if names is None else names) if question in CHECKS[name].needed_to}
