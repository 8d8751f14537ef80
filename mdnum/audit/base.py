"""Base class of calculator checks, their results, and limits on calls and time."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from mdnum.audit.causes import cause
from mdnum.deadline import Deadline, TimeUp
from mdnum.errors import MdnumError

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.audit.subject import CalculatorSubject

Item, T = TypeVar("Item"), TypeVar("T")
Progress = Callable[[int, int, dict[str, Any]], None]  # (done, of how many, {"phase": words}) now and then
Severity = Literal["info", "warning", "error"]
Skipped = tuple[str, str]  # (what, why) of what was not asked, and why something was not that would have been


def idle(done: int, total: int, info: dict[str, Any]) -> None:
    """Ignore progress reports (the default progress callback)."""


class CallsUp(TimeUp):
    """Raised when a check has reached its limit on calculator calls."""

    why = "the calls of this check were used up"


TIME_UP, CALLS_UP = TimeUp.why, CallsUp.why


class CalculatorError(MdnumError):
    """Raised when the calculator raised an exception, or returned a number that is not finite.

    Args:
        structure: file with the structure on which the calculator failed; None if it was not saved.
        cause: the exception of the calculator; None if the calculator returned a value.
    """

    def __init__(
        self, message: str, *, structure: Path | None = None, cause: BaseException | None = None, **more: Any
    ):
        super().__init__(message, **more)
        self.structure, self.cause = structure, cause


@dataclass
class Meter:
    """Counter of calls to a calculator, with limits on calls and time.

    Limits on calls make results independent of the load of the machine. A deadline can also end a check.
    """

    calls: int = 0
    deadline: Deadline = field(default_factory=Deadline)
    most: float = math.inf  # calls, after which what may be left is left
    spare: int = 0  # that earlier checks were allowed and did not make: later ones may
    _limited: int = 0

    def count(self) -> None:
        """Count one call to the calculator.

        Raises:
            TimeUp: inside `limited`, the deadline has passed or all allowed calls were made.
        """
        if self._limited and (up := self.up):
            raise up
        self.calls += 1

    @property
    def up(self) -> type[TimeUp] | None:
        """Error class if a limit is reached (`TimeUp` or `CallsUp`), or None."""
        return TimeUp if self.deadline.passed else CallsUp if self.calls >= self.most else None

    @contextmanager
    def apart(self, calls: int) -> Iterator[None]:
        """Allow extra calculator calls for a result that several checks use."""
        most = self.most
        self.most = self.calls + calls
        try:
            yield
        finally:
            self.most = max(most + calls, self.calls)

    @contextmanager
    def limited(self) -> Iterator[None]:
        """Limit calculator calls and time in a `with` block. A call beyond a limit raises `TimeUp`."""
        if up := self.up:
            raise up
        self._limited += 1
        try:
            yield
        finally:
            self._limited -= 1


@dataclass(frozen=True)
class Observed:
    """One finding of a check: a code, and the values for its text."""

    code: str  # short stable name
    severity: Severity  # info (nothing to do), warning (look at it), error (the numbers are wrong)
    variants: list[str] = field(default_factory=list)  # of its sentences
    # their fields; of a code without sentences `title`, `text` and `remedy`
    values: dict[str, Any] = field(default_factory=dict)


def finding(
    code: str, severity: Severity, *variants: str | None, tests: Collection[str] = (), **values: Any
) -> Observed:
    """Return a finding. Text variants that are None are left out.

    Args:
        tests: names (keys of `causes.TESTS`) of the tests that were made and that leave this cause possible.

    Raises:
        ValueError: alternative causes were not excluded by tests; report the code of the symptom instead.
    """
    if left := [test for test in cause(code).tests if test not in tests]:
        raise ValueError(
            f"the finding {code} was reported, but the tests {left} were not run; they rule out the other "
            f"possible causes, {', '.join(cause(code).rivals)}"
        )
    return Observed(code, severity, [one for one in variants if one], values)


@dataclass(frozen=True)
class Chart:
    """A chart of labeled lines, with marks on the x axis."""

    title: str
    x_label: str
    y_label: str
    x: list[float]
    lines: dict[str, list[float]]
    marks: dict[str, float] = field(default_factory=dict)
    log_y: bool = False


@dataclass(frozen=True)
class CheckResult:
    """Result of one check, as plain values in units of eV and Å."""

    says: tuple[list[str], dict[str, Any]]  # its summary: names of sentences, and values for all of them
    findings: list[Observed] = field(default_factory=list)
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)  # records by title
    charts: list[Chart] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)  # figures by name
    # by name of a figure: the limit above which it is a finding, and the codes of those that report it
    limits: dict[str, tuple[float, tuple[str, ...]]] = field(default_factory=dict)
    skipped: list[Skipped] = field(default_factory=list)  # what was not asked, and why
    asked: int = 1  # ways of asking that were gone, those on which the calculator failed included
    possible: int = 1  # ways that there are in all; more than asked where the time was up
    # columns of further tables, by name of the table
    recorded: dict[str, dict[str, list[Any]]] = field(default_factory=dict)
    name: str = ""  # of the check, filled in by it
    title: str = ""  # of the check, filled in by it
    seconds: float = 0.0  # of the check, filled in by it


class AuditCheck:
    """Base class of calculator checks. Each subclass is one check.

    A subclass defines a name, a title, a one-line docstring and the method `ask`. The texts of findings are
    in mdnum/verbs/audit.toml. To add a check, add the file `checks/NAME.py` with the class `NameCheck`.

    Args:
        timestep: time step of a run, internal time; None for a fraction of the fastest vibration's period.
        steps: number of time steps of a run; None for the check's default.

    Attributes:
        order: checks run in ascending order of this number; those that find most defects per call come first.
        basic: whether the check has a brief form, which makes a few dozen calls. The brief forms of all
            checks run before any full check, and give a first answer.
        calls: largest number of calculator calls, not counting the unused calls of earlier checks.
        brief: whether this object is the brief form of the check.
        needed_to: questions ("run", "differentiate") that cannot be answered without this check.
        seed: seed of all random numbers of the check.
        structures: structures that show a finding, by name; names of a pair end in -before and -after.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    order: ClassVar[int] = 100
    basic: ClassVar[bool] = False
    calls: ClassVar[int] = 1000
    brief = False
    needed_to: ClassVar[tuple[str, ...]] = ()
    seed = 0

    def __init__(self, timestep: float | None = None, steps: int | None = None):
        self.timestep, self.steps = timestep, steps
        self.structures: dict[str, Atoms] = {}

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Run the check.

        Raises:
            TimeUp: the time limit was reached before the check had any result.
            CalculatorError: the calculator failed and the check cannot continue.
        """
        raise NotImplementedError

    def __call__(self, subject: CalculatorSubject, progress: Progress | None = None) -> CheckResult:
        """Run the check, and return its result with name, title and time."""
        began, meter = perf_counter(), subject.meter
        meter.most = meter.calls + self.calls + (0 if self.brief else meter.spare)
        try:
            found = self.ask(subject, progress or idle)
        finally:
            if not self.brief:
                meter.spare = int(max(meter.most - meter.calls, 0))
        found = replace(found, findings=[*found.findings, *_above_limits(found)])
        return replace(found, name=self.name, title=self.title, seconds=perf_counter() - began)


def _above_limits(result: CheckResult) -> Iterator[Observed]:
    """Yield a finding for each unreported result above its limit."""
    codes = {one.code for one in result.findings}
    for name, (limit, reports) in result.limits.items():
        value = result.numbers.get(name)
        if value is not None and not value <= limit and not codes & set(reports):
            what = name.replace("_", " ")
            yield finding("ABOVE_LIMIT", "warning", what=what, value=float(value), limit=float(limit))


@dataclass
class Ways:
    """Numbers of test cases that a check examined, skipped, or could have examined."""

    skipped: list[Skipped] = field(default_factory=list)
    asked: int = 0  # those on which the calculator failed included
    possible: int = 0

    def skip(self, what: str, why: str) -> None:
        """Record a skipped test case, and the reason for skipping it."""
        self.skipped.append((what, why))

    def each(
        self,
        subject: CalculatorSubject,
        items: Sequence[Item],
        name: Callable[[Item], str],
        ask: Callable[[Item], T],
        progress: Progress,
        phase: str,
        *,
        unit: str = "ways",
        spread: bool = False,
        required: bool = False,
        failed: Callable[[Item, CalculatorError], None] | None = None,
        tolerant: bool = False,
        most: int | None = None,
    ) -> dict[int, T]:
        """Call `ask` for each item until the deadline. Return results by index.

        Args:
            subject: calculator whose limits on calls and time apply.
            name: function that returns the name of a skipped item.
            phase, unit: text for the progress report.
            spread: order the items so that a few answers cover the beginning, the middle and the end.
            required: raise `TimeUp` if no item could be examined.
            failed: function called when the calculator fails; if it is missing, the error is raised.
            tolerant: skip items on which the calculator fails.
            most: largest number of items to examine; all items count as possible test cases.
        """
        found: dict[int, T] = {}
        stride = 4 if spread else 1
        self.possible += len(items)
        for done, place in enumerate([k for n in range(stride) for k in range(n, len(items), stride)][:most]):
            item = items[place]
            progress(done, len(items), {"phase": phase, "unit": unit})
            try:
                with subject.meter.limited():
                    found[place] = ask(item)
            except TimeUp as up:
                self.skip(name(item), up.why)
                continue
            except CalculatorError as error:
                if tolerant:
                    self.skip(name(item), error.message)
                elif failed is None:
                    raise
                else:
                    failed(item, error)
            self.asked += 1
        if required and not self.asked:
            raise subject.meter.up or TimeUp
        return dict(sorted(found.items()))
