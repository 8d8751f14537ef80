"""Two runs that differ in one choice: their dates, how fast they part, and what a flip had to do with it.

The verdict compares three separations from the first run: of the second run, and of the second run's
arithmetic under the first run's decisions. Only the latter can tell whether the flips did it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from mdnum.events.chance import Chance, scatter_of

Word = Literal["same", "no fork", "open", "cause", "hurried", "bystander"]

#: A slope is fitted to separations between these, as shares of the split tolerance: above rounding's plateau
#: at the start, below saturation at the end.
_FIT = (1e-12, 0.1)
#: Fewer rows than this give no growth rate.
_FIT_ROWS = 16
#: A split must have been followed for so many times its steps before "did not split" means anything.
_PATIENCE = 1.2
#: A counterfactual that grows and would split within so many times the free run's steps is late, not saved.
_SAVED = 5.0
#: A delay of less than one power of e is no delay: the separation was never as much as e times smaller.
NATS = 1.0
#: r² of a fit that counts as growth.
FITS = 0.5
#: Powers of e that the later half of a fit must grow by before it predicts anything. What the first steps do
#: is a power law: its later half grows by 0.7 powers of e for every power of the time.
_HALF = 3.0


@dataclass(frozen=True)
class Dates:
    """When two runs part; None where they do not within the horizon.

    Attributes:
        seed: first step whose state bits differ.
        fork: first step whose decisions differ.
        split: first step at which the separation passes the tolerance.
    """

    seed: int | None
    fork: int | None
    split: int | None


@dataclass(frozen=True)
class Growth:
    """Exponential growth of a separation, fitted to its logarithm.

    Attributes:
        rate: per step; NaN where too few rows could be fitted.
        r_squared: of the fit.
        first, last: steps between which it was fitted.
    """

    rate: float
    r_squared: float
    first: int
    last: int

    @property
    def plain(self) -> bool:
        """Whether something grows at all, rather than a line through noise."""
        return bool(np.isfinite(self.rate) and self.rate > 0 and self.r_squared > FITS)

    def steps_to(self, start: float, end: float) -> float | None:
        """Steps in which a separation grows from one size to another; None where it does not grow."""
        if not (np.isfinite(self.rate) and self.rate > 0 and start > 0):
            return None
        return max(0.0, float(np.log(end / start) / self.rate))


def split_of(separation: Float[np.ndarray, "steps"], tolerance: float) -> int | None:
    """The first step at which a separation passes the tolerance; None where it does not."""
    beyond = separation > tolerance
    return int(beyond.argmax()) if beyond.any() else None


def growth(separation: Float[np.ndarray, "steps"], tolerance: float) -> Growth:
    """The rate at which a separation grows before it saturates.

    The fit takes the rows up to the split whose separation lies between 1e-12 and a tenth of the tolerance,
    from the last time on that it was below the lower end. A slope through noise has a low r_squared.

    Args:
        separation: of each step, length; NaN where a run had ended.
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
    """Slope of a straight line and its r²."""
    slope, base = np.polyfit(x, y, 1)
    spread = float(np.sum((y - y.mean()) ** 2))
    return float(slope), 1.0 - float(np.sum((y - slope * x - base) ** 2)) / spread if spread > 0 else 0.0


def expected(
    separation: Float[np.ndarray, "steps"], tolerance: float, exponent: float | None = None
) -> float | None:
    """Steps after the last one at which runs that have not split are expected to; None where nothing tells.

    Their own growth predicts only where it outlasts the first steps: its later half must be several powers
    of e, at a rate within a factor of 2 of the whole.

    Args:
        separation: of each step, length; NaN where a run had ended.
        tolerance: of the split, length.
        exponent: the Lyapunov exponent per step, where it is known: it needs no fit.
    """
    seen = np.flatnonzero(np.isfinite(separation))
    if not len(seen) or not separation[seen[-1]] > 0:
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
    return max(0.0, float(np.log(tolerance / separation[seen[-1]])) / rate)


@dataclass(frozen=True)
class Verdict:
    """Whether the flips caused a split, hurried it, or only came along.

    Attributes:
        word: "same" (no bit differs), "no fork" (no decision differs), "open" (no split within the horizon,
            or nothing tells a delay from chance), "cause" (without the flips no split), "hurried" (without
            them later, beyond chance), "bystander" (the split came before any flip; or without them as
            early, no later than by chance, or by less than one power of e).
        free: split of the free run, step.
        handed: split of the run under the other's decisions, step; None where there is none.
        noise: by how many steps two splits differ by chance: twice the standard deviation of a difference; a
            lower bound where a repeat did not split. 0 where nothing is known of it.
        nats: growth rate times the steps gained: how many powers of e the flips were worth; infinite for a
            cause.
        reasons: the criteria, in words with their numbers.
    """

    word: Word
    free: int | None
    handed: int | None
    noise: float
    nats: float | None
    reasons: tuple[str, ...]


def judge(
    dates: Dates,
    free: Float[np.ndarray, "steps"],
    handed: Float[np.ndarray, "steps"] | None,
    tolerance: float,
    chance: Sequence[int | None] = (),
    *,
    ended: str | None = None,
) -> Verdict:
    """The verdict on a pair of runs.

    Args:
        dates: of the pair.
        free: separation of the two free runs at each step, length.
        handed: separation of the counterfactual from the first run, length; NaN after it was ended. None
            where there is no counterfactual.
        tolerance: of the split, length.
        chance: splits of repeats of the pair, the start perturbed by as much as the choice does, steps; None
            for one that did not split.
        ended: where the fork is that one run ended and the other did not: which and how, in words.
    """
    last = len(free) - 1
    if ended is not None:
        before = f"no decision differs in the {last} steps before"
        return Verdict("open", dates.split, None, 0.0, None, (f"{ended}: that is the fork; {before}",))
    if dates.seed is None:
        return Verdict("same", None, None, 0.0, None, (f"no bit differs in {last} steps",))
    if dates.fork is None:
        text = f"no decision differs in {last} steps; the separation reaches {np.nanmax(free):.2g}"
        reasons = (text,) if dates.split is not None else (text, *_outlook(free, tolerance))
        return Verdict("no fork", dates.split, None, 0.0, None, reasons)
    if dates.split is None:
        reasons = _outlook(free, tolerance)
        other = None if handed is None else split_of(handed, tolerance)
        if other is not None:
            reasons += (
                f"under the first run's decisions the runs do split, at step {other}: the decisions that "
                "differ keep them together",
            )
        return Verdict("open", None, other, 0.0, None, reasons)
    if dates.split < dates.fork:
        text = (
            f"the runs had split at step {dates.split}, before any decision differed (step {dates.fork}): no "
            "flip had a part in it"
        )
        return Verdict("bystander", dates.split, None, 0.0, None, (text,))
    if handed is None:
        text = f"split at step {dates.split}; without a counterfactual nothing is said about the cause"
        return Verdict("open", dates.split, None, 0.0, None, (text,))
    scatter = scatter_of(dates.split, chance, last)
    fit = growth(free, tolerance)
    rate = fit.rate if fit.plain else None
    other = split_of(handed, tolerance)
    if other is None:
        return _kept(dates.split, handed, tolerance, scatter, rate)
    gained = other - dates.split
    nats = None if rate is None else rate * gained
    text = (
        f"free, the runs split at step {dates.split}; under the first run's decisions at step {other}, "
        f"{abs(gained)} steps {'later' if gained >= 0 else 'earlier'}"
    )
    worth = f"the flips were worth {nats:.2g} powers of e of separation" if nats is not None else ""
    word, why = _delayed(gained, nats, scatter)
    reasons = tuple(part for part in (text, scatter.text, worth, why) if part)
    return Verdict(word, dates.split, other, scatter.noise, nats, reasons)


def _delayed(gained: float, nats: float | None, scatter: Chance) -> tuple[Word, str]:
    """The word for a split that comes so much later without the flips, and why."""
    if gained <= 0:
        return "bystander", "without the flips it comes no later"
    if scatter.known and gained <= scatter.noise:
        return "bystander", "no later than by chance"
    if nats is not None and nats < NATS:
        beyond = "beyond the scatter, but by" if scatter.known else "by"
        return "bystander", (
            f"later {beyond} less than one power of e of separation ({nats:.2g}), which counts as no "
            "difference"
        )
    if not scatter.known:
        return "open", f"no repeat tells whether {gained:.0f} steps later is chance"
    if scatter.least:
        return "open", f"{gained:.0f} steps later is more than that lower bound; it may still be chance"
    return "hurried", "later, beyond chance"


def _kept(
    free: int, handed: Float[np.ndarray, "steps"], tolerance: float, scatter: Chance, rate: float | None
) -> Verdict:
    """The verdict where the runs do not split under the first run's decisions."""
    some = np.isfinite(handed)
    seen = int(np.flatnonzero(some)[-1]) if some.any() else 0
    reach = float(np.nanmax(handed)) if some.any() else 0.0
    below = float(np.log(tolerance / reach)) if reach > 0 else float("inf")
    how = f"{below:.2g} powers of e below the tolerance" if reach > 0 else "the same bits"
    text = (
        f"free, the runs split at step {free}; under the first run's decisions they do not up to step "
        f"{seen}: the separation is {reach:.2g} at most, {how}"
    )
    noise = scatter.noise
    if seen < _PATIENCE * free:
        more = (
            f"only {seen - free} steps follow the split; run longer to tell a cause from a delay"
            if seen > free
            else "where it was ended"
        )
        return Verdict("open", free, None, noise, None, (text, scatter.text, more))
    late = _expected(handed, tolerance, seen)
    if late is not None and late < _SAVED * free:
        gained = late - free
        nats = None if rate is None else rate * gained
        more = f"it grows and is expected to split about step {late:.0f}: later, but not saved"
        word, why = _delayed(gained, nats, scatter)
        if word == "bystander":
            # it has not split yet: the expectation may be off
            word = "open"
        return Verdict(word, free, None, noise, nats, (text, scatter.text, more, why))
    if below < NATS:
        more = "which is within one power of e of it: no cause without a longer run"
        return Verdict("open", free, None, noise, None, (text, scatter.text, more))
    basis = (
        f"the word cause rests on that: no split within {seen / free:.2g} times the steps to the free one, "
        "and none on its way"
    )
    if scatter.noise > seen - free:
        # the free split may come that late by chance: then it is not the delay that tells
        basis += "; the scatter is wider than the steps followed since, so it is the size that tells"
    return Verdict("cause", free, None, noise, float("inf"), (text, scatter.text, basis))


def _outlook(free: Float[np.ndarray, "steps"], tolerance: float) -> tuple[str, ...]:
    """How the separation stands at the end of a horizon without a split, and what is to be expected."""
    seen = free[np.isfinite(free)]
    text = f"after {len(free) - 1} steps the separation is {seen[-1]:.2g}, the tolerance {tolerance:.2g}"
    more = expected(free, tolerance)
    if more is None:
        return text, "it does not grow plainly enough in so few steps to predict a split"
    rate = growth(free, tolerance).rate
    return text, f"growing at {rate:.2g} a step it would split about {more:.0f} steps later"


def _expected(separation: Float[np.ndarray, "steps"], tolerance: float, seen: int) -> float | None:
    """The step at which a counterfactual may split, if it grows at all; None where it does not.

    Looser than `expected` on purpose: what may be growing is no cause.
    """
    fit = growth(separation[: seen + 1], tolerance)
    now = float(separation[seen])
    if not (fit.plain and now > 0):
        return None
    return seen + float(np.log(tolerance / now)) / fit.rate
