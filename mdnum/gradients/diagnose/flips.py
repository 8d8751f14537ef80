"""What each flip on the way adds to a gradient.

A crossing adds the derivative of the loss by its own cutoff, times how far the cutoff moves ahead of the
pair. The first factor is a weight of the reverse pass, in which all later flips count; the second comes from
tangents in which no earlier one does. Taken so, the terms of all flips sum to what the flips add, exactly:
the difference of two products is the sum over their factors, later ones from one and earlier ones from the
other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.parameters import columns_of
from mdnum.gradients.problem import Problem, Progress, in_phase
from mdnum.gradients.recorded import GUARD, MOST, ReversePass, passed
from mdnum.gradients.tangents import by_column, tangents

SMOOTH, ENTERS, LEAVES = "smooth", "pair enters", "pair leaves"


@dataclass(frozen=True)
class FlipTerms:
    """What each flip on the way adds to the gradient, heaviest first.

    A number is a scalar parameter, or an entry of one that has several: "potential.sigma[1]".

    Attributes:
        table: a row for each flip: `step`, `i` < `j`, `entered`, `margin`, `bound` and `ambiguous` of the
            decision, `radial_speed` (negative where the pair enters), `weight` (derivative of the loss by the
            cutoff of this one crossing), `grazing` (slower than the guard and left out: it contributes 0, and
            its weight is what it would have been) and `contribution.<number>`, which sum to the event-aware
            gradient minus the symmetric one.
        flips, grazing: how many.
        smooth: the gradient between the flips (their decisions held fixed), by number. total: with the flips.
        share: share of the total that each channel adds, by number, then channel: "smooth", "pair enters",
            "pair leaves".
        half: number of flips, heaviest first, that have half of the weight of all, by number.
        skipped: number of entries of parameters that have too many of them for contributions.
    """

    table: dict[str, np.ndarray]
    flips: int
    grazing: int
    smooth: dict[str, float]
    total: dict[str, float]
    share: dict[str, dict[str, float]]
    half: dict[str, int]
    skipped: dict[str, int]

    def contribution(self, number: str) -> np.ndarray:
        """What each flip adds to the derivative by a number."""
        return self.table[f"contribution.{number}"]


def flips(
    problem: Problem,
    names: Sequence[str],
    *,
    guard: float = GUARD,
    made: ReversePass | None = None,
    progress: Progress | None = None,
) -> FlipTerms:
    """Contributions of all flips, heaviest first.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names.
        guard: radial speed below which a crossing grazes, as a share of the rms radial speed of a pair.
        made: the event-aware reverse pass, where it has been made; its guard counts then.
        progress: called with the steps done, all steps, and the name of the phase.

    Raises:
        InputError: no such parameter, no pair potential, or only parameters of too many entries.

    Error: that of the event-aware gradient.
    """
    simulation = problem.simulation
    full = parameters.resolve(simulation, names)
    sizes = {name: int(np.prod(parameters.value(simulation, name).shape)) for name in full}
    skipped = {name: size for name, size in sizes.items() if size > MOST}
    kept = [name for name in full if name not in skipped]
    if not kept:
        raise InputError(
            f"contributions of flips by {', '.join(full)}: a tangent for each of {sizes[full[0]]} entries "
            "would be needed",
            remedy="Name a parameter of one entry too",
        )
    if made is None:
        made = passed(problem, full, guard=guard, progress=progress)
    columns = columns_of(simulation, kept)
    numbers = [str(column) for column in columns]
    moved: list[np.ndarray] = []
    total: Any = None
    for part in tangents(made.tape, kept, guard=made.guard, progress=in_phase(progress, "tangents")):
        assert part.dr is not None and part.dr_cut is not None
        moved.append(part.dr_cut - part.dr)
        total = part.total
    crossings = made.crossings[::-1]

    def column(name: str, dtype: Any = np.float64, of_ledger: bool = False) -> np.ndarray:
        parts = [getattr(one.ledger if of_ledger else one, name) for one in crossings]
        return np.concatenate(parts) if parts else np.zeros(0, dtype)

    weight, grazing, speed = column("weight"), column("grazing", bool), column("speed")
    each = np.where(grazing[:, None], 0.0, weight[:, None] * np.concatenate(moved))
    # the largest share of what flips add to any of the numbers, so that numbers in other units do not vanish
    sums = np.abs(each).sum(axis=0)
    order = np.argsort(-np.max(np.abs(each) / np.where(sums > 0, sums, 1), axis=1), kind="stable")
    entered, margin = column("entered", bool, True), column("margin", of_ledger=True)
    bound = column("bound", of_ledger=True)
    subject = column("subject", np.int64, True).reshape(-1, 2)
    table = {
        "step": column("step", np.int64, True), "i": subject[:, 0], "j": subject[:, 1], "entered": entered,
        "margin": margin, "bound": bound, "ambiguous": np.abs(margin) <= bound,
        "radial_speed": np.where(np.isinf(speed), 0.0, speed), "weight": weight, "grazing": grazing,
    }  # fmt: skip
    table |= {f"contribution.{number}": each[:, k] for k, number in enumerate(numbers)}
    smooth = {
        number: float(slope) for number, slope in zip(numbers, by_column(made.tape, total), strict=True)
    }
    # a scalar has the empty index
    whole = {str(one): float(np.asarray(made.gradient[one.name])[one.index]) for one in columns}
    share, half = {}, {}
    for k, number in enumerate(numbers):
        parts = (smooth[number], float(each[entered, k].sum()), float(each[~entered, k].sum()))
        size = whole[number] or float("nan")
        share[number] = dict(zip((SMOOTH, ENTERS, LEAVES), (part / size for part in parts), strict=True))
        heaviest = np.cumsum(np.sort(np.abs(each[:, k]))[::-1])
        half[number] = int(np.searchsorted(heaviest, 0.5 * heaviest[-1])) + 1 if heaviest[-1:].any() else 0
    return FlipTerms(
        {name: values[order] for name, values in table.items()},
        len(order), int(grazing.sum()), smooth, whole, share, half, skipped,
    )  # fmt: skip
