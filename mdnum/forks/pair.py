"""A pair of runs of either world, followed until they split: dates, the decision at the fork, the verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Shaped

from mdnum.errors import InputError, expect_at_least
from mdnum.forks.choices import Choice, shipped, twin_or_reason, world_of
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
from mdnum.systems import BallSystem

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

#: The split tolerance as a share of the longest cutoff, or of the largest start height. Flips that split a
#: crystal do so slowly, and its atoms have no room to be much further apart; docs/verdict-calibration.md has
#: the verdicts by tolerance.
SPLIT = 0.01
#: A run is followed for so many times the steps to its split, so that "did not split" means something.
_BEYOND = 2.0
#: A counterfactual ends when an imposed decision is so many tolerances from its threshold.
_GUARD = 3.0
#: Repeats are perturbed by what a choice does within so many steps, and by so many tolerances at most: a
#: choice that changes everything at once still leaves room. The other displacement is so many times smaller.
_SOON, _LARGEST, _DECADES = 100, 1e-3, 100.0
#: Cross-run flips that are kept; the counts cover all of them.
FLIPS_KEPT = 100_000


@result
class Fork:
    """Result of following a pair of runs.

    Attributes:
        twin: the pair.
        steps, asked: that were followed, and that were asked for.
        tolerance: of the split, length.
        dates: first differing bit, fork and split. decision: at the fork; None without one.
        series: columns of `PairRows` by step: "step"; separations from A "B", "B|A", "A|B from A", "B 1", ...
            (repeats, those at the other displacement last; NaN once all have split), from B "A|B" and
            "B|A from B"; "cross"; "overridden" and "furthest" of B|A; "energy A", ...; of molecular dynamics
            "nearest A", "bound A", "ambiguous A" and the same of B; where boxes can differ, the strain
            between A's and B's, "strain", and that of "strain B|A".
        flips, flips_total: cross-run flips, the first `FLIPS_KEPT`, and how many there are of all.
        doubts: ambiguous decisions of A and of B, the first `FLIPS_KEPT` of each.
        growth: of the separations "B" and "B|A".
        splits: first step beyond the tolerance by separation; None where there is none.
        table: splits of either arithmetic under either decisions.
        shares: what the decisions and what the arithmetic contributed to the split.
        verdict: on the flips. repeats: when each repeat splits, free and under A's decisions, at the first
            displacement and at the other one. displacements: of the starts of those that were run, length.
        failed: runs that ended in "blow-up" or "runaway". Where a free run does, the comparison ends with it;
            where only one of them does, that is the fork at the latest.
        runs: A, B and the counterfactuals by name, of a world that keeps them whole.
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
    """Follow two runs until they have split, and judge what the flips had to do with it.

    Args:
        twin: the pair.
        steps: last step; default the system's own. Molecular dynamics is followed to twice the split at most;
            a fifth further where the split comes too late to tell a cause from a delay.
        split: separation that counts as split, length; default 0.01 of the longest cutoff or start height.
        counterfactual: whether to run B under A's decisions; many-body potentials cannot.
        back: whether to run A under B's decisions too; default where B is run under A's.
        repeats: runs of B at most whose start is displaced at random by as much as the choice separates the
            runs at first (an ulp at least), each free and under A's decisions; default 15. They are run where
            the runs split either way, until the verdict is clear, and then at a hundredth of it.
        progress: called with the step reached, the last step, and figures.

    Raises:
        InputError: steps below 1, programs that cannot be compared, or counterfactuals that are not run.
    """
    a, b = twin.a, twin.b
    counterfactual, back, most = counterfactuals(twin, counterfactual, back, repeats)
    a.check(b)
    asked = a.steps if steps is None else steps
    expect_at_least(1, steps=asked)
    tolerance = SPLIT * a.scale if split is None else split
    if not 0 < tolerance < np.inf:
        raise InputError(f"split = {tolerance:g}; expected a length above 0")
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
    """Whether to run B under A's decisions, A under B's, and how many repeats at most.

    Raises:
        InputError: one was asked for that would not be run.
    """
    reason = twin.a.imposable or twin.b.imposable
    runs = counterfactual and reason is None
    most = repeats_asked(repeats, runs, reason or "those are left out")
    if back and not runs:
        raise InputError(
            f"A cannot be run with B's decisions, because B is not run with A's: "
            f"{reason or 'those are left out'}",
            remedy="Omit the option back",
        )
    return runs, runs if back is None else back, most


def repeats_asked(repeats: int | None, counterfactual: bool, why: str = "those are left out") -> int:
    """Repeats at most: those asked for, or the default where there are runs under imposed decisions.

    Raises:
        InputError: below 0, too few to tell anything, or asked for where they would not be run.
    """
    if repeats is None:
        return REPEATS if counterfactual else 0
    if repeats < 0 or 0 < repeats < FEWEST:
        raise InputError(
            f"repeats = {repeats}; expected 0 or at least {FEWEST}",
            remedy="Fewer repeats cannot give a significant result" if repeats > 0 else None,
        )
    if repeats and not counterfactual:
        raise InputError(
            f"repeats = {repeats}, but B is not run with A's decisions, so there is nothing to repeat: {why}",
            remedy="Omit the repeats, or set repeats = 0",
        )
    return repeats


def _beyond(step: int) -> int:
    """The step up to which a split must be followed to mean something."""
    return int(np.ceil(PATIENCE * step)) + 1


def displacements(fork: Fork) -> tuple[float, float]:
    """Displacements of the starts of repeats, length: as the choice separates the runs at first, and less.

    At a hundredth a repeat begins to have the pair's rounding errors; at much less it is the pair itself and
    proves nothing. Where a hundredth is less than an ulp, the other one may be larger instead.
    """
    begins = (fork.dates.fork if fork.dates.first_bit is None else fork.dates.first_bit) or 0
    soon = fork.series["B"][begins : min(max(begins, 1) + _SOON, fork.dates.fork or fork.steps + 1)]
    ulp, largest = fork.twin.b.ulp, _LARGEST * fork.tolerance
    first = max(ulp, min(float(np.nanmax(soon, initial=0.0)), largest))
    less, more = max(ulp, first / _DECADES), max(first, min(first * _DECADES, largest))
    return first, less if first / less > 0.5 * more / first else more


def _repeated(found: Fork, most: int, progress: Progress | None) -> Fork:
    """The same with as many repeats as its verdict wants."""
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
    """Effect of one choice within the horizon."""

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
        """Whether no bit differed within the horizon; None where it was not run."""
        return None if self.reason_unavailable is not None else self.first_bit is None


def screen(
    system: Simulation | BallSystem,
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
        raise InputError("no choice to screen was given", remedy="Give at least one")
    rows: list[Screened] = []
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
        date = dates.first_bit, dates.fork, dates.split
        rows.append(
            Screened(choice.name, twin.difference, *date, choice.must_hold, None, found.steps, failed)
        )

    def rank(row: Screened) -> tuple[float, ...]:
        dates = (np.inf if date is None else date for date in (row.fork, row.first_bit, row.split))
        return row.reason_unavailable is not None, *dates

    return sorted(rows, key=rank)
