"""What every check of a calculator gives back, and how much it may ask."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from mdnum.deadline import Deadline

#: (done, of how many, {"phase": words}) now and then.
Progress = Callable[[int, int, dict[str, Any]], None]
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


@dataclass(frozen=True)
class Observed:
    """What a check found: a code, and values for its sentences in mdnum/verbs/audit.toml.

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
