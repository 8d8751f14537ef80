"""All choices of a ball side by side: which of them changes a run, and when."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mdnum.errors import InputError
from mdnum.forks.bounce.choices.base import Choice
from mdnum.forks.bounce.choices.registry import BY_NAME
from mdnum.forks.bounce.pair import fork
from mdnum.forks.ranking import Screened, followed, not_run, rank
from mdnum.systems.ball_system import BallSystem


def screen(
    system: BallSystem,
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
    return sorted(rows, key=rank)


def _screened(choice: Choice, system: BallSystem, steps: int | None) -> Screened:
    reason = choice.why_not(system)
    if reason is not None:
        return not_run(choice.name, choice.must_hold, reason)
    twin = choice.make(system)
    found = fork(twin, steps, counterfactual=False, repeats=0)
    return followed(choice.name, choice.must_hold, twin.difference, found.dates, found.steps, found.failed)
