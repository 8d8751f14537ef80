"""A pair of runs, followed until they split: dates, the decision at the fork, and a tested verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Shaped

from mdnum.errors import InputError
from mdnum.events.chance import Delay
from mdnum.events.forks import PATIENCE, Dates, Growth, Verdict, growth, judge, split_of
from mdnum.events.shares import Cell, Share, shares, table
from mdnum.forks.repeats import perturbed, repeat
from mdnum.forks.twin import Twin
from mdnum.forks.words import repeats_asked
from mdnum.md.cell import HostCell
from mdnum.rollout.engine import Start, first_state
from mdnum.rollout.flips import Ambiguous
from mdnum.rollout.lockstep import CrossFlip, Stretch, lockstep

#: The split tolerance as a share of the longest cutoff. Flips that part a crystal do so slowly, and its atoms
#: have no room to be much further apart; docs/verdict-calibration.md has the verdicts by tolerance.
SPLIT = 0.01
#: A run is followed for so many times the steps to its split, so that "did not split" means something.
_BEYOND = 2.0
#: A counterfactual ends when a decision it is told is so many tolerances from its cutoff.
_GUARD = 3.0
#: Cross-run flips that are kept; the counts cover all of them.
FLIPS_KEPT = 100_000


@dataclass(frozen=True)
class Decision:
    """The decision at the fork.

    Attributes:
        step: of the fork.
        i, j: the pair, labels of A.
        run: which run flipped there, "A" or "B"; "start" where they differ from the start on.
        entered: whether the pair entered its cutoff in that run.
        margin, bound: of that decision, and the bound on its rounding error, in the quantity's space.
        ambiguous: whether rounding alone could have decided otherwise.
        separation: largest distance between the runs at the step before, length.
        also: further pairs that fork at the same step.
    """

    step: int
    i: int
    j: int
    run: str
    entered: bool
    margin: float
    bound: float
    ambiguous: bool
    separation: float
    also: int


@dataclass(frozen=True)
class Fork:
    """What became of a pair of runs.

    Attributes:
        twin: the pair.
        steps: steps that were followed.
        asked: steps that were asked for.
        tolerance: of the split, length.
        dates: seed, fork and split.
        decision: at the fork; None without one.
        series: arrays by step: "step"; separations from A "B", "B|A", "A|B from A", "B 1", ... (repeats,
            NaN once all have split), from B "A|B" and "B|A from B" (length);
            "cross", pairs that differ; "overridden" and "furthest" of B|A;
            energies "energy A", "energy B", "energy B|A"; "nearest A", "nearest B", the distance of the pair
            next to its cutoff from it (length); "bound A", "bound B", how far rounding can move a distance
            that is compared (length); "ambiguous A", "ambiguous B", ambiguous decisions.
        flips: cross-run flips, the first `FLIPS_KEPT`.
        flips_total: of all.
        doubts: ambiguous decisions of A and of B, the first `FLIPS_KEPT` of each.
        growth: of the separations "B" and "B|A".
        splits: first step beyond the tolerance by separation; None where there is none.
        table: splits of either arithmetic under either decisions.
        shares: what the decisions and what the arithmetic contributed to the split.
        verdict: on the flips.
        repeats: when each repeat splits, free and under A's decisions.
        failed: runs that ended in "blow-up" or "runaway". Where a free run does, the comparison ends with it;
            where only one of them does, that is the fork at the latest.
    """

    twin: Twin
    steps: int
    asked: int
    tolerance: float
    dates: Dates
    decision: Decision | None
    series: dict[str, Shaped[np.ndarray, "steps"]]
    flips: tuple[CrossFlip, ...]
    flips_total: int
    doubts: dict[str, Ambiguous]
    growth: dict[str, Growth]
    splits: dict[str, int | None]
    table: tuple[Cell, ...]
    shares: tuple[Share, ...]
    verdict: Verdict
    repeats: tuple[Delay, ...]
    failed: dict[str, str]


def fork(
    twin: Twin,
    steps: int | None = None,
    *,
    split: float | None = None,
    counterfactual: bool = True,
    back: bool | None = None,
    repeats: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> Fork:
    """Follow two runs until they have split, and judge what the flips had to do with it.

    Args:
        twin: the pair.
        steps: last step; default the system's own. Followed to twice the split at most; a fifth further where
            the split comes too late to tell a cause from a delay.
        split: separation that counts as split, length; default 0.01 of the longest cutoff.
        counterfactual: whether to run B under A's decisions; many-body potentials cannot.
        back: whether to run A under B's decisions too, for the full table of two by two; it costs as much
            as the run of B under A's. Default where that is run.
        repeats: runs of B at most of which all atoms are displaced at random by as much as the choice
            separates the runs in their first 100 steps (an ulp at least), each free and under A's decisions;
            default 15. They are run where the runs split either way, until the verdict is clear.
        seed: of the perturbations.
        progress: called with the step reached, the last step, and figures.

    Raises:
        InputError: steps below 1, runs of different size, or counterfactuals asked for that are not run.
    """
    a, b = twin.a, twin.b
    counterfactual, back, most = counterfactuals(twin, counterfactual, back, repeats)
    if a.atoms != b.atoms:
        raise InputError(
            f"the runs have {a.atoms} and {b.atoms} atoms", remedy="Compare runs of one structure"
        )
    last = a.system.spec.dynamics.steps if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    tolerance = SPLIT * a.r_cut if split is None else split
    if not tolerance > 0:
        raise InputError(f"split = {tolerance:g}; expected a length above 0")
    gathered: list[Stretch] = []
    flips: list[CrossFlip] = []
    doubts = {name: Ambiguous.joined([]) for name in ("A", "B")}
    total = 0
    asked, end = last, None
    for stretch in lockstep(
        a,
        b,
        _beyond(last),
        start_a=twin.start_a,
        start_b=twin.start_b,
        frame=twin.frame,
        handed=counterfactual,
        back=back,
        guard=_GUARD * tolerance,
    ):
        apart = split_of(stretch.separation["B"], tolerance)
        if end is None and apart is not None and stretch.first + apart <= asked:
            end = int(_BEYOND * (stretch.first + apart)) + 100
            last = min(end, max(asked, _beyond(stretch.first + apart)))
        # the stretches are the program's own: the last one may end beyond the last step
        stretch = stretch.until(last)
        gathered.append(replace(stretch, flips=(), doubts={}))
        total += len(stretch.flips)
        flips += stretch.flips[: max(0, FLIPS_KEPT - len(flips))]
        for name, more in stretch.doubts.items():
            room = max(0, FLIPS_KEPT - len(doubts[name].step))
            doubts[name] = Ambiguous.joined([doubts[name], more.where(slice(room))])
        reached = stretch.first + stretch.rows - 1
        if progress is not None:
            shown = {"phase": "run", "separation": float(np.nanmax(stretch.separation["B"], initial=0.0))}
            progress(min(reached, last), last, shown)
        if reached >= last:
            break
    found = _judged(twin, asked, tolerance, gathered, tuple(flips), total, doubts, most)
    return _repeated(found, most, seed, progress)


def counterfactuals(
    twin: Twin, counterfactual: bool, back: bool | None, repeats: int | None
) -> tuple[bool, bool, int]:
    """Whether to run B under A's decisions, A under B's, and how many repeats at most.

    Args:
        twin: the pair.
        counterfactual: as asked.
        back, repeats: as asked; None for what goes with it.

    Raises:
        InputError: asked for, and not run.
    """
    pairwise = twin.a.pairwise and twin.b.pairwise
    runs = counterfactual and pairwise
    why = "those are left out" if pairwise else "a many-body potential decides inside its energy function"
    most = repeats_asked(repeats, runs, why)
    if back and not runs:
        raise InputError(
            f"A under B's decisions was asked for, and B under A's is not run: {why}",
            remedy="Leave out back",
        )
    return runs, runs if back is None else back, most


def _beyond(step: int) -> int:
    """The step up to which a split must be followed to mean something."""
    return int(np.ceil(PATIENCE * step)) + 1


def _repeated(
    found: Fork, most: int, seed: int, progress: Callable[[int, int, dict[str, Any]], None] | None
) -> Fork:
    """The same with as many repeats as its verdict wants."""
    twin, series = found.twin, dict(found.series)
    starts: list[Start] = []
    while wanted := found.verdict.wanted:
        starts = starts or perturbed(twin, found.tolerance, most, seed)
        done = len(found.repeats)
        if progress is not None:
            progress(found.steps, found.steps, {"phase": f"repeats {done + 1} to {done + wanted} of {most}"})
        delays, tolerance = [], found.tolerance
        runs = repeat(twin, starts[done : done + wanted], found.steps, tolerance, _GUARD * tolerance)
        for number, (free, handed) in enumerate(runs, done + 1):
            delays.append(Delay.of(free, handed, tolerance))
            series[f"B {number}"] = np.append(free, np.full(found.steps + 1 - len(free), np.nan))
        repeats = (*found.repeats, *delays)
        verdict = judge(found.dates, series["B"], series["B|A"], found.tolerance, repeats, most)
        found = replace(found, series=series, repeats=repeats, verdict=verdict)
    return found


def _judged(
    twin: Twin,
    asked: int,
    tolerance: float,
    gathered: list[Stretch],
    flips: tuple[CrossFlip, ...],
    total: int,
    doubts: dict[str, Ambiguous],
    most: int,
) -> Fork:
    series = _series(gathered)
    bits = np.concatenate([stretch.bits for stretch in gathered])
    if gathered[-1].failed["A"] or gathered[-1].failed["B"]:
        # what one run does after the other has ended is no comparison
        end = int(np.flatnonzero(np.isfinite(series["B"])).max(initial=0)) + 1
        series, bits = {name: values[:end] for name, values in series.items()}, bits[:end]
        total -= sum(flip.step >= end for flip in flips)
        flips = tuple(flip for flip in flips if flip.step < end)
    free = series["B"]
    splits = {name: split_of(series[name], tolerance) for name in series if name[0] in "AB"}
    first = next((flip.step for flip in flips), None)
    ended = [name for name in ("A", "B") if gathered[-1].failed[name]]
    if first is None and len(ended) == 1:
        # that one run can go on and the other cannot is a fork if anything is
        first = len(free) - 1
    failed = {name: word for stretch in gathered[-1:] for name, word in stretch.failed.items() if word}
    seed = int(bits.argmax()) if bits.any() else None
    told = None
    if not flips and len(ended) == 1:
        # one of them has no state after it: no bit can be the same
        seed = first if seed is None else seed
        word, other = failed[ended[0]], "B" if ended[0] == "A" else "A"
        told = f"run {ended[0]} ended in a {word} at step {first} and run {other} did not"
    dates = Dates(seed, first, splits["B"])
    handed = series.get("B|A")
    rates = {name: growth(series[name], tolerance) for name in ("B", "B|A") if name in series}
    verdict = judge(dates, free, handed, tolerance, (), most, ended=told)
    cells = table(series, tolerance)
    return Fork(
        twin,
        len(free) - 1,
        asked,
        tolerance,
        dates,
        _decision(twin, flips, series),
        series,
        flips,
        total,
        doubts,
        rates,
        splits,
        cells,
        shares(cells, rates["B"].rate),
        verdict,
        (),
        failed,
    )


def _series(gathered: list[Stretch]) -> dict[str, np.ndarray]:
    series = {"step": np.concatenate([np.arange(s.first, s.first + s.rows) for s in gathered])}
    for name in gathered[0].separation:
        series[name] = np.concatenate([s.separation[name] for s in gathered])
    series["cross"] = np.concatenate([s.cross for s in gathered])
    for name in gathered[0].energy:
        series[f"energy {name}"] = np.concatenate([s.energy[name] for s in gathered])
    if "B|A" in gathered[0].overridden:
        series["overridden"] = np.concatenate([s.overridden["B|A"] for s in gathered])
        series["furthest"] = np.concatenate([s.furthest["B|A"] for s in gathered])
    for name in ("A", "B"):
        series[f"nearest {name}"] = np.concatenate([s.nearest[name] for s in gathered])
        series[f"bound {name}"] = np.concatenate([s.bound[name] for s in gathered])
        series[f"ambiguous {name}"] = np.concatenate([s.ambiguous[name] for s in gathered])
    return series


def _decision(twin: Twin, flips: tuple[CrossFlip, ...], series: dict[str, np.ndarray]) -> Decision | None:
    if not flips:
        return None
    step = flips[0].step
    together = [flip for flip in flips if flip.step == step and flip.differs]
    chosen = min(together, key=lambda flip: abs(flip.margin) if np.isfinite(flip.margin) else np.inf)
    before = float(series["B"][max(0, step - 1)])
    if np.isfinite(chosen.margin):
        margin, bound, run = chosen.margin, chosen.bound, chosen.run
    else:
        margin, bound = _start_margin(twin, chosen)
        run = "start"
    return Decision(
        step,
        chosen.i,
        chosen.j,
        run,
        chosen.entered,
        margin,
        bound,
        abs(margin) <= bound,
        before,
        len(together) - 1,
    )


def _start_margin(twin: Twin, flip: CrossFlip) -> tuple[float, float]:
    """Margin and bound of a pair in A's start, where no flip came before it."""
    a = twin.a
    start = twin.start_a or first_state(a)
    x = np.asarray(start.state.x).T
    kind = int(a.type_of(np.array([flip.i]), np.array([flip.j]))[0])
    d = HostCell(a.cell, a.decider.dtype).displacement(x[[flip.i]], x[[flip.j]])
    quantity = float(a.decider.host_quantity(*d)[0])
    return a.decider.thresholds[kind].value - quantity, float(a.decider.bounds_at(x.T[None])[0, kind])
