"""What each flip on the way adds to a gradient.

A crossing adds the derivative of the loss by its own cutoff, times how far the cutoff moves ahead of the
pair. The first factor is a weight of the reverse pass, in which all later flips count; the second comes from
tangents in which no earlier one does. Taken so, the terms of all flips sum to what the flips add, exactly:
the difference of two products is the sum over their factors, later ones from one and earlier ones from the
other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.diagnose.passes import Passed, passed
from mdnum.gradients.diagnose.places import Flips
from mdnum.gradients.directions import columns_of
from mdnum.gradients.symmetric import GUARD, in_phase
from mdnum.gradients.tangents import by_column, tangents

#: Numbers that contributions are worked out by, at most: each is a tangent along the run.
MOST = 64
SMOOTH, ENTERS, LEAVES = "smooth", "pair enters", "pair leaves"


def flips(
    problem: Problem,
    names: Sequence[str],
    *,
    guard: float = GUARD,
    budget: int = 2**29,
    made: Passed | None = None,
    progress: Progress | None = None,
) -> Flips:
    """Contributions of all flips, heaviest first.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names.
        guard: radial speed below which a crossing grazes, as a share of the rms radial speed of a pair.
        budget: bytes of the recorded run that are kept.
        made: the event-aware reverse pass, where it has been made; its guard counts then.
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no such parameter, no pair potential, or only parameters of too many entries.

    Error: that of the event-aware gradient.
    """
    full = parameters.resolve(problem.simulation, names)
    simulation = problem.simulation
    skipped = {}
    for name in full:
        many = int(np.prod(parameters.value(simulation, name).shape))
        if many > MOST:
            skipped[name] = f"a tangent for each of its {many} entries would be needed"
    kept = [name for name in full if name not in skipped]
    if not kept:
        raise InputError(
            f"contributions of flips by {', '.join(full)}: {skipped[full[0]]}",
            remedy="Name a parameter of one entry too",
        )
    if made is None:
        made = passed(problem, full, guard=guard, budget=budget, progress=progress)
    columns = columns_of(simulation, kept)
    words = [str(column) for column in columns]
    moved: list[np.ndarray] = []
    total: Any = None
    for part in tangents(made.tape, kept, guard=made.guard, progress=in_phase(progress, "tangents")):
        assert part.dr is not None and part.dr_cut is not None
        moved.append(part.dr_cut - part.dr)
        total = part.total
    found = made.crossings[::-1]
    ledgers = [one.ledger for one in found]

    def column(parts: list[np.ndarray], dtype: Any = np.float64) -> np.ndarray:
        return np.concatenate(parts) if parts else np.zeros(0, dtype)

    weight, grazing = column([one.weight for one in found]), column([one.grazing for one in found], bool)
    each = np.where(grazing[:, None], 0.0, weight[:, None] * np.concatenate(moved))
    # the largest share of what flips add to any of the numbers, so that numbers in other units do not vanish
    sizes = np.abs(each).sum(axis=0)
    order = np.argsort(-np.max(np.abs(each) / np.where(sizes > 0, sizes, 1), axis=1), kind="stable")
    smooth = by_column(made.tape, total)
    entered = column([one.entered for one in ledgers], bool)
    whole = {
        str(one): float(np.asarray(made.gradient[one.name])[one.index]) for one in columns
    }  # a scalar has the empty index
    subject = np.concatenate([one.subject for one in ledgers]) if ledgers else np.zeros((0, 2), np.int64)
    margin, bound = column([one.margin for one in ledgers]), column([one.bound for one in ledgers])
    result = Flips(
        column([one.step for one in ledgers], np.int64)[order],
        subject[order, 0],
        subject[order, 1],
        entered[order],
        margin[order],
        bound[order],
        (np.abs(margin) <= bound)[order],
        column([np.where(np.isinf(one.speed), 0.0, one.speed) for one in found])[order],
        weight[order],
        grazing[order],
        {word: each[order, k] for k, word in enumerate(words)},
        {word: float(smooth[k]) for k, word in enumerate(words)},
        whole,
        {word: _shares(float(smooth[k]), each[:, k], entered, whole[word]) for k, word in enumerate(words)},
        skipped,
        "",
    )
    return replace(result, says=sentence(result))


def _shares(smooth: float, each: np.ndarray, entered: np.ndarray, total: float) -> dict[str, float]:
    parts = {SMOOTH: smooth, ENTERS: float(each[entered].sum()), LEAVES: float(each[~entered].sum())}
    return {word: part / total if total != 0 else float("nan") for word, part in parts.items()}


def sentence(found: Flips, digits: Mapping[str, int] | None = None) -> str:
    """What stands out, in a sentence; no share is told of a derivative of which no digit holds.

    Args:
        found: the contributions.
        digits: digits that hold, by parameter, where they are known.
    """
    if not len(found):
        return "No pair crossed its cutoff."
    told = []
    for word, each in found.contribution.items():
        if (digits or {}).get(word.partition("[")[0]) == 0:
            told.append(f"what they make of the derivative by {word} is not told, since no digit of it holds")
            continue
        parts = np.sort(np.abs(each))[::-1]
        if not parts.any():
            told.append(f"flips add nothing to the derivative by {word}")
            continue
        half = int(np.searchsorted(np.cumsum(parts), 0.5 * parts.sum())) + 1
        added = float(each.sum())
        total = found.smooth[word] + added
        share = f"{100 * added / total:.3g} % of" if total != 0 else f"{added:.3g} to"
        told.append(f"flips make {share} the derivative by {word}, half of that in weight {half} of them")
    grazed = int(found.grazing.sum())
    left = f" {grazed} grazed and were left out." if grazed else ""
    return f"Of {len(found)} flips: {'; '.join(told)}.{left}"
