"""Verdicts on two runs: when they diverge, how fast, and whether flips are the cause.

A flip is a cutoff decision that differs between two runs. The verdict compares the second run with a
counterfactual run. The counterfactual run has the arithmetic of run B, but the cutoff decisions of run A. If
the counterfactual run stays close to run A, the flips caused the split. Otherwise repeats of both runs show
whether the flips made the split occur earlier. Repeats are evaluated by a sequential sign test. Assume that
removing the flips delays a split with a probability of at most 1/2. Then k or more of n splits are delayed at
most as often as n coin tosses give k or more heads. The initial displacements of all repeats have the same
size. If most repeats with displacements of another size disagree, there is no verdict. Error rates are listed
in docs/verdict-calibration.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import comb
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Shaped

#: Default for the largest number of repeats.
REPEATS = 15
#: Number of pairs that are added before the next analysis.
LOOK = 5
#: Largest probability of a false verdict if each pair is delayed with probability one half.
ERROR = 0.05
#: Number of repeats at the other displacement that suffice if all agree with the verdict.
_ALIKE = 4


@dataclass(frozen=True)
class Delay:
    """The steps at which two runs split, without and with run A's decisions imposed on run B."""

    # free, imposed: steps of the two splits; None for one that was not seen
    free: int | None
    imposed: int | None
    # free_until, imposed_until: last steps at which the separations are known
    free_until: int
    imposed_until: int

    @classmethod
    def of(cls, free: Float[np.ndarray, "steps"], imposed: Float[np.ndarray, "steps"], tolerance: float):
        """Create a `Delay` from the distance between two runs at each step."""
        splits = (split_of(run, tolerance) for run in (free, imposed))
        return cls(*splits, free_until=_last_seen(free), imposed_until=_last_seen(imposed))

    def beyond(self, steps: float) -> bool | None:
        """Return whether the split is more than `steps` steps later without the flips. None if unknown."""
        if self.free is not None and self.imposed is not None:
            return self.imposed - self.free > steps
        if self.free is not None:
            return True if self.imposed_until + 1 - self.free > steps else None
        if self.imposed is not None:
            return False if self.imposed - self.free_until - 1 <= steps else None
        return None


@cache
def looks(pairs: int, error: float = ERROR) -> tuple[tuple[int, int], ...]:
    """Return the number of pairs of runs at each stage of the sign test, and how many must agree.

    The allowed error probability is used up in proportion to the number of pairs (Lan and DeMets, Biometrika
    70, 659, 1983). Up to each stage, the probability that fair coin tosses give a result is limited. The
    limit is the error probability times the fraction of pairs used so far.

    Args:
        pairs: largest number of pairs of runs.
        error: probability of either verdict if each pair is as likely delayed as not.
    """
    ends = [*range(1 + LOOK, pairs, LOOK), pairs]
    going, before, spent, found = {0: 1.0}, 0, 0.0, []
    for end in ends:
        more = end - before
        reached: dict[int, float] = {}
        for heads, chance in going.items():
            for new in range(more + 1):
                at = heads + new
                reached[at] = reached.get(at, 0.0) + chance * comb(more, new) / 2.0**more
        need, above = end + 1, 0.0
        while 2 * (need - 1) > end and spent + above + reached.get(need - 1, 0.0) <= error * end / pairs:
            need -= 1
            above += reached.get(need, 0.0)
        spent += above
        if need <= end:
            found.append((end, need))
        # both sides stop
        going = {heads: chance for heads, chance in reached.items() if end - need < heads < need}
        before = end
    return tuple(found)


#: Smallest number of repeats for which a result can be clear.
FEWEST = next(pairs for pairs in range(1, 2 + REPEATS) if looks(pairs)) - 1


@dataclass(frozen=True)
class Count:
    """Numbers of pairs of runs that split later, or not later, without flips."""

    pairs: int  # that were run, the pair itself among them
    later: int  # that were delayed by more than asked for
    not_later: int  # that were not; of the others it was not seen
    most: int  # pairs at most

    @property
    def needed(self) -> tuple[int, int] | None:
        """Current or next stage of the sign test: number of pairs of runs, and how many must agree."""
        return next((look for look in looks(self.most) if look[0] >= self.pairs), None)

    @property
    def delayed(self) -> bool | None:
        """Whether most pairs of runs split later without flips. None if the sign test has no result."""
        need = dict(looks(self.most)).get(self.pairs)
        if need is None:
            return None
        return True if self.later >= need else False if self.not_later >= need else None

    @property
    def majority(self) -> bool | None:
        """Whether most pairs of runs split later without flips. None if more pairs are needed."""
        if self.later > self.most / 2 or self.later == self.pairs >= _ALIKE:
            return True
        return False if self.not_later > self.most / 2 or self.not_later == self.pairs >= _ALIKE else None

    @property
    def wanted_for_majority(self) -> int:
        """Smallest number of further pairs of runs that can decide the majority."""
        if self.pairs < _ALIKE:
            return _ALIKE - self.pairs
        more = self.most // 2 + 1 - max(self.later, self.not_later)
        return 0 if self.majority is not None else min(more, self.most - self.pairs)

    @property
    def wanted(self) -> int:
        """Number of pairs of runs to simulate before the next stage. 0 if the test has ended."""
        if self.delayed is not None:
            return 0
        return next((end - self.pairs for end, _ in looks(self.most) if end > self.pairs), 0)


def count(delays: tuple[Delay, ...], steps: float, most: int) -> Count:
    """Count the pairs of runs that split more than `steps` steps later without flips.

    Args:
        delays: delays of the pair itself and of its repeats.
        steps: delay (number of steps) above which a pair counts as delayed.
        most: largest number of pairs of runs.
    """
    found = [delay.beyond(steps) for delay in delays]
    return Count(len(found), found.count(True), found.count(False), most)


# --- dates, growth and verdict of a pair ----------------------------------------------------------------

#: Code of a sentence, and its values.
Reason = tuple[str, dict[str, Any]]
Word = Literal["same", "no fork", "open", "cause", "accelerated", "bystander", "undecided"]

#: Share of the rows that are omitted before a growth rate is fitted, and number of blocks from which its
#: error is estimated; the rate must exceed this multiple of its error.
TRANSIENT, BLOCKS, _SIGNIFICANT = 0.2, 8, 4.0
#: Range of separations to which a slope is fitted, as shares of the split tolerance: above the initial
#: plateau caused by rounding and below saturation.
_FIT = (1e-12, 0.1)
#: Smallest number of rows for a growth rate.
_FIT_ROWS = 16
#: Factor on the step of the split up to which a counterfactual must be known before "did not split" is a
#: result.
PATIENCE = 1.2
#: If the growth of a counterfactual predicts a split within this multiple of the steps of the free run, the
#: split is only delayed.
_SAVED = 5.0
#: Smallest delay, in e-foldings: with a shorter delay the separation was never smaller by a factor e.
E_FOLDINGS = 1.0
#: Smallest r² of a fit that counts as growth.
FITS = 0.5
#: Smallest growth in e-foldings over the later half of a fit from which a split is predicted. The initial
#: growth is a power law, whose later half grows by 0.7 e-foldings for every e-folding of the time.
_HALF = 3.0


@dataclass(frozen=True)
class Dates:
    """The first steps at which two runs differ in bits, differ in decisions, and split."""

    first_bit: int | None  # first step whose state bits differ
    fork: int | None  # first step whose decisions differ
    split: int | None  # first step at which the separation passes the tolerance


@dataclass(frozen=True)
class Growth:
    """Exponential growth of the distance between two runs, from a fit to its logarithm."""

    rate: float  # per step; NaN where too few rows could be fitted
    r_squared: float  # of the fit
    # first, last: steps between which it was fitted
    first: int
    last: int

    @property
    def plain(self) -> bool:
        """True if the distance clearly grows. Otherwise the growth rate is a fit of noise."""
        return bool(np.isfinite(self.rate) and self.rate > 0 and self.r_squared > FITS)


def growth_rate(log: Float[np.ndarray, "rows"]) -> tuple[float, float, bool]:
    """Return the growth rate, its standard error, and whether growth is faster than linear.

    The rate is the slope of the quantity's logarithm in the later rows. The error is estimated from blocks of
    rows. The result is NaN, NaN, False if there are too few rows, or if numbers are not finite.
    """
    rows = np.flatnonzero(np.isfinite(log))
    if not len(rows) or len(log) < 10 * BLOCKS:
        return float("nan"), float("nan"), False
    first = max(int(TRANSIENT * (len(log) - 1)), int(rows[0]))
    if len(log) - first < 4 * BLOCKS or not np.isfinite(log[first:]).all():
        return float("nan"), float("nan"), False
    edges = np.linspace(first, len(log) - 1, BLOCKS + 1).astype(int)
    slopes = np.diff(log[edges]) / np.diff(edges)
    rate = float((log[-1] - log[first]) / (len(log) - 1 - first))
    error = float(slopes.std(ddof=1) / np.sqrt(BLOCKS))
    # what grows in proportion to the steps gains log(end / first) over this stretch
    linear = float(np.log((len(log) - 1) / max(first, 1))) / (len(log) - 1 - first)
    return rate, error, bool(rate > 2 * linear and rate > _SIGNIFICANT * error)


def split_of(separation: Float[np.ndarray, "steps"], tolerance: float) -> int | None:
    """Return the first step at which the distance exceeds the tolerance, or None."""
    beyond = separation > tolerance
    return int(beyond.argmax()) if beyond.any() else None


def _last_seen(separation: Float[np.ndarray, "steps"]) -> int:
    """Return the last step at which the distance between two runs is known, or -1."""
    seen = np.flatnonzero(np.isfinite(separation))
    return int(seen[-1]) if len(seen) else -1


def growth(separation: Float[np.ndarray, "steps"], tolerance: float) -> Growth:
    """Fit the exponential growth rate of the distance between two runs.

    The fit uses steps before the split with distances between 1e-12 and 0.1 times the tolerance. Steps up to
    the last distance below 1e-12 times the tolerance are omitted. A low r_squared of the fit indicates noise.

    Args:
        separation: of each step, length; NaN after a run ended.
        tolerance: of the split, length.
    """
    end = split_of(separation, tolerance)
    rows = separation[: len(separation) if end is None else end]
    with np.errstate(invalid="ignore"):
        fit = (rows > _FIT[0] * tolerance) & (rows < _FIT[1] * tolerance)
        low = np.flatnonzero(rows <= _FIT[0] * tolerance)
    fit[: low[-1] + 1 if len(low) else 0] = False
    at = np.flatnonzero(fit)
    if len(at) < _FIT_ROWS:
        return Growth(float("nan"), float("nan"), -1, -1)
    rate, r_squared = _line(at, np.log(rows[at]))
    return Growth(rate, r_squared, int(at[0]), int(at[-1]))


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return the slope and r² of a line fitted to points."""
    slope, base = np.polyfit(x, y, 1)
    spread = float(np.sum((y - y.mean()) ** 2))
    return float(slope), 1.0 - float(np.sum((y - slope * x - base) ** 2)) / spread if spread > 0 else 0.0


def expected(
    separation: Float[np.ndarray, "steps"], tolerance: float, exponent: float | None = None
) -> float | None:
    """Predict the number of further steps until two runs split. None if this is impossible.

    A prediction requires continued exponential growth. In the later half of the fitted steps, the distance
    must grow by several e-foldings. The rate must be within a factor of 2 of the overall rate.

    Args:
        separation: of each step, length; NaN after a run ended.
        tolerance: of the split, length.
        exponent: the Lyapunov exponent per step, if known; nothing is then fitted.
    """
    seen = _last_seen(separation)
    if seen < 0 or not separation[seen] > 0:
        return None
    rate = exponent
    if rate is None:
        fit = growth(separation, tolerance)
        if not fit.plain:
            return None
        at = np.arange((fit.first + fit.last) // 2, fit.last + 1)
        at = at[np.isfinite(separation[at]) & (separation[at] > 0)]
        late, _ = _line(at, np.log(separation[at]))
        if late * (at[-1] - at[0]) < _HALF or not 0.5 < late / fit.rate < 2.0:
            return None
        rate = fit.rate
    if not rate > 0:
        return None
    return max(0.0, float(np.log(tolerance / separation[seen])) / rate)


@dataclass(frozen=True)
class ForkVerdict:
    """Verdict on whether flips caused the split of two runs."""

    # "same" (no bit differs), "no fork" (no decision differs), "open" (no split within the horizon, or no
    # counterfactual that was followed far enough), "cause" (without the flips no split), "accelerated" (most
    # pairs such as this split later without them, by more than one e-folding of the separation), "bystander"
    # (the split came before any flip, or most pairs do not split later by that much), "undecided" (the
    # repeats that were allowed do not tell the two apart, or most do otherwise at the other displacement)
    word: Word
    free: int | None  # split of the free run, step
    imposed: int | None  # split of the run under the other's decisions, step; None where there is none
    # growth rate times the steps gained: how many e-foldings the flips of this pair were worth; infinite for
    # a cause
    e_foldings: float | None
    reasons: tuple[Reason, ...]  # the criteria: codes, each with its numbers
    # delay that counts as later, steps: one e-folding, 0 where the separation grows otherwise; None where no
    # pairs were counted
    threshold: float | None = None
    # of the pair and its repeats, those that split later; None where none were counted
    count: Count | None = None
    # of repeats at the other displacement, without the pair; None where the first count is not clear
    other: Count | None = None

    @property
    def wanted(self) -> int:
        """Number of repeats to run before the next stage of the test."""
        if self.other is not None:
            return self.other.wanted_for_majority
        return self.count.wanted if self.count is not None else 0


def judge(
    dates: Dates,
    free: Float[np.ndarray, "steps"],
    imposed: Float[np.ndarray, "steps"] | None,
    tolerance: float,
    repeats: Sequence[Delay] = (),
    most: int = REPEATS,
    *,
    other: Sequence[Delay] = (),
    ended: Mapping[str, Any] | None = None,
) -> ForkVerdict:
    """Return the verdict on whether flips caused the split of two runs or made the split earlier.

    Args:
        dates: steps at which the pair of runs diverges.
        free: separation of the two free runs at each step, length.
        imposed: separation of the counterfactual run from the first run, length; NaN after a run has ended;
            None without a counterfactual run.
        tolerance: of the split, length.
        repeats: delays of repeats, whose starts are displaced by as much as the setting displaces the pair.
        most: largest number of repeats; one more at the other displacement, where the pair is not counted.
        other: delays of repeats whose starts are displaced by another distance.
        ended: values that describe how one run ended early, if the fork is that only one run ended.
    """
    last = len(free) - 1
    if ended is not None:
        return ForkVerdict("open", dates.split, None, None, (("ended", {**ended, "steps": last}),))
    if dates.first_bit is None:
        return ForkVerdict("same", None, None, None, (("same", {"steps": last}),))
    if dates.fork is None:
        reasons: tuple[Reason, ...] = (("no_fork", {"steps": last, "separation": float(np.nanmax(free))}),)
        reasons += () if dates.split is not None else _outlook(free, tolerance)
        return ForkVerdict("no fork", dates.split, None, None, reasons)
    if dates.split is None:
        own = None if imposed is None else split_of(imposed, tolerance)
        kept = () if own is None else (("together", {"step": own}),)
        return ForkVerdict("open", None, own, None, (*_outlook(free, tolerance), *kept))
    if dates.split < dates.fork:
        had: Reason = ("had_split", {"split": dates.split, "fork": dates.fork})
        return ForkVerdict("bystander", dates.split, None, None, (had,))
    if imposed is None:
        return ForkVerdict("open", dates.split, None, None, (("not_run", {"split": dates.split}),))
    delay = Delay.of(free, imposed, tolerance)
    fit = growth(free, tolerance)
    rate = fit.rate if fit.plain else None
    if delay.imposed is None:
        return _kept(dates.split, imposed, tolerance, ((delay, *repeats), tuple(other)), most, rate)
    gained = delay.imposed - dates.split
    values = {"split": dates.split, "imposed": delay.imposed, "steps": abs(gained)}
    reason: Reason = ("later" if gained >= 0 else "earlier", values)
    return _counted(((delay, *repeats), tuple(other)), most, rate, gained, (reason,))


def _counted(
    delays: Sequence[tuple[Delay, ...]],
    most: int,
    rate: float | None,
    gained: float,
    reasons: tuple[Reason, ...],
) -> ForkVerdict:
    """Return the verdict on runs that split despite imposed decisions.

    Repeats with displacements of another size can only withdraw a verdict.
    """
    pair = delays[0][0]
    threshold = 0.0 if rate is None else E_FOLDINGS / rate
    e_foldings = None if rate is None else rate * gained
    if e_foldings is not None:
        reasons += (("worth", {"e_foldings": e_foldings}),)
    found, other = count(delays[0], threshold, 1 + most), None
    counted = {**vars(found), "repeats": found.pairs - 1, "threshold": threshold}
    reasons += (("counted_any" if rate is None else "counted", counted),)
    if found.delayed is not None:
        other = count(delays[1], threshold, 1 + most)
        reasons += (("other", dict(vars(other))),) if other.pairs else ()
    if unseen := sum(one.pairs - one.later - one.not_later for one in (found, other) if one is not None):
        reasons += (("unseen", {"pairs": unseen}),)
    word: Word = "undecided"
    if other is None and found.needed is not None:
        reasons += (("not_clear", {"need": found.needed[1], "of": found.needed[0]}),)
    elif other is None:
        reasons += (("too_few", {"needed": FEWEST}),)
    elif other.majority == found.delayed:
        word = "accelerated" if found.delayed else "bystander"
    elif not other.wanted_for_majority:
        reasons += (("disagree", {}),)
    return ForkVerdict(word, pair.free, pair.imposed, e_foldings, reasons, threshold, found, other)


def _kept(
    free: int,
    imposed: Float[np.ndarray, "steps"],
    tolerance: float,
    delays: Sequence[tuple[Delay, ...]],
    most: int,
    rate: float | None,
) -> ForkVerdict:
    """Return the verdict on runs that do not split if run B gets run A's decisions."""
    seen = max(0, _last_seen(imposed))
    reach = float(np.nanmax(imposed, initial=0.0))
    below = float(np.log(tolerance / reach)) if reach > 0 else float("inf")
    values = {"split": free, "until": seen, "reach": reach, "below": below}
    kept: Reason = ("kept" if reach > 0 else "kept_bits", values)
    if seen < PATIENCE * free:
        short: Reason = ("short", {"steps": seen - free}) if seen > free else ("cut_off", {})
        return ForkVerdict("open", free, None, None, (kept, short))
    late = _expected(imposed, tolerance, seen)
    if late is not None and late < _SAVED * free:
        return _counted(delays, most, rate, late - free, (kept, ("late", {"step": round(late)})))
    if below < E_FOLDINGS:
        return ForkVerdict("open", free, None, None, (kept, ("within", {})))
    return ForkVerdict("cause", free, None, float("inf"), (kept, ("rests", {"ratio": seen / free})))


def _outlook(free: Float[np.ndarray, "steps"], tolerance: float) -> tuple[Reason, ...]:
    """Return reasons for the verdict on runs that did not split."""
    seen = float(free[np.isfinite(free)][-1])
    now: Reason = ("outlook", {"steps": len(free) - 1, "separation": seen, "tolerance": tolerance})
    more = expected(free, tolerance)
    if more is None:
        return now, ("no_growth", {})
    return now, ("growing", {"rate": growth(free, tolerance).rate, "steps": round(more)})


def _expected(separation: Float[np.ndarray, "steps"], tolerance: float, seen: int) -> float | None:
    """Predict when a counterfactual run splits from run A. None if the distance does not grow."""
    fit = growth(separation[: seen + 1], tolerance)
    now = float(separation[seen])
    if not (fit.plain and now > 0):
        return None
    return seen + float(np.log(tolerance / now)) / fit.rate


# --- what a split owes to the decisions and what to the arithmetic --------------------------------------
#
# Beside the free runs there are two mixed ones: B's arithmetic under A's decisions and A's under B's. Each
# shares one thing with either free run, so its split from that run says what the other thing is worth.

Name = Literal["A", "B"]
What = Literal["decisions", "arithmetic"]

_RUNS: tuple[tuple[Name, Name], ...] = (("A", "A"), ("B", "B"), ("B", "A"), ("A", "B"))
#: Series of separations, by arithmetic, decisions and reference run.
SERIES: Mapping[tuple[Name, Name, Name], str] = {
    ("B", "A", "A"): "B|A",
    ("B", "A", "B"): "B|A from B",
    ("A", "B", "A"): "A|B from A",
    ("A", "B", "B"): "A|B",
}


@dataclass(frozen=True)
class SplitCell:
    """The step at which one run splits from a reference run."""

    # arithmetic, decisions: whose they are in the run
    arithmetic: Name
    decisions: Name
    reference: Name  # the free run that it is compared with
    split: int | None  # step; None where it does not split
    until: int  # the last step at which it was compared

    @property
    def same(self) -> bool:
        """Whether the run and the reference run are the same."""
        return self.arithmetic == self.decisions == self.reference


@dataclass(frozen=True)
class Share:
    """Number of steps by which different decisions, or arithmetic, make the split earlier."""

    what: What  # the difference that is taken away; the other one stays
    reference: Name  # the run that is compared with
    steps: int  # by which the split comes later; below 0 where it comes earlier
    at_least: bool  # whether the split had not come when it was followed no longer
    e_foldings: float | None  # growth rate times steps: e-foldings of the separation; None without a rate


def table(series: Mapping[str, Shaped[np.ndarray, "steps"]], tolerance: float) -> tuple[SplitCell, ...]:
    """Return when each run with arithmetic and decisions of A or B splits from A, and from B.

    Args:
        series: separations at each step, length, by the names "B" and those in SERIES; NaN after a run ended.
        tolerance: of the split, length.
    """
    names: tuple[Name, ...] = ("A", "B")
    cells = []
    for reference in names:
        for arithmetic, decisions in _RUNS:
            last = len(series["B"]) - 1
            if arithmetic == decisions == reference:
                cells.append(SplitCell(arithmetic, decisions, reference, None, last))
                continue
            name = "B" if arithmetic == decisions else SERIES[arithmetic, decisions, reference]
            if name not in series:
                continue
            until = _last_seen(series[name])
            if until >= 0:
                split = split_of(series[name], tolerance)
                cells.append(SplitCell(arithmetic, decisions, reference, split, until))
    return tuple(cells)


def shares(cells: tuple[SplitCell, ...], rate: float) -> tuple[Share, ...]:
    """Return by how many steps different decisions, or arithmetic, make the split earlier.

    Args:
        cells: result of `table`.
        rate: growth rate of the free runs' separation, per step; NaN if unknown.
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
        e_foldings = rate * steps if np.isfinite(rate) else None
        found.append(Share(what, cell.reference, steps, cell.split is None, e_foldings))
    return tuple(sorted(found, key=lambda share: (share.what == "arithmetic", share.reference)))
