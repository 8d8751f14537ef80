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
_NATS = 1.0
#: Of a fit that counts as growth.
_FITS = 0.5


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
    y = np.log(rows[at])
    slope, base = np.polyfit(at, y, 1)
    residual = y - (slope * at + base)
    spread = float(np.sum((y - y.mean()) ** 2))
    r_squared = 1.0 - float(np.sum(residual**2)) / spread if spread > 0 else 0.0
    return Growth(float(slope), r_squared, int(at[0]), int(at[-1]))


@dataclass(frozen=True)
class Verdict:
    """Whether the flips caused a split, hurried it, or only came along.

    Attributes:
        word: "same" (no bit differs), "no fork" (no decision differs), "open" (no split within the horizon),
            "cause" (without the flips no split), "hurried" (without them later, beyond chance), "bystander"
            (without them as early, no later than by chance, or by less than one power of e).
        free: split of the free run, step.
        handed: split of the run under the other's decisions, step; None where there is none.
        noise: by how many steps two splits differ by chance: twice the standard deviation of a difference.
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
    chance: Sequence[int] = (),
) -> Verdict:
    """The verdict on a pair of runs.

    Args:
        dates: of the pair.
        free: separation of the two free runs at each step, length.
        handed: separation of the counterfactual from the first run, length; NaN after it was ended. None
            where there is no counterfactual.
        tolerance: of the split, length.
        chance: splits of repeats of the pair, the start perturbed by as much as the choice does, steps.
    """
    last = len(free) - 1
    if dates.seed is None:
        return Verdict("same", None, None, 0.0, None, (f"no bit differs in {last} steps",))
    if dates.fork is None:
        reach = float(np.nanmax(free))
        text = f"no decision differs in {last} steps; the separation reaches {reach:.2g}"
        return Verdict("no fork", dates.split, None, 0.0, None, (text,))
    rate = growth(free, tolerance)
    if dates.split is None:
        now = float(free[np.isfinite(free)][-1])
        more = rate.steps_to(now, tolerance)
        text = f"after {last} steps the separation is {now:.2g}, the tolerance {tolerance:.2g}"
        guess = (
            f"growing at {rate.rate:.2g} a step it would split about {more:.0f} steps later" if more else ""
        )
        return Verdict("open", None, None, 0.0, None, tuple(part for part in (text, guess) if part))
    if handed is None:
        text = f"split at step {dates.split}; without a counterfactual nothing is said about the cause"
        return Verdict("open", dates.split, None, 0.0, None, (text,))
    # repeats may all be earlier than the pair, when they are perturbed by more: their own scatter counts
    sample = chance if len(chance) > 1 else [dates.split, *chance]
    # both dates scatter, the free one and the handed one
    noise = 2.0 * float(np.sqrt(2) * np.std(sample, ddof=1)) if chance else 0.0
    other = split_of(handed, tolerance)
    seen = int(np.flatnonzero(np.isfinite(handed))[-1]) if np.isfinite(handed).any() else 0
    if other is None:
        reach = float(np.nanmax(handed))
        text = (
            f"free, the runs split at step {dates.split}; under the first run's decisions the separation is "
            f"{reach:.2g} at most up to step {seen}"
        )
        if seen < _PATIENCE * dates.split:
            more = (
                f"only {seen - dates.split} steps follow the split; run longer to tell a cause from a delay"
                if seen > dates.split
                else "where it was ended"
            )
            return Verdict("open", dates.split, None, noise, None, (text, more))
        late = _expected(handed, tolerance, seen)
        if late is not None and late < _SAVED * dates.split:
            nats = rate.rate * (late - dates.split) if np.isfinite(rate.rate) else None
            more = f"it grows and is expected to split about step {late:.0f}: later, but not saved"
            return Verdict("hurried", dates.split, None, noise, nats, (text, more))
        return Verdict(
            "cause", dates.split, None, noise, float("inf"), (text, "and it is not on its way there")
        )
    gained = other - dates.split
    nats = rate.rate * gained if np.isfinite(rate.rate) else None
    text = (
        f"free, the runs split at step {dates.split}; under the first run's decisions at step {other}, "
        f"{abs(gained)} steps {'later' if gained >= 0 else 'earlier'}"
    )
    scatter = (
        f"repeats that differ by an ulp scatter by {noise:.0f} steps" if chance else "no repeats were run"
    )
    later = bool(chance) and gained > noise and (nats is None or nats >= _NATS)
    worth = f"the flips were worth {nats:.2g} powers of e of separation" if nats is not None else ""
    word: Word = "hurried" if later else "bystander"
    reasons = tuple(part for part in (text, scatter, worth) if part)
    return Verdict(word, dates.split, other, noise, nats, reasons)


def _expected(separation: Float[np.ndarray, "steps"], tolerance: float, seen: int) -> float | None:
    """The step at which a separation that has not split yet is expected to; None where it does not grow."""
    fit = growth(separation[: seen + 1], tolerance)
    now = float(separation[seen])
    if not (np.isfinite(fit.rate) and fit.rate > 0 and fit.r_squared > _FITS and now > 0):
        return None
    return seen + float(np.log(tolerance / now)) / fit.rate
