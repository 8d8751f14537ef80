"""What a fork folder holds: its tables, and summary.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mdnum.forks.certified import certified
from mdnum.forks.pair import FLIPS_KEPT, Fork
from mdnum.forks.replays import Neighborhood, Pinned
from mdnum.rollout.flips import Ambiguous
from mdnum.store import RunFolder
from mdnum.systems.build import Simulation
from mdnum.workflow import fork_numbers as numbers

#: Columns of separation.parquet by the series that they hold.
_SERIES = {
    "free": "B", "handed": "B|A", "back": "A|B", "cross": "cross", "overridden": "overridden",
    "furthest": "furthest", "energy_a": "energy A", "energy_b": "energy B", "energy_handed": "energy B|A",
    "energy_back": "energy A|B",
    "handed_from_b": "B|A from B", "back_from_a": "A|B from A", "nearest_a": "nearest A",
    "nearest_b": "nearest B", "ambiguous_a": "ambiguous A", "ambiguous_b": "ambiguous B",
}  # fmt: skip


def write(folder: RunFolder, fork: Fork, around: Neighborhood | None, pinned: Pinned | None = None) -> None:
    """Puts series, cross-run flips, ambiguous decisions and the atoms at the fork into a folder's tables."""
    series = fork.series
    rows = len(series["step"])
    columns = {name: series.get(key, np.full(rows, np.nan)) for name, key in _SERIES.items()}
    columns |= {"step": series["step"], "time": series["step"] * fork.twin.a.timestep}
    columns |= {f"repeat_{name[2:]}": series[name] for name in series if name.startswith("B ")}
    if pinned is not None:
        columns["pinned"] = pinned.separation
    folder.append("separation", columns)
    if fork.flips:
        names = ("step", "i", "j", "differs", "run", "entered", "margin", "bound")
        folder.append(
            "cross_flips", {name: np.array([getattr(flip, name) for flip in fork.flips]) for name in names}
        )
    for name, doubts in fork.doubts.items():
        if len(doubts.step):
            run = np.full(len(doubts.step), name)
            folder.append("ambiguous_pairs", {"run": run, **doubts._asdict()})
    if around is not None:
        vectors = {name: around.positions[:, k] for k, name in enumerate("xyz")}
        vectors |= {f"d{name}": around.moved[:, k] for k, name in enumerate("xyz")}
        folder.append("neighborhood", {"atom": around.atoms, **vectors})


def summarize(
    fork: Fork,
    around: Neighborhood | None,
    vary: str,
    choice: Any,
    seconds: float,
    answers: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The content of summary.json, without headline and findings; with further answers, where there are."""
    found = (answers or {}).get("lyapunov")
    exponent = found["rate"] if found and found["chaotic"] else None
    a = fork.twin.a.simulation
    step = fork.twin.a.timestep
    rate, free = fork.growth["B"], fork.series["B"]
    return {
        "world": "fork",
        "system": a.system.name,
        "about": a.system.spec.about,
        "choice": vary,
        "choice_about": getattr(choice, "about", ""),
        "must_hold": bool(getattr(choice, "must_hold", False)),
        "difference": fork.twin.difference,
        "changes": {key: list(values) for key, values in fork.twin.changes.items()},
        "atoms": a.atoms,
        "steps": fork.steps,
        "steps_asked": fork.asked,
        "timestep": step,
        "units": a.units.name,
        "r_cut": a.r_cut,
        **numbers.dates(fork.dates, step),
        "tolerance": fork.tolerance,
        "decision": _decision(fork, around),
        **numbers.verdict(fork.verdict),
        **numbers.rate(rate, step),
        "growth": {name: numbers.fitted(fit, fork.series[name]) for name, fit in fork.growth.items()},
        **numbers.predicted(fork.dates, free, fork.tolerance, fork.steps, exponent),
        "splits": {name: fork.splits.get(name) for name in ("B", "B|A", "A|B") if name in fork.splits},
        **numbers.repeats(fork.repeats),
        "handed_until": numbers.until(fork.series, "B|A"),
        "handed_largest": numbers.largest(fork.series, "B|A"),
        "separation_end": numbers.plain(free[np.isfinite(free)][-1]) if np.isfinite(free).any() else None,
        "separation_largest": numbers.largest(fork.series, "B"),
        "overridden": numbers.total(fork.series, "overridden"),
        "cross_flips": fork.flips_total,
        "cross_flips_kept": min(fork.flips_total, FLIPS_KEPT),
        "table": [numbers.cell(cell) for cell in fork.table],
        "shares": [numbers.share(share) for share in fork.shares],
        **_certified(fork),
        "failed": {name: word for name, word in fork.failed.items() if name in ("A", "B")},
        "failed_told": {name: word for name, word in fork.failed.items() if name not in ("A", "B")},
        "findings": [],
        "status": "failed" if fork.failed.keys() & {"A", "B"} else "complete",
        "seconds": seconds,
        **(answers or {}),
    }


def _decision(fork: Fork, around: Neighborhood | None) -> dict[str, Any] | None:
    made = fork.decision
    if made is None:
        return None
    a, b = fork.twin.a.simulation, fork.twin.b.simulation
    run = b if made.run == "B" else a
    i, j = made.subject
    kind = _kind(a, i, j)
    threshold, space = run.decider.thresholds[kind].value, run.decider.space
    quantity = threshold - made.margin
    distance = float(np.sqrt(quantity)) if space == "r2" else quantity
    # the margin of r² is so many times that of r
    slope = 2.0 * run.decider.r_cut[kind] if space == "r2" else 1.0
    length = made.margin / slope
    margins = dict(zip("AB", around.margins, strict=True)) if around is not None else {}
    bounds = dict(zip("AB", around.bounds, strict=True)) if around is not None else {made.run: made.bound}
    return {
        "channel": "pair",
        "step": made.step,
        "run": made.run,
        "i": i,
        "j": j,
        "entered": made.entered,
        "space": space,
        "margin": made.margin,
        "bound": made.bound,
        "ambiguous": made.ambiguous,
        "margins": margins,
        "bounds": bounds,
        "ambiguous_in": [name for name, margin in margins.items() if abs(margin) <= bounds[name]],
        "cutoffs": {"A": _cutoff(a, i, j), "B": _cutoff(b, i, j)},
        "distance": distance,
        "margin_length": length,
        "bound_length": made.bound / slope,
        "separation_before": made.separation,
        "protected": abs(length) / made.separation if made.separation > 0 else None,
        "also": made.also,
    }


def _certified(fork: Fork) -> dict[str, Any]:
    """How far the decisions of either run are certain, by themselves and against the other's."""
    found = certified(fork)
    runs = found.horizon.items()
    return {
        "certified_horizon": {name: one.step for name, one in runs} or None,
        "ambiguous": {name: one.decisions for name, one in runs},
        "ambiguous_steps": {name: one.steps for name, one in runs},
        "ambiguous_kept": {name: len(fork.doubts[name].step) for name in found.horizon},
        "ambiguous_first": {name: _first(fork.doubts[name]) for name in found.horizon},
        "lists_complete": {name: one.complete for name, one in runs},
        "protected_until": found.protected,
        "shadow": found.shadow,
        "shadow_horizon": found.shadow_step,
    }


def _first(doubts: Ambiguous) -> dict[str, Any] | None:
    """The first ambiguous decision of a run."""
    if not len(doubts.step):
        return None
    return {name: column[0].item() for name, column in doubts._asdict().items()}


def _kind(simulation: Simulation, i: int, j: int) -> int:
    return int(simulation.type_of(np.array([i]), np.array([j]))[0])


def _cutoff(simulation: Simulation, i: int, j: int) -> float:
    """The cutoff that a program compares with: the threshold in its own dtype, as a distance."""
    decider = simulation.decider
    value = decider.thresholds[_kind(simulation, i, j)].value
    return float(np.sqrt(value)) if decider.space == "r2" else value
