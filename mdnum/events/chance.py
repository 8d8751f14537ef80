"""How far two splits may lie apart by chance, from repeats of a pair of runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Chance:
    """How far splits scatter by chance.

    Attributes:
        noise: twice the standard deviation of a difference of two splits, steps.
        known: whether it is an estimate; False where no repeat split.
        least: whether it is a lower bound, as a repeat did not split.
        text: in words.
    """

    noise: float
    known: bool
    least: bool
    text: str


def scatter_of(free: int, repeats: Sequence[int | None], last: int) -> Chance:
    """How far repeats of a pair scatter.

    Args:
        free: split of the pair itself, step.
        repeats: their splits; None for one that did not within the horizon, which counts as if it did there.
        last: step of the horizon.
    """
    if not repeats:
        return Chance(0.0, False, False, "no repeats were run")
    many = f"{len(repeats)} repeat{'s' if len(repeats) > 1 else ''}"
    how = (
        "all positions of B's start displaced at random by as much as the choice separates the runs in their "
        "first 100 steps, an ulp at least"
    )
    late = sum(at is None for at in repeats)
    if late == len(repeats):
        return Chance(0.0, False, True, f"of {many} ({how}) none split within {last} steps")
    # repeats may all be earlier than the pair, when they are perturbed by more: their own scatter counts
    sample = [last if at is None else at for at in repeats]
    if len(sample) == 1:
        sample = [free, *sample]
    # both dates scatter, the free one and the handed one
    noise = 2.0 * float(np.sqrt(2) * np.std(sample, ddof=1))
    if not late:
        return Chance(noise, True, False, f"{many} ({how}) scatter by {noise:.0f} steps (2 σ)")
    text = (
        f"{many} ({how}) scatter by {noise:.0f} steps (2 σ) at least: {late} did not split within {last} "
        "steps and counts as if then"
    )
    return Chance(noise, True, True, text)
