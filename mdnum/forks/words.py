"""What was asked for, in words: choices that there are not, repeats that would not be run."""

from __future__ import annotations

from collections.abc import Iterable

from mdnum.errors import InputError
from mdnum.events.chance import FEWEST, REPEATS


def families(names: Iterable[str]) -> str:
    """Choices without their arguments, each once, in order: "precision, reduction, order"."""
    heads = (name.partition("=")[0].partition("@")[0].partition(".")[0] for name in names)
    return ", ".join(dict.fromkeys(heads))


def repeats_asked(repeats: int | None, counterfactual: bool, why: str = "those are left out") -> int:
    """Repeats at most: those asked for, or the default where nothing was said and they would tell anything.

    Args:
        repeats: as asked; None for the default.
        counterfactual: whether there are runs under the other run's decisions.
        why: there are none.

    Raises:
        InputError: below 0, too few to tell anything, or asked for where they would not be run.
    """
    if repeats is None:
        return REPEATS if counterfactual else 0
    if repeats < 0 or 0 < repeats < FEWEST:
        raise InputError(
            f"repeats = {repeats}; expected 0, or {FEWEST} and more",
            remedy="So few could never be clear" if repeats > 0 else None,
        )
    if repeats and not counterfactual:
        raise InputError(
            f"repeats = {repeats}, and no runs under A's decisions, which repeats tell from chance: {why}",
            remedy="Leave out the repeats, or ask for 0",
        )
    return repeats
