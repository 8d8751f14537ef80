"""Choices side by side: what each did within a horizon, and which forks first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mdnum.errors import InputError
from mdnum.forks.choices import Choice, shipped, twin_or_reason, world_of
from mdnum.forks.pair import fork
from mdnum.systems import BallSystem, System


@dataclass(frozen=True)
class Screened:
    """What one choice did within the horizon.

    Attributes:
        choice: its name.
        difference: one line; why it does not apply where it does not.
        seed, fork, split: dates, steps; None where they did not come.
        must_hold: whether it cannot change a bit by design.
        reason_unavailable: why it was not run; None where it was.
        steps: last step that was compared; 0 where it was not run.
        failed: "blow-up" or "runaway" by run, where one ended that way.
    """

    choice: str
    difference: str
    seed: int | None
    fork: int | None
    split: int | None
    must_hold: bool
    reason_unavailable: str | None = None
    steps: int = 0
    failed: str = ""

    @property
    def held(self) -> bool | None:
        """Whether no bit differed within the horizon; None where it was not run."""
        return None if self.reason_unavailable is not None else self.seed is None

    @property
    def finding(self) -> bool:
        """Whether what must hold did not."""
        return self.must_hold and self.held is False


def screen(
    system: System | BallSystem,
    steps: int | None = None,
    choices: Sequence[Choice] | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[Screened]:
    """Every choice against a system, without counterfactuals: the earliest fork first.

    Args:
        system: as loaded.
        steps: horizon; default the system's own.
        choices: default all that ship for its world.
        progress: called with how many are done, how many there are, and the name of the next.

    Raises:
        InputError: no choice, or steps below 1.
    """
    choices = list(shipped(world_of(system)).values()) if choices is None else choices
    if not choices:
        raise InputError("no choice to screen", remedy="Give at least one")
    rows = []
    for done, choice in enumerate(choices):
        if progress is not None:
            progress(done, len(choices), choice.name)
        twin = twin_or_reason(choice, system)
        if isinstance(twin, str):
            rows.append(Screened(choice.name, twin, None, None, None, choice.must_hold, twin))
            continue
        found = fork(twin, steps, counterfactual=False, repeats=0)
        dates = found.dates
        failed = ", ".join(f"{word} of {name}" for name, word in found.failed.items())
        date = dates.seed, dates.fork, dates.split
        rows.append(
            Screened(choice.name, twin.difference, *date, choice.must_hold, None, found.steps, failed)
        )
    return sorted(rows, key=_rank)


def _rank(row: Screened) -> tuple[bool, float, float, float]:
    """Those that were run first, the earliest fork first."""
    late = float("inf")
    fork, seed, split = (late if date is None else date for date in (row.fork, row.seed, row.split))
    return row.reason_unavailable is not None, fork, seed, split
