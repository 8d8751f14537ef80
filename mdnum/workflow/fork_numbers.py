"""What the summary of any comparison says, whatever was run: dates, growth, the table of two by two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.events.chance import Delay
from mdnum.events.forks import Dates, Growth, Verdict, expected
from mdnum.events.shares import Cell, Share


def dates(found: Dates, timestep: float) -> dict[str, Any]:
    """Seed, fork and split with their times; None where they did not come."""
    when = {name: getattr(found, name) for name in ("seed", "fork", "split")}
    return {**when, **{f"{name}_time": None if at is None else at * timestep for name, at in when.items()}}


def verdict(found: Verdict) -> dict[str, Any]:
    """The verdict in plain values."""
    count = None
    if found.count is not None:
        count = {**vars(found.count), "threshold": found.threshold, "needed": found.count.needed}
    return {"verdict": found.word, "reasons": list(found.reasons), "nats": found.nats, "count": count}


def rate(fit: Growth, timestep: float) -> dict[str, Any]:
    """Growth of the free runs, per step and per unit of time."""
    return {
        "growth_rate": plain(fit.rate),
        "growth_rate_time": plain(fit.rate / timestep),
        "r_squared": plain(fit.r_squared),
    }


def fitted(fit: Growth, separation: Float[np.ndarray, "rows"]) -> dict[str, Any]:
    """The fit as a line: separation = exp(intercept + rate * step) between first and last."""
    if not np.isfinite(fit.rate):
        return {"rate": None, "r_squared": None, "first": None, "last": None, "intercept": None}
    step = np.arange(fit.first, fit.last + 1)
    values = separation[fit.first : fit.last + 1]
    usable = np.isfinite(values) & (values > 0)
    intercept = float(np.mean(np.log(values[usable]) - fit.rate * step[usable]))
    return {
        "rate": fit.rate,
        "r_squared": fit.r_squared,
        "first": fit.first,
        "last": fit.last,
        "intercept": intercept,
    }


def predicted(
    found: Dates,
    free: Float[np.ndarray, "rows"],
    tolerance: float,
    steps: int,
    exponent: float | None = None,
) -> dict[str, Any]:
    """The step at which runs that have not split are expected to, and what tells; None where nothing does.

    Their own growth does where it is plain, or else the exponent.

    Args:
        found: their dates.
        free: the separation by step.
        tolerance: of the split.
        steps: that were followed.
        exponent: the Lyapunov exponent per step, where it is known.
    """
    ways = {"growth": None} if exponent is None else {"growth": None, "exponent": exponent}
    for name, rate in ways.items() if found.split is None else ():
        more = expected(free, tolerance, rate)
        if more is not None:
            return {"predicted_split": round(steps + more), "predicted_by": name}
    return {"predicted_split": None, "predicted_by": None}


def repeats(delays: Sequence[Delay]) -> dict[str, Any]:
    """When each repeat splits, free and under A's decisions; None for one that was not seen."""
    return {"repeated": [{"free": one.free, "handed": one.handed} for one in delays]}


def cell(found: Cell) -> dict[str, Any]:
    """A run of the table of two by two: whose arithmetic and decisions, and when it splits from which run."""
    return {
        "arithmetic": found.arithmetic,
        "decisions": found.decisions,
        "from": found.reference,
        "same": found.same,
        "split": found.split,
        "until": found.until,
    }


def share(found: Share) -> dict[str, Any]:
    """What one difference is worth, in plain values."""
    return {
        "what": found.what,
        "reference": found.reference,
        "steps": found.steps,
        "at_least": found.at_least,
        "nats": None if found.nats is None else plain(found.nats),
    }


def until(series: Mapping[str, np.ndarray], name: str) -> int | None:
    """The last step of a counterfactual; None where there is none."""
    if name not in series:
        return None
    seen = np.flatnonzero(np.isfinite(series[name]))
    return int(series["step"][seen[-1]]) if len(seen) else None


def largest(series: Mapping[str, np.ndarray], name: str) -> float | None:
    """The largest value of a series; None where there is none."""
    values = series.get(name)
    return plain(float(np.nanmax(values))) if values is not None and np.isfinite(values).any() else None


def total(series: Mapping[str, np.ndarray], name: str) -> int | None:
    """The sum of a series; None where there is none."""
    values = series.get(name)
    return int(np.nansum(values)) if values is not None else None


def plain(value: float) -> float | None:
    """A number as JSON has it; None where it is not finite."""
    return float(value) if np.isfinite(value) else None
