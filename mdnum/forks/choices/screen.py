"""All choices side by side: which of them changes a run, and when."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mdnum.errors import InputError
from mdnum.forks.choices.base import Choice
from mdnum.forks.choices.registry import BY_NAME
from mdnum.forks.pair import fork
from mdnum.systems.load import System


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


def screen(
    system: System,
    steps: int | None = None,
    choices: Sequence[Choice] | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[Screened]:
    """Every choice against the system, without counterfactuals: the earliest fork first.

    Args:
        system: as loaded.
        steps: horizon; default the system's own.
        choices: default all that ship.
        progress: called with how many are done, how many there are, and the name of the next.

    Raises:
        InputError: no choice, or steps below 1.
    """
    asked = list(BY_NAME.values()) if choices is None else list(choices)
    if not asked:
        raise InputError("no choice to screen", remedy="Give at least one")
    rows = []
    for done, choice in enumerate(asked):
        if progress is not None:
            progress(done, len(asked), choice.name)
        rows.append(_screened(choice, system, steps))
    return sorted(rows, key=_rank)


def _screened(choice: Choice, system: System, steps: int | None) -> Screened:
    reason = choice.why_not(system)
    if reason is not None:
        return Screened(choice.name, reason, None, None, None, choice.must_hold, reason)
    twin = choice.make(system)
    found = fork(twin, steps, counterfactual=False, repeats=0)
    dates = found.dates
    failed = ", ".join(f"{word} of {name}" for name, word in found.failed.items())
    return Screened(
        choice.name,
        twin.difference,
        dates.seed,
        dates.fork,
        dates.split,
        choice.must_hold,
        None,
        found.steps,
        failed,
    )


def _rank(row: Screened) -> tuple[bool, float, float, float]:
    late = float("inf")
    fork, seed, split = (late if date is None else date for date in (row.fork, row.seed, row.split))
    return row.why_not is not None, fork, seed, split
