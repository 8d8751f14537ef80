"""What a split owes to the decisions and what to the arithmetic: the table of two by two.

Two programs A and B differ in their arithmetic, and from the fork on in their decisions. Beside the free
runs, A with its own decisions and B with its own, there are two mixed ones: B's arithmetic under A's
decisions and A's arithmetic under B's. Each mixed run shares one thing with either free run, so its split
from that run says what the other thing is worth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Shaped

from mdnum.events.forks import split_of

Name = Literal["A", "B"]
What = Literal["decisions", "arithmetic"]

_RUNS: tuple[tuple[Name, Name], ...] = (("A", "A"), ("B", "B"), ("B", "A"), ("A", "B"))
#: Series of separations by arithmetic, decisions and the run that they are taken from.
SERIES: Mapping[tuple[Name, Name, Name], str] = {
    ("B", "A", "A"): "B|A",
    ("B", "A", "B"): "B|A from B",
    ("A", "B", "A"): "A|B from A",
    ("A", "B", "B"): "A|B",
}


@dataclass(frozen=True)
class Cell:
    """When one run splits from another.

    Attributes:
        arithmetic, decisions: whose they are in the run.
        reference: the free run that it is compared with.
        split: step; None where it does not split.
        until: the last step at which it was compared.
    """

    arithmetic: Name
    decisions: Name
    reference: Name
    split: int | None
    until: int

    @property
    def same(self) -> bool:
        """Whether this is the reference itself."""
        return self.arithmetic == self.decisions == self.reference


@dataclass(frozen=True)
class Share:
    """How much of a split one difference is worth: by how much it comes later without it.

    Attributes:
        what: the difference that is taken away; the other one stays.
        reference: the run that is compared with.
        steps: by which the split comes later; below 0 where it comes earlier.
        at_least: whether the split had not come when it was followed no longer.
        nats: growth rate times steps: powers of e of the separation; None without a rate.
    """

    what: What
    reference: Name
    steps: int
    at_least: bool
    nats: float | None


def table(series: Mapping[str, Shaped[np.ndarray, "steps"]], tolerance: float) -> tuple[Cell, ...]:
    """Splits of all runs from A, then from B: (A, A), (B, B), (B, A) and (A, B), those that were run.

    Args:
        series: separations at each step, length: "B", and those of SERIES; NaN after a run was ended.
        tolerance: of the split, length.
    """
    names: tuple[Name, ...] = ("A", "B")
    cells = []
    for reference in names:
        for arithmetic, decisions in _RUNS:
            last = len(series["B"]) - 1
            if arithmetic == decisions == reference:
                cells.append(Cell(arithmetic, decisions, reference, None, last))
                continue
            name = "B" if arithmetic == decisions else SERIES[arithmetic, decisions, reference]
            if name not in series:
                continue
            seen = np.flatnonzero(np.isfinite(series[name]))
            if len(seen):
                split = split_of(series[name], tolerance)
                cells.append(Cell(arithmetic, decisions, reference, split, int(seen[-1])))
    return tuple(cells)


def shares(cells: tuple[Cell, ...], rate: float) -> tuple[Share, ...]:
    """What the decisions and the arithmetic contribute, each as seen from A and from B.

    Args:
        cells: of `table`.
        rate: at which the free runs part, per step; NaN where it is not known.
    """
    free = next((cell.split for cell in cells if cell.arithmetic == cell.decisions != cell.reference), None)
    if free is None:
        return ()
    found = []
    for cell in cells:
        if cell.arithmetic == cell.decisions:
            continue
        # with the reference's decisions it lacks the difference in decisions
        what: What = "decisions" if cell.decisions == cell.reference else "arithmetic"
        if cell.split is None and cell.until <= free:
            # ended before it could have come later
            continue
        steps = (cell.until if cell.split is None else cell.split) - free
        nats = rate * steps if np.isfinite(rate) else None
        found.append(Share(what, cell.reference, steps, cell.split is None, nats))
    return tuple(sorted(found, key=lambda share: (share.what == "arithmetic", share.reference)))
