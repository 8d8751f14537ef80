"""Compare two runs: find when decisions first differ and when the runs split."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Shaped

from mdnum.errors import InputError, expect_at_least
from mdnum.forks.choices import Choice, shipped, twin_or_reason, world_of
from mdnum.forks.worlds import packed, unpacked
from mdnum.numerics.verdicts import (
    FEWEST,
    PATIENCE,
    REPEATS,
    Dates,
    Delay,
    ForkVerdict,
    Growth,
    Share,
    SplitCell,
    growth,
    judge,
    shares,
    split_of,
    table,
)
from mdnum.plain import result
from mdnum.program import Decision, PairRows, Progress, Twin
from mdnum.sweeps import engines
from mdnum.systems import BallSystem

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from mdnum.systems.simulation import Simulation

#: Split tolerance as a share of the longest cutoff or the largest initial height. Flips separate the runs of
#: a crystal slowly, and its atoms cannot move far apart; docs/verdict-calibration.md gives verdicts by
#: tolerance.
SPLIT = 0.01
#: Factor on the step of the split up to which a run is continued, so that "did not split" is a result.
_BEYOND = 2.0
#: A counterfactual ends if the margin of an imposed decision exceeds this number of tolerances.
_GUARD = 3.0
#: Number of steps after which the effect of a choice determines the displacement of repeats, and its largest
#: value in tolerances; and the factor by which the second displacement is smaller.
_SOON, _LARGEST, _DECADES = 100, 1e-3, 100.0
#: Largest number of stored cross-run flips; the counts include all.
FLIPS_KEPT = 100_000


@result
class Fork:
    """Result of comparing two runs step by step.

    Attributes:
        twin: the pair of programs.
        steps, asked: number of steps that were run, and number that was requested.
        tolerance: separation that counts as a split, length.
        dates: steps of first differing bit, fork and split. decision: the decision at the fork, or None.
        series: columns of `PairRows` by step: "step"; separations from A: "B", "B|A", "A|B from A", "B 1",
            ... (repeats; those at the other displacement last; NaN once all have split); separations from B:
            "A|B" and "B|A from B"; "cross"; "overridden" and "furthest" of B|A; "energy A", ...; for
            molecular dynamics "nearest A", "bound A", "ambiguous A" and the same for B; if boxes can differ,
            the strain between the boxes of A and B, "strain", and of A and B|A, "strain B|A".
        flips, flips_total: the first `FLIPS_KEPT` cross-run flips, and the number of all cross-run flips.
        doubts: ambiguous decisions of A and of B, the first `FLIPS_KEPT` of each.
        growth: growth of the separations "B" and "B|A".
        splits: first step beyond the tolerance for each separation; None if there is no split.
        table: split for each combination of one program's arithmetic with one program's decisions.
        shares: contributions of the decisions and of the arithmetic to the split.
        verdict: verdict on the flips. repeats: splits of each repeat, free and under A's decisions, at the
            first displacement and at the other one. displacements: of the starts of the repeats that were
            run, length.
        failed: runs that ended in "blow-up" or "runaway". If a run without imposed decisions fails, the
            comparison ends there; if only one of the runs fails, the fork is at this step at the latest.
        runs: A, B and the counterfactual runs by name, if the world keeps whole runs.
    """

    twin: Twin
    steps: int
    asked: int
    tolerance: float
    dates: Dates
    decision: Decision | None
    series: dict[str, Shaped[np.ndarray, "steps"]]
    flips: tuple[Any, ...]
    flips_total: int
    doubts: dict[str, Any]
    growth: dict[str, Growth]
    splits: dict[str, int | None]
    table: tuple[SplitCell, ...]
    shares: tuple[Share, ...]
    verdict: ForkVerdict
    repeats: tuple[tuple[Delay, ...], tuple[Delay, ...]]
    displacements: tuple[float, ...]
    failed: dict[str, str]
    runs: dict[str, Any]


def fork(
    twin: Twin,
    steps: int | None = None,
    *,
    split: float | None = None,
    counterfactual: bool = True,
    back: bool | None = None,
    repeats: int | None = None,
    progress: Progress | None = None,
) -> Fork:
    """Compare two runs step by step until they split. Measure how much flips contribute to the split.

    Args:
        twin: the pair of programs.
        steps: last step; default the last step of the system. A comparison of molecular-dynamics runs ends at
            twice the step number of the split at the latest. If the split is near the last step, the runs
            continue to 1.2 times the step number of the split, to distinguish a cause from a delay.
        split: separation that counts as a split, length; default 0.01 of the longest cutoff or start height.
        counterfactual: whether to run B under A's decisions, which is impossible for many-body potentials.
        back: whether to run A under B's decisions too; default: only if B is run under A's decisions.
        repeats: largest number of repeats of B, each run freely and under A's decisions; default 15. Their
            starts are displaced randomly by the initial separation of the runs (at least an ulp). If the runs
            split either way, repeats are made until the verdict is clear, then at 1/100 of the displacement.
        progress: called with the step reached, the last step, and current values.

    Raises:
        InputError: steps is below 1, the programs cannot be compared, or requested counterfactual runs are
            not possible.
    """
    a, b = twin.a, twin.b
    counterfactual, back, most = counterfactuals(twin, counterfactual, back, repeats)
    a.check(b)
    asked = a.steps if steps is None else steps
    expect_at_least(1, steps=asked)
    tolerance = SPLIT * a.scale if split is None else split
    if not 0 < tolerance < np.inf:
        raise InputError(f"split = {tolerance:g}; expected a positive distance between runs A and B")
    guard = _GUARD * tolerance
    gathered: list[PairRows] = []
    flips: list[Any] = []
    doubts: dict[str, Any] = {}
    total, last, end = 0, asked, None
    horizon = _beyond(asked) if a.streams else asked
    for rows in a.lockstep(b, horizon, forward=counterfactual, back=back, guard=guard):
        at = split_of(rows.separation["B"], tolerance)
        if a.streams and end is None and at is not None and rows.first + at <= asked:
            end = int(_BEYOND * (rows.first + at)) + 100
            last = min(end, max(asked, _beyond(rows.first + at)))
        # how many rows come at once is the program's own affair: the last may lie beyond the last step
        rows = rows.until(last)
        gathered.append(replace(rows, flips=(), doubts={}))
        total += len(rows.flips)
        flips += rows.flips[: max(0, FLIPS_KEPT - len(flips))]
        for name, more in rows.doubts.items():
            held = doubts.get(name)
            room = FLIPS_KEPT - (0 if held is None else len(held.step))
            more = more[: max(0, room)]
            doubts[name] = more if held is None else type(more).concatenate([held, more])
        reached = rows.first + rows.rows - 1
        if progress is not None:
            shown = {"phase": "run", "separation": float(np.nanmax(rows.separation["B"], initial=0.0))}
            progress(min(reached, last), last, shown)
        if reached >= last:
            break
    found = _judged(twin, asked, tolerance, gathered, flips, total, doubts, most)
    return _repeated(found, most, progress)


def counterfactuals(
    twin: Twin, counterfactual: bool, back: bool | None, repeats: int | None
) -> tuple[bool, bool, int]:
    """Return whether A's decisions are imposed on B, whether B's on A, and the number of repeats.

    Raises:
        InputError: a requested counterfactual run or repeat is not possible.
    """
    reason = twin.a.imposable or twin.b.imposable
    runs = counterfactual and reason is None
    most = repeats_asked(repeats, runs, reason or "such runs are disabled")
    if back and not runs:
        raise InputError(
            "the option `back` cannot be used, because run B is not repeated with the decisions of run A: "
            f"{reason or 'such runs are disabled'}",
            remedy="Omit the option `back`",
        )
    return runs, runs if back is None else back, most


def repeats_asked(repeats: int | None, counterfactual: bool, why: str = "such runs are disabled") -> int:
    """Return the number of repeats of run B.

    Raises:
        InputError: the number is negative or too small for a significant result, or no repeats can be run.
    """
    if repeats is None:
        return REPEATS if counterfactual else 0
    if repeats < 0 or 0 < repeats < FEWEST:
        raise InputError(
            f"repeats = {repeats}; expected 0 or at least {FEWEST} repeated runs",
            remedy="Fewer repeats cannot give a significant result" if repeats > 0 else None,
        )
    if repeats and not counterfactual:
        raise InputError(
            f"repeats = {repeats}, but run B cannot be repeated with the decisions of run A: {why}",
            remedy="Set repeats = 0, or omit repeats",
        )
    return repeats


def _beyond(step: int) -> int:
    """Return the step up to which two runs must stay together to count as not split."""
    return int(np.ceil(PATIENCE * step)) + 1


def displacements(fork: Fork) -> tuple[float, float]:
    """Return two initial displacements for repeats of run B: an early distance from run A, and a smaller one.

    The second displacement is a hundredth of the first. A much smaller displacement would lead to the same
    rounding errors as in the compared runs. The second displacement may be larger if a hundredth of the first
    is below one ulp.
    """
    begins = (fork.dates.fork if fork.dates.first_bit is None else fork.dates.first_bit) or 0
    soon = fork.series["B"][begins : min(max(begins, 1) + _SOON, fork.dates.fork or fork.steps + 1)]
    ulp, largest = fork.twin.b.ulp, _LARGEST * fork.tolerance
    first = max(ulp, min(float(np.nanmax(soon, initial=0.0)), largest))
    less, more = max(ulp, first / _DECADES), max(first, min(first * _DECADES, largest))
    return first, less if first / less > 0.5 * more / first else more


def _repeated(found: Fork, most: int, progress: Progress | None) -> Fork:
    """Repeat run B as often as the verdict requires. Add the results to the comparison."""
    a, b, series, tolerance = found.twin.a, found.twin.b, dict(found.series), found.tolerance
    while wanted := found.verdict.wanted:
        place, sizes = int(found.verdict.other is not None), displacements(found)
        done, ran = len(found.repeats[place]), sum(map(len, found.repeats))
        if progress is not None:
            phase = f"repeats {done + 1} to {done + wanted} of {most + place}, {sizes[place]:.1g} away"
            progress(found.steps, found.steps, {"phase": phase})
        delays = []
        chosen = b.nudged(sizes[place], most + place, seed=place)[done : done + wanted]
        runs = a.repeats(chosen, found.steps, tolerance, _GUARD * tolerance)
        for number, (free, under) in enumerate(runs, ran + 1):
            delays.append(Delay.of(free, under, tolerance))
            series[f"B {number}"] = np.append(free, np.full(found.steps + 1 - len(free), np.nan))
        first, other = found.repeats
        repeats = (first, (*other, *delays)) if place else ((*first, *delays), other)
        given = found.dates, series["B"], series["B|A"], tolerance, repeats[0], most
        verdict, sizes = judge(*given, other=repeats[1]), sizes[: place + 1]
        found = replace(found, series=series, repeats=repeats, displacements=sizes, verdict=verdict)
    return found


def _judged(
    twin: Twin,
    asked: int,
    tolerance: float,
    gathered: list[PairRows],
    flips: list[Any],
    total: int,
    doubts: dict[str, Any],
    most: int,
) -> Fork:
    series = _series(gathered)
    bits = np.concatenate([rows.bits for rows in gathered])
    failed = {name: word for name, word in gathered[-1].failed.items() if word}
    ended = [name for name in ("A", "B") if name in failed]
    if ended:
        # what one run does after the other has ended is no comparison
        end = int(np.flatnonzero(np.isfinite(series["B"])).max(initial=0)) + 1
        series, bits = {name: values[:end] for name, values in series.items()}, bits[:end]
        total -= sum(flip.step >= end for flip in flips)
        flips = [flip for flip in flips if flip.step < end]
    free = series["B"]
    splits = {name: split_of(series[name], tolerance) for name in series if name[0] in "AB"}
    first = flips[0].step if flips else None
    first_bit = int(bits.argmax()) if bits.any() else None
    cause = None
    if first is None and len(ended) == 1:
        # that one run can go on and the other cannot is a fork if anything is; the one that ended has no
        # state after it, so no bit can be the same
        first = len(free) - 1
        first_bit = first if first_bit is None else first_bit
        (name,) = ended
        cause = {"run": name, "word": failed[name], "step": first, "other": "AB"[name == "A"]}
    dates = Dates(first_bit, first, splits["B"])
    together = [flip for flip in flips if flip.step == first]
    decision = None
    if together:
        decision = twin.a.decision(twin.b, together, float(free[max(0, together[0].step - 1)]))
    rates = {name: growth(series[name], tolerance) for name in ("B", "B|A") if name in series}
    cells = table(series, tolerance)
    return Fork(
        twin, len(free) - 1, asked, tolerance, dates, decision, series, tuple(flips), total, doubts, rates,
        splits, cells, shares(cells, rates["B"].rate),
        judge(dates, free, series.get("B|A"), tolerance, (), most, ended=cause), ((), ()), (), failed,
        gathered[-1].runs,
    )  # fmt: skip


def _series(gathered: list[PairRows]) -> dict[str, np.ndarray]:
    def joined(column: str, name: str) -> np.ndarray:
        return np.concatenate([getattr(rows, column)[name] for rows in gathered])

    head = gathered[0]
    series = {"step": np.concatenate([np.arange(rows.first, rows.first + rows.rows) for rows in gathered])}
    series |= {name: joined("separation", name) for name in head.separation}
    series["cross"] = np.concatenate([rows.cross for rows in gathered])
    series |= {f"energy {name}": joined("energy", name) for name in head.energy}
    if "B|A" in head.overridden:
        series |= {name: joined(name, "B|A") for name in ("overridden", "furthest")}
    # of a run that has ended nobody knows the box
    for name in head.strain:
        series["strain" if name == "B" else f"strain {name}"] = np.concatenate(
            [rows.strain.get(name, np.full(rows.rows, np.nan)) for rows in gathered]
        )
    for name in head.nearest:
        series |= {f"{column} {name}": joined(column, name) for column in ("nearest", "bound", "ambiguous")}
    return series


# --- all choices side by side ---------------------------------------------------------------------------


@result
class Screened:
    """Effect of one numerical choice on a run."""

    choice: str  # its name
    difference: str  # one line; why it does not apply where it does not
    # first_bit, fork, split: dates, steps; None where they did not come
    first_bit: int | None
    fork: int | None
    split: int | None
    must_hold: bool  # whether it cannot change a bit by design
    reason_unavailable: str | None = None  # why it was not run; None where it was
    steps: int = 0  # last step that was compared; 0 where it was not run
    failed: str = ""  # "blow-up" or "runaway" by run, where one ended that way

    @property
    def held(self) -> bool | None:
        """True if both runs were identical to the last bit. None if there was no second run."""
        return None if self.reason_unavailable is not None else self.first_bit is None


def screen(
    system: Simulation | BallSystem,
    steps: int | None = None,
    choices: Sequence[Choice] | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    on: str | Executor | None = None,
    workers: int | None = None,
) -> list[Screened]:
    """Compare two runs for each numerical choice. List the earliest fork first.

    Args:
        system: a system that was loaded from a file.
        steps: last step of each run; default the system's own.
        choices: choices to test; default all built-in choices of the system's world.
        progress: called with the number of choices done, their total, and the name of the next choice.
        on, workers: where to compute, as for `mdnum.sweep`; by default in this process.

    Raises:
        InputError: no choice is given, or steps is below 1.
    """
    choices = list(shipped(world_of(system)).values()) if choices is None else choices
    if not choices:
        raise InputError("no numerical choice was given", remedy="Give a choice to vary, such as precision")
    rows: list[Screened] = []
    with engines.requested(on, workers) as engine:
        sent = system if engine is None else packed(system)
        found = engines.in_order(_screened, [(sent, choice, steps) for choice in choices], engine)
        for done, choice in enumerate(choices):
            if progress is not None:
                progress(done, len(choices), choice.name)
            rows.append(next(found))

    def rank(row: Screened) -> tuple[float, ...]:
        dates = (np.inf if date is None else date for date in (row.fork, row.first_bit, row.split))
        return row.reason_unavailable is not None, *dates

    return sorted(rows, key=rank)


def _screened(task: tuple[Any, Choice, int | None]) -> Screened:
    system, choice, steps = task
    twin = twin_or_reason(choice, unpacked(system)[0] if isinstance(system, bytes) else system)
    if isinstance(twin, str):
        return Screened(choice.name, twin, None, None, None, choice.must_hold, twin)
    found = fork(twin, steps, counterfactual=False, repeats=0)
    dates = found.dates
    failed = ", ".join(f"{word} of {name}" for name, word in found.failed.items())
    date = dates.first_bit, dates.fork, dates.split
    return Screened(choice.name, twin.difference, *date, choice.must_hold, None, found.steps, failed)
