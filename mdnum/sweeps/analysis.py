"""Analysis of a sweep: means, differences, failures and recommended values."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.sweeps.advice import FREE, advise, compared_with_end, end_of
from mdnum.sweeps.design import Axis, label
from mdnum.sweeps.plan import Plan, Setting
from mdnum.sweeps.points import Workspace
from mdnum.sweeps.statistics import Difference, SeedMean, corrected, difference, effects, estimates, paired

#: Value, error and degrees of freedom of a difference.
Raw = tuple[float, float, float]
#: Values by measure and setting.
Means = Mapping[tuple[str, Setting], SeedMean]
_MOVES = {True: "yes", False: "no", None: "undecided"}


@dataclass
class _Results:
    """Results of all points of a sweep, grouped by measure, setting and seed."""

    rows: list[dict[str, Any]] = field(default_factory=list)  # of the table of points
    # (value, error, independent samples) of each run, by measure, setting and seed
    values: dict[str, dict[Setting, dict[Any, tuple[float, float, float]]]] = field(default_factory=dict)
    failures: dict[str, list[Setting]] = field(default_factory=dict)  # by reason
    missing: list[dict[str, str]] = field(default_factory=list)  # measures without a value at a setting
    speeds: dict[Setting, list[tuple[float, int]]] = field(
        default_factory=dict
    )  # steps per second, pairs lost


def analyzed(place: Workspace, plan: Plan) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the tables and the summary of a sweep."""
    results = _read(place, plan)
    joint = [plan.setting(choices) for choices in plan.question.joint]
    along = {setting for axis in plan.axes for _, setting in plan.along(axis)}
    means = _means(results, {*joint} - along)
    if plan.question.design == "space-filling":
        compared = corrected(_ends(plan, results))
    else:
        compared = corrected(_all_differences(plan, means, results))
    rows = [
        {"measure": name, "choice": key, "setting": value, **asdict(one), "sigmas": one.sigmas,
         "moves": _MOVES[one.moves]}
        for (name, key, value), one in compared.items()
    ]  # fmt: skip
    tolerances = _tolerances(plan, means)
    together = _together(_means(results), results, joint, tolerances) if joint else None
    tables = {
        "points": _columns(results.rows),
        "estimates": [
            {"measure": name, "setting": ", ".join(setting), **asdict(mean)}
            for (name, setting), mean in means.items()
        ],
        "differences": rows,
    }
    summary = {
        "system": plan.loaded.name, "steps": plan.steps, "units": plan.units, "atoms": plan.atoms,
        "design": plan.question.design, "seeds": list(plan.seeds),
        "axes": [
            {"key": axis.key, "values": list(axis.values), "base": plan.base[axis.key]} for axis in plan.axes
        ],
        "measures": [
            {"name": measure.name, "unit": measure.unit, "title": measure.title, "physical": measure.physical}
            for measure in plan.measures
        ],
        "settings": len({one.setting for one in plan.points}), "points": len(plan.points),
        "failed": [
            {"why": why, "points": len(where), "settings": sorted({", ".join(setting) for setting in where})}
            for why, where in results.failures.items()
        ],
        "missing": results.missing,
        "estimates": [
            {"measure": name, "setting": list(setting), **_finite(asdict(mean))}
            for (name, setting), mean in means.items()
        ],
        "differences": [_finite(row) for row in rows],
        "tolerances": tolerances, "advice": _advice(plan, means, tolerances, compared, results),
        "joint": together,
        "speeds": [
            _finite({"setting": list(setting), "steps_per_second": float(np.median(np.array(runs)[:, 0])),
                     "lost_pairs": int(np.array(runs)[:, 1].sum())})
            for setting, runs in results.speeds.items()
        ],
    }  # fmt: skip
    return tables, summary


def _read(place: Workspace, plan: Plan) -> _Results:
    results, missing = _Results(), {}
    for k, one in enumerate(plan.points):
        result = None if one.wrong else place.result(one.address)
        result = result or {"status": "failed", "why": one.wrong or "was not computed", "measures": {}}
        if result["status"] == "failed":
            results.failures.setdefault(result["why"], []).append(one.setting)
        elif "steps_per_second" in (run := result["summary"]):
            speed = np.nan if run["steps_per_second"] is None else run["steps_per_second"]
            results.speeds.setdefault(one.setting, []).append((speed, run["lost_pairs"]))
        for measure in plan.measures:
            value = result["measures"].get(measure.name, {"value": None, "why": result.get("why", "")})
            at, error, effective = (
                np.nan if value.get(name) is None else value[name] for name in ("value", "error", "effective")
            )
            results.rows.append({
                "point": k, "setting": ", ".join(one.setting), "seed": one.point.seed, "address": one.address,
                "measure": measure.name, "value": at, "error": error,
                "effective": effective,
                "status": result["status"], "why": value.get("why", result.get("why", "")),
            })  # fmt: skip
            if value["value"] is not None:
                runs = results.values.setdefault(measure.name, {}).setdefault(one.setting, {})
                runs[one.point.seed] = at, error, effective
            elif result["status"] == "complete":
                missing.setdefault((measure.name, one.setting), value["why"])
    # a mean over those seeds that happen to have a value, such as runs that did split, would be biased
    for (name, setting), why in missing.items():
        results.values.get(name, {}).pop(setting, None)
        results.missing.append({"measure": name, "setting": ", ".join(setting), "why": why})
    return results


def _columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _finite(row: Mapping[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


def _along(
    means: Means,
    results: _Results,
    settings: Mapping[str, Setting],
    reference: Setting,
    names: Sequence[str],
) -> dict[str, dict[str, Raw]]:
    """Return the differences from a reference setting, by measure and label of the setting."""
    found = {}
    for name in names:
        runs = results.values.get(name, {})
        if (name, reference) not in means:
            found[name] = {}
            continue
        there = {
            key: setting for key, setting in settings.items()
            if setting != reference and (name, setting) in means
        }  # fmt: skip
        raw = {key: difference(means[name, one], means[name, reference]) for key, one in there.items()}
        last = runs[reference]
        by_seed = {
            key: np.array([run[0] - last[seed][0] for seed, run in runs[one].items() if seed in last])
            for key, one in there.items()
        }
        found[name] = paired(raw, by_seed)
    return found


def _labels(plan: Plan, axis: Axis) -> dict[str, Setting]:
    return {label(value): setting for value, setting in plan.along(axis)}


def _all_differences(plan: Plan, means: Means, results: _Results) -> dict[tuple[str, ...], Raw]:
    """Return the change of each measure if one choice is changed."""
    found = {}
    for axis in plan.axes:
        each = _along(means, results, _labels(plan, axis), plan.origin, plan.names)
        found |= {(name, axis.key, key): raw for name, rows in each.items() for key, raw in rows.items()}
    return found


def _ends(plan: Plan, results: _Results) -> dict[tuple[str, ...], Any]:
    """Return the change of each measure over a choice's range, from a linear fit."""
    choices, ends = {one.setting: one.point.choices for one in plan.points}, {}

    def share(axis: Axis, value: Any) -> float:
        if axis.ordered:
            low, high = min(axis.values), max(axis.values)
            return (value - low) / (high - low) if high > low else 0.0
        return axis.values.index(value) / max(len(axis.values) - 1, 1)

    for name, runs in results.values.items():
        places = [
            [share(axis, choices[setting][axis.key]) for axis in plan.axes]
            for setting, many in runs.items()
            for _ in many
        ]
        values = [numbers[0] for many in runs.values() for numbers in many.values()]
        changes = effects(np.array(places), np.array(values))
        ends |= {(name, axis.key, "end to end"): one for axis, one in zip(plan.axes, changes, strict=True)}
    return ends


def _tolerances(plan: Plan, means: Means) -> dict[str, float]:
    """Return the tolerance of each measure, in the unit of the measure."""
    given = plan.question.tolerance
    if given is None:
        return {}
    if isinstance(given, Mapping):
        if unknown := [name for name in given if name not in plan.names]:
            message = f"a tolerance is given for {unknown[0]}, which is not measured"
            raise InputError(message, remedy="Add this measure to --measure")
        return {name: float(value) for name, value in given.items()}
    sizes = {
        measure.name: abs(means[measure.name, plan.origin].value)
        for measure in plan.measures
        if measure.physical and (measure.name, plan.origin) in means
    }
    return {name: float(given) * size for name, size in sizes.items() if size > 0}


def _advice(
    plan: Plan,
    means: Means,
    tolerances: Mapping[str, float],
    compared: Mapping[tuple[str, ...], Difference],
    results: _Results,
) -> list[dict[str, Any]]:
    """Return the recommended value of each choice. Choices in `FREE` get the value with the fastest runs."""
    physical = {measure.name for measure in plan.measures if measure.physical}
    moving = {(key, value) for (name, key, value), one in compared.items() if one.moves and name in physical}
    rows = []
    for axis in plan.axes:
        if axis.key in FREE:
            rows.append(_fastest(plan, axis, moving, results))
            continue
        given, labels = plan.question.converged or {}, _labels(plan, axis)
        # an end whose points failed is none
        values = [
            value
            for value, setting in plan.along(axis)
            if any((name, setting) in means for name in tolerances)
        ]
        if not values or (end := end_of(axis.key, values, given)) is None:
            continue
        found = _along(means, results, labels, labels[label(end)], list(tolerances))
        advice = advise(axis.key, values, found, tolerances, given)
        if advice is not None:
            settings = [
                _finite({"value": one.value, "inside": one.inside, "worst": one.worst, "more": one.more})
                for one in advice.settings
            ]
            rows.append({
                "choice": axis.key, "end": advice.end, "best": advice.best, "undecided": advice.undecided,
                "converged": advice.converged, "settings": settings,
            })  # fmt: skip
    return rows


def recommended(plan: Plan, advice: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return two settings: all recommended values, and all converged values. Empty if equal.

    The two settings show the combined effect of choices that were varied alone.
    """
    best = {row["choice"]: row["best"] for row in advice if row["best"] is not None}
    ends = {row["choice"]: row["end"] for row in advice if row["end"] is not None}
    if len(best) < 2 or not ends or plan.question.design != "one-at-a-time":
        return []
    both = [{**plan.base, **best}, {**plan.base, **ends}]
    return [] if plan.setting(both[0]) == plan.setting(both[1]) else both


def _means(results: _Results, without: Collection[Setting] = ()) -> dict[tuple[str, Setting], SeedMean]:
    """Return the mean of each measure at each setting, over seeds."""
    return {
        (name, setting): mean
        for name, runs in results.values.items()
        for setting, mean in estimates(
            {one: list(each.values()) for one, each in runs.items() if one not in without}
        ).items()
    }


def _together(
    means: Means, results: _Results, joint: Sequence[Setting],
    tolerances: Mapping[str, float],
) -> dict[str, Any]:  # fmt: skip
    """Compare two settings: all recommended values, and all converged values."""
    setting, end = joint
    found = _along(means, results, {"": setting}, end, list(tolerances))
    one = compared_with_end(setting, "", found, tolerances, len(tolerances))
    lost = any(pairs for _, pairs in results.speeds.get(setting, []))
    return _finite({
        "setting": list(setting), "end": list(end), "inside": False if lost else one.inside,
        "worst": "lost" if lost else one.worst, "more": one.more,
    })  # fmt: skip


def _fastest(plan: Plan, axis: Axis, moving: set[tuple[str, str]], results: _Results) -> dict[str, Any]:
    """Return the fastest value whose runs miss no pairs and change no results."""
    rows = []
    for value, setting in plan.along(axis):
        speeds, lost = np.array(results.speeds.get(setting, [(np.nan, 0)])).T
        sound = not lost.any() and (axis.key, label(value)) not in moving and bool(np.isfinite(speeds).all())
        rows.append({"value": value, "inside": sound, "worst": None if sound else "lost", "more": None,
                     "speed": float(np.median(speeds))})  # fmt: skip
    best = max((row for row in rows if row["inside"]), key=lambda row: row["speed"], default=None)
    return {"choice": axis.key, "end": None, "best": best and best["value"], "undecided": None,
            "converged": None, "settings": [_finite(row) for row in rows]}  # fmt: skip
