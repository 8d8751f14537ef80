"""The contract of a check of a calculator: what it may ask, and what it gives back."""

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
    """A progress that nobody watches."""


class CallsUp(TimeUp):
    """The calls that a check or a search may make have been made: what is in progress is left."""

    why = "the calls of this check were used up"


TIME_UP, CALLS_UP = TimeUp.why, CallsUp.why


class CalculatorError(MdnumError):
    """The calculator raised, or answered with a number that is not finite.

    Args:
        structure: the file that holds what it was asked about; None where enough have been saved.
        cause: what it raised, None where it answered.
    """

    def __init__(
        self, message: str, *, structure: Path | None = None, cause: BaseException | None = None, **more: Any
    ):
        super().__init__(message, **more)
        self.structure, self.cause = structure, cause


@dataclass
class Meter:
    """Calls of a calculator by all of its objects, and the calls and the time that are left for more.

    Evidence is counted in calls, whatever the load of a machine; a deadline cuts it short.
    """

    calls: int = 0
    deadline: Deadline = field(default_factory=Deadline)
    most: float = math.inf  # calls, after which what may be left is left
    spare: int = 0  # that earlier checks were allowed and did not make: later ones may
    _limited: int = 0

    def count(self) -> None:
        """Count a call.

        Raises:
            TimeUp: the deadline has passed, or the calls are used up, and what is in progress may be left.
        """
        if self._limited and (up := self.up):
            raise up
        self.calls += 1

    @property
    def up(self) -> type[TimeUp] | None:
        """Why no more may be asked, if so."""
        return TimeUp if self.deadline.passed else CallsUp if self.calls >= self.most else None

    @contextmanager
    def apart(self, calls: int) -> Iterator[None]:
        """What several checks rest on is found here, by calls of its own; what is left is for the check."""
        most = self.most
        self.most = self.calls + calls
        try:
            yield
        finally:
            self.most = max(most + calls, self.calls)

    @contextmanager
    def limited(self) -> Iterator[None]:
        """One way of many is asked here: no call is made past a limit, which raises `TimeUp`."""
        if up := self.up:
            raise up
        self._limited += 1
        try:
            yield
        finally:
            self._limited -= 1


@dataclass(frozen=True)
class Observed:
    """What a check found: a code, and values for its sentences in mdnum/verbs/audit.toml."""

    code: str  # short stable name
    severity: Severity  # info (nothing to do), warning (look at it), error (the numbers are wrong)
    variants: list[str] = field(default_factory=list)  # of its sentences
    # their fields; of a code without sentences `title`, `text` and `remedy`
    values: dict[str, Any] = field(default_factory=dict)


def finding(
    code: str, severity: Severity, *variants: str | None, tests: Collection[str] = (), **values: Any
) -> Observed:
    """What was found, with those of its variants that are not None.

    Args:
        tests: names in `causes.TESTS` of those that were made and that leave this cause.

    Raises:
        ValueError: a cause that was not separated from its rivals; give the code of its symptom instead.
    """
    if left := [test for test in cause(code).tests if test not in tests]:
        raise ValueError(
            f"{code} was reported before it was tested against its alternatives in "
            f"{cause(code).rivals}: {left}"
        )
    return Observed(code, severity, [one for one in variants if one], values)


@dataclass(frozen=True)
class Chart:
    """Lines by label over a shared x, with marks (a threshold, say) on x by theirs."""

    title: str
    x_label: str
    y_label: str
    x: list[float]
    lines: dict[str, list[float]]
    marks: dict[str, float] = field(default_factory=dict)
    log_y: bool = False


@dataclass(frozen=True)
class CheckResult:
    """What one check found; all of it plain values, in eV and Å."""

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
    """One question to a calculator: a file in `mdnum.audit.checks`, or an entry point of another package.

    A subclass has a name, a title, a one-line docstring and `ask`; its sentences are under the codes of its
    findings in mdnum/verbs/audit.toml. To add one, add the file `checks/NAME.py` with the class `NameCheck`.

    Args:
        timestep: of a run, internal time; None for a fraction of the fastest vibration.
        steps: of a run; None for as many as a check thinks enough.

    Attributes:
        order: checks with a lower one are asked before: what tells most by a call first.
        basic: whether it has a brief form of a few dozen calls. The brief forms are asked before any check is
            asked in full: with them there is an answer.
        calls: that it may make at most, besides those that checks before it left.
        brief: whether this is the brief form.
        needed_to: answers that are not known without this check, "run" or "differentiate".
        seed: of all that it draws.
        structures: that show a finding, by name; those of a pair end in -before and -after.
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
        """The check itself.

        Raises:
            TimeUp: the time was up before anything was found out.
            CalculatorError: the calculator fails where the check cannot go on.
        """
        raise NotImplementedError

    def __call__(self, subject: CalculatorSubject, progress: Progress | None = None) -> CheckResult:
        """Ask it, with name, title and the time that it took."""
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
    """Findings of figures that are above their limits where no finding of the check reports them."""
    codes = {one.code for one in result.findings}
    for name, (limit, reports) in result.limits.items():
        value = result.numbers.get(name)
        if value is not None and not value <= limit and not codes & set(reports):
            what = name.replace("_", " ")
            yield finding("ABOVE_LIMIT", "warning", what=what, value=float(value), limit=float(limit))


@dataclass
class Ways:
    """Ways of asking, of which some may be left: what every check counts."""

    skipped: list[Skipped] = field(default_factory=list)
    asked: int = 0  # those on which the calculator failed included
    possible: int = 0

    def skip(self, what: str, why: str) -> None:
        """Take note of what was not asked, and why."""
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
        """The answers about many items, by their place; those that come after the deadline are skipped.

        Args:
            subject: whose deadline it is.
            name: of an item, where it is skipped.
            phase, unit: words for the progress.
            spread: ask in an order in which a few answers tell of the beginning, the middle and the end.
            required: raise `TimeUp` where none could be asked.
            failed: called where the calculator fails; otherwise that is raised.
            tolerant: skip those on which it fails instead.
            most: ask so many at most; the others are possible.
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
