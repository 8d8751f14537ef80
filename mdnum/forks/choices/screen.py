"""All choices side by side: which of them changes a run, and when."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mdnum.forks.choices.base import Choice
from mdnum.forks.choices.registry import BY_NAME
from mdnum.forks.pair import fork
from mdnum.forks.ranking import Screened, screened
from mdnum.systems.load import System


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
    return screened(asked, system, steps, fork, progress)
