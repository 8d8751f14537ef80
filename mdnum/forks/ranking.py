"""Choices side by side: what each did within a horizon, and which forks first. Of no world in particular."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mdnum.errors import InputError
from mdnum.events.forks import Dates


@dataclass(frozen=True)
class Screened:
    """What one choice did within the horizon.

    Attributes:
        choice: its name.
        difference: what differed, in words; why it does not apply where it does not.
        seed, fork, split: dates, steps; None where they did not come.
        must_hold: whether it cannot change a bit by design.
        why_not: why it was not run; None where it was.
        steps: last step that was compared; 0 where it was not run.
        failed: "blow-up" or "runaway" by run, where one ended that way.
    """

    choice: str
    difference: str
    seed: int | None
    fork: int | None
    split: int | None
    must_hold: bool
    why_not: str | None = None
    steps: int = 0
    failed: str = ""

    @property
    def held(self) -> bool | None:
        """Whether no bit differed within the horizon; None where it was not run."""
        return None if self.why_not is not None else self.seed is None

    @property
    def finding(self) -> bool:
        """Whether what must hold did not."""
        return self.must_hold and self.held is False


def not_run(choice: str, must_hold: bool, reason: str) -> Screened:
    """The row of a choice that does not apply."""
    return Screened(choice, reason, None, None, None, must_hold, reason)


def followed(
    choice: str, must_hold: bool, difference: str, dates: Dates, steps: int, failed: Mapping[str, str]
) -> Screened:
    """The row of a choice that was followed.

    Args:
        difference: in words.
        steps: last step that was compared.
        failed: "blow-up" or "runaway" by run.
    """
    words = ", ".join(f"{word} of {name}" for name, word in failed.items())
    return Screened(choice, difference, dates.seed, dates.fork, dates.split, must_hold, None, steps, words)


def rank(row: Screened) -> tuple[bool, float, float, float]:
    """What choices are sorted by: those that were run first, the earliest fork first."""
    late = float("inf")
    fork, seed, split = (late if date is None else date for date in (row.fork, row.seed, row.split))
    return row.why_not is not None, fork, seed, split


def screened(
    choices: Sequence[Any],
    system: Any,
    steps: int | None,
    follow: Callable[..., Any],
    progress: Callable[[int, int, str], None] | None,
) -> list[Screened]:
    """Every choice against a system, without counterfactuals: the earliest fork first.

    Args:
        choices: of the system's world.
        system: as loaded.
        steps: horizon; default the system's own.
        follow: the world's `fork`.
        progress: called with how many are done, how many there are, and the name of the next.

    Raises:
        InputError: no choice, or steps below 1.
    """
    if not choices:
        raise InputError("no choice to screen", remedy="Give at least one")
    rows = []
    for done, choice in enumerate(choices):
        if progress is not None:
            progress(done, len(choices), choice.name)
        reason = choice.why_not(system)
        if reason is not None:
            rows.append(not_run(choice.name, choice.must_hold, reason))
            continue
        twin = choice.make(system)
        found = follow(twin, steps, counterfactual=False, repeats=0)
        rows.append(
            followed(choice.name, choice.must_hold, twin.difference, found.dates, found.steps, found.failed)
        )
    return sorted(rows, key=rank)
