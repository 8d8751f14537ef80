"""`mdnum fork map` and `mdnum fork forecast`: decisions versus a parameter or the initial positions."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.report.finding import Texts, Verdict, conclude
from mdnum.report.section import Page, Plot, Role, Section, Series, curves, pairs, positive, table_of
from mdnum.report.words import pair_name
from mdnum.verbs import frame
from mdnum.verbs.fork_page import size
from mdnum.verbs.fork_pair import FEW_STEPS, basics, last_step, of_md
from mdnum.verbs.frame import Keep, Outcome, View

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from mdnum.forks.boundaries import Boundary
    from mdnum.rollout.program import Loss
    from mdnum.systems import BallSystem, System
    from mdnum.systems.simulation import Simulation

TEXTS = Texts(__file__)

_INTERVAL = re.compile(r"^\s*([^=\s]+)\s*=\s*([^:\s]+)\s*:\s*([^:\s]+)\s*$")
#: Largest number of listed flips of each kind.
_LISTED = 10
#: If jumps are smaller than this share of the range of the loss, a second figure shows the loss without its
#: trend (a cubic).
_VISIBLE, _TREND = 0.05, 3
#: Boundaries closer than this share of the interval are numbered in the figure.
_ROOM = 0.03


def command(system: str, along: str, **given: Any) -> Outcome:
    """Execute `mdnum fork map SYSTEM KEY=LOW:HIGH`.

    Raises:
        InputError: the interval is not of the form KEY=LOW:HIGH.
    """
    return fork_map(system, *interval(along), **given)


def interval(text: str) -> tuple[str, float, float]:
    """Split a text KEY=LOW:HIGH into the key and the ends of the interval.

    Raises:
        InputError: the text is not of the form KEY=LOW:HIGH.
    """
    with suppress(ValueError):
        for key, low, high in _INTERVAL.findall(text):
            return key, float(low), float(high)
    seen = f"{text!r} is not of the form KEY=LOW:HIGH"
    raise InputError(seen, remedy="Write KEY=LOW:HIGH, for example potential.sigma=3.40:3.41")


@frame.keywords_checked
def fork_map(
    system: Simulation | System | BallSystem | str | Path,
    key: str,
    low: float,
    high: float,
    *,
    steps: int | None = None,
    cells: int = 64,
    most: int | None = None,
    loss: Loss | None = None,
    confirm: bool = True,
    on: str | Executor | None = None,
    workers: int | None = None,
    **keep: Unpack[Keep],
) -> Outcome:
    """Find the parameter values at which decisions of a run change.

    Example:
        >>> mdnum.fork_map("argon/crystal-108", "cutoff.radius", 1.58, 1.59, steps=100)

    Args:
        system: a simulation, a system, a shipped name or the path of a system file (also of a ball).
        key: the parameter, such as "potential.sigma", "timestep" or "position.17.x"; for a ball "k", "tol",
            "y0".
        low, high: the closed interval, in the units of the system's file.
        steps: last step of every run; by default the system's own, but at most 500 for molecular dynamics.
        cells: number of cells of the grid that is searched first.
        most: stop after this number of boundaries; default 24, and 64 for a ball.
        loss: loss of the final state, called with the simulation, unwrapped positions and velocities; by
            default the mean squared displacement from the start. The loss of a ball is that of its file.
        confirm: whether to run both sides of every boundary again in a new process; not for a simulation made
            from objects, which exists only in this process.
        on, workers: where to compute, as for `mdnum.sweep`; by default in this process. The confirmation
            always has a process of its own on this machine.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome whose result is a `mdnum.forks.boundaries.BoundaryMap`.

    Raises:
        InputError: the system cannot be run, there is no such parameter, or the interval is invalid.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.boundaries import boundaries, checked
    from mdnum.forks.worlds import program_of
    from mdnum.systems import BallSystem, opened

    loaded = opened(system, keep.get("overrides"))
    if isinstance(loaded, BallSystem):
        if loss is not None:
            raise InputError("the loss of a ball comes from its system file", remedy="Give no loss function")
        loaded = loaded if steps is None else loaded.for_steps(steps)
        last, kind = last_step(loaded, steps), str(loaded.spec.loss.kind)
        lost = kind.replace("-", " "), "m²" if kind == "residual-penetration" else "m"
    else:
        last = last_step(loaded, steps, FEW_STEPS)
        lost = "mean squared displacement", f"{loaded.units.length}²"
        if loss is not None:
            lost = getattr(loss, "__name__", "loss"), ""
    # what cannot be is refused before there is a folder
    spelled = checked(program_of(loaded), key, low, high)
    # another process cannot make objects of this one again
    confirm = confirm and (isinstance(loaded, BallSystem) or loaded.file is not None)
    with frame.answering("map", f"fork-{loaded.name}", loaded, **keep) as answer:
        answer.result = found = boundaries(
            loaded, spelled.key, low, high, last, cells=cells, most=most, loss=loss, confirm=confirm,
            progress=answer.log, on=on, workers=workers,
        )  # fmt: skip
        answer.folder.told = {"units": {"parameter": spelled.unit, "loss": lost[1]}}
        edges, intervals = [_row(edge) for edge in found.boundaries], plain(found.intervals)
        at = np.searchsorted([one["low"] for one in intervals], found.at, side="right") - 1
        jumps = [abs(edge.jump) for edge in found.boundaries if np.isfinite(edge.jump)]
        answer.summary = basics(loaded, last) | {
            "key": spelled.key, "key_unit": spelled.unit, "value": spelled.value, "loss": lost[0],
            "loss_unit": lost[1], "low": found.low, "high": found.high, "histories": found.histories,
            "complete": found.complete, "resolution": found.resolution, "evaluations": found.evaluations,
            "failed_runs": found.failed, "confirm": confirm,
            "confirmed": sum(edge.confirmed is True for edge in found.boundaries) if confirm else None,
            "jump_largest": max(jumps, default=None),
            "separation_largest": max((edge.separation for edge in found.boundaries), default=None),
            "boundaries": edges, "intervals": intervals, "unresolved": found.unresolved,
        }  # fmt: skip
        said = ("who", "way", "channel")
        answer.tables = {
            "points": {
                "at": found.at, "history": np.array([one["history"] for one in intervals])[at],
                "loss": found.loss, "energy": found.energy,
            },
            "boundaries": [{name: edge[name] for name in edge if name not in said} for edge in edges],
            # a loss that is not finite is a number of the table, and none of the summary
            "intervals": [vars(one) for one in found.intervals],
        }  # fmt: skip
    return answer.outcome


def _row(edge: Boundary) -> dict[str, Any]:
    """Return a boundary (a parameter value at which a decision changes) as plain values."""
    below, above = edge.below, edge.above
    first, second = [*edge.subject, -1, -1][:2]
    side = "above" if above.decided else "below"
    who, way, gradients = f"ball {first}", f"touches {side}", {}
    if edge.channel == "pair":
        who, way = pair_name({"i": first, "j": second, "terms": edge.terms}), f"in {side}"
    else:
        gradients = {"gradient_below": below.gradient, "gradient_above": above.gradient}
    if edge.channel == "stop":
        who, way = who if edge.subject else "solver", f"{below.decided} → {above.decided}"
    return {
        "below": below.at, "above": above.at, "step": edge.step, "i": first, "j": second,
        **({"terms": edge.terms} if edge.terms else {}), "who": who,
        "way": way, "channel": edge.channel,
        "inside": above.decided < below.decided if edge.channel == "stop" else bool(above.decided),
        "also": edge.also, "margin_below": below.margin, "margin_above": above.margin, "bound": edge.bound,
        "loss_below": below.loss, "loss_above": above.loss, "jump": edge.jump, **gradients,
        "energy_below": below.energy, "energy_above": above.energy, "separation": edge.separation,
        "confirmed": {True: "yes", False: "no", None: "not tested"}[edge.confirmed],
    }  # fmt: skip


def judge_map(view: View) -> Verdict:
    """Return the verdict on a map: at which parameter values decisions change and the loss jumps."""
    s = view.summary
    edges, left, failed = s["boundaries"], s["unresolved"], s["failed_runs"]
    all_failed = bool(failed) and failed == s["evaluations"]
    ends = {name: repr(s[name]) for name in ("low", "high", "value")}
    values = {**s, **ends, "n": len(edges), "more": len(left), "unit": view.units.length}
    kind = ("change" if edges else "same") + ("_more" if left else "")
    kind = kind if not all_failed else "failing" if edges else "failed"
    own, away, found = s["value"], "", []
    if own is not None and not s["low"] <= own <= s["high"]:
        nearest = min(abs(s["low"] - own), abs(s["high"] - own))
        far = "far_" * (nearest > max(s["high"] - s["low"], 0.1 * abs(own)))
        away = TEXTS(f"{far}{'above' if own < s['low'] else 'below'}", **values)
    moved = [repr(edge["above"]) for edge in edges if edge["confirmed"] == "no"]
    if moved:
        ball, places = ["ball"] * ("balls" in s), ", ".join(moved[:4])
        found += [TEXTS.finding("NOT_REPRODUCED", *ball, section="Boundaries", n=len(moved), places=places)]
    if edges and not s["confirm"]:
        found += [TEXTS.finding("NOT_CONFIRMED", section="Boundaries")]
    wide = [low for low, high in left if np.nextafter(low, np.inf) < high]
    if wide:
        found += [TEXTS.finding("MORE_BOUNDARIES", more=len(wide), n=len(edges), at=repr(wide[0]))]
    if failed:
        variants = ["all"] * all_failed + ["away"] * bool(away)
        found += [TEXTS.finding("RUNS_FAILED", *variants, failed=failed, runs=s["evaluations"], away=away)]
    evidence = [] if all_failed else _map_evidence(s, values)
    best = "info" if edges or left else "good"
    return conclude(found, evidence, headline=TEXTS(f"map_{kind}", **values), best=best)


def _map_evidence(s: Mapping[str, Any], values: Mapping[str, Any]) -> Iterator[str]:
    edges = s["boundaries"]
    jumping = [edge for edge in edges if edge["jump"] is not None]
    if jumping:
        largest = max(jumping, key=lambda edge: abs(edge["jump"]))
        yield TEXTS("largest", **{**values, **largest})
        ends = s["intervals"][0]["loss_low"], s["intervals"][-1]["loss_high"]
        if None not in ends:
            total = sum(edge["jump"] for edge in jumping)
            yield TEXTS("end_to_end", **values, change=ends[1] - ends[0], total=total)
    if edges and s["confirm"] and s["confirmed"] == len(edges):
        yield TEXTS("confirmed")
    yield TEXTS("complete" if s["complete"] else "resolution", **values)


def page_map(view: View, verdict: Verdict) -> Page:
    """Return the report page of a map along a parameter."""
    s, unit, length = view.summary, view.summary["key_unit"], view.units.length
    edges, left = s["boundaries"], s["unresolved"]
    keys = TEXTS.keys("keys_map", **{**s, "n": len(edges), "left": len(left) or None, "length": length})
    at = [edge["above"] for edge in edges]
    numbered = len(at) > 1 and bool(np.diff(at).min() < _ROOM * (s["high"] - s["low"]))
    figures = list(_map_figures(view, numbered))
    boundaries = table_of([{"n": k, **edge} for k, edge in enumerate(edges, 1)], {
        "": "n", "below": lambda edge: repr(edge["below"]),
        "above": lambda edge: repr(edge["above"]), "step": "step", "decision": "who", "differs": "way",
        "others": "also", "margin below": "margin_below", "margin above": "margin_above", "bound": "bound",
        f"jump ({s['loss_unit']})": "jump",
        **({"derivative below": "gradient_below", "derivative above": "gradient_above"} if "balls" in s
           else {f"separation ({length})": "separation"}),
        "confirmed": "confirmed",
    })  # fmt: skip
    intervals = table_of(s["intervals"], {
        "from": lambda one: repr(one["low"]), "to": lambda one: repr(one["high"]),
        "history": lambda one: one["history"] + 1, f"{s['loss']} at its low end": "loss_low",
        "at its high end": "loss_high", "runs": "runs",
    })  # fmt: skip
    own = "" if s["value"] is None else f"; the system’s own is {s['value']!r}"
    what = [
        *size(view), ("Number", f"{_with_unit(s['key'], unit)} from {s['low']!r} to {s['high']!r}{own}"),
        ("Loss", f"{_with_unit(s['loss'], s['loss_unit'])} of the last step"),
        ("Program", TEXTS("program")), view.took,
    ]  # fmt: skip
    stretches = table_of(left, {"from": lambda one: repr(one[0]), "to": lambda one: repr(one[1])})
    return view.page(f"{view.name}: along {s['key']}", TEXTS("map_about"), keys, [
        Section(f"Along {s['key']}", figures[:2]),
        Section("Boundaries", [TEXTS("boundaries"), boundaries] if edges else [TEXTS("none")], terminal=True),
        Section("What changes at each boundary", figures[2:]),
        Section("Intervals", [TEXTS("intervals"), intervals]),
        Section("Not searched", [TEXTS("unresolved"), stretches] if left else []),
        Section("What was run", [pairs(what)]),
    ])  # fmt: skip


def _map_figures(view: View, numbered: bool) -> Iterator[Plot]:
    """Yield figures of the loss, its deviation from the trend, and its jumps, versus the parameter."""
    s, points = view.summary, view.table("points")
    at, loss = points["at"], points["loss"]
    finite = np.isfinite(loss)
    if len(at) < 2 or not finite.any():
        return
    edges = s["boundaries"]
    marks = tuple(
        (edge["above"], str(k + 1) if numbered else f"{edge['who']}, step {edge['step']:,}")
        for k, edge in enumerate(edges)
    )
    label = _with_unit(s["key"], s["key_unit"])
    breaks = np.flatnonzero(np.diff(points["history"])) + 1
    # a stretch whose ends differ and that was not searched holds jumps, and nobody knows where
    searched = np.isin(at[breaks - 1], [edge["below"] for edge in edges])

    def pieces(name: str, values: np.ndarray, title: str, less: str) -> Plot:
        x, y = (np.insert(one, breaks, np.nan) for one in (at, values))
        series = [Series("one history", x, y, "line+points")]
        named: tuple[tuple[np.ndarray, str, Role], ...] = (
            (~searched, "not searched", "muted"), (searched, "jump", "bad"),
        )  # fmt: skip
        for which, text, role in named:
            if which.any():
                x, y = (np.stack([v[breaks - 1], v[breaks], np.full(len(breaks), np.nan)])[:, which].T.ravel()
                        for v in (at, values))  # fmt: skip
                series.append(Series(text, x, y, role=role, dashed=role == "muted"))
        loss_label = _with_unit(s["loss"], s["loss_unit"]) + less
        caption = TEXTS("map_caption_numbered" if numbered else "map_caption")
        return Plot(name, title, label, loss_label, tuple(series), verticals=marks, caption=caption)

    yield pieces("map", loss, f"The {s['loss']} at step {s['steps']:,}", "")
    largest = s["jump_largest"]
    if largest is not None and finite.sum() >= 3 * _TREND and largest <= _VISIBLE * np.ptp(loss[finite]):
        # a cubic through the intervals, each counted by its width: the runs crowd at the boundaries
        sides = np.concatenate([[at[0]], (at[1:] + at[:-1]) / 2, [at[-1]]])
        weight, x = np.sqrt(np.diff(sides)), (at - at[0]) / (at[-1] - at[0])
        fit = np.polynomial.polynomial.polyfit(x[finite], loss[finite], _TREND, w=weight[finite])
        rest = loss - np.polynomial.polynomial.polyval(x, fit)
        yield pieces("detail", rest, f"The {s['loss']} minus its trend", ", minus a cubic fit")
    if len(edges) > 1:
        where = np.array([edge["above"] for edge in edges])
        jump, separation = (
            np.abs(np.array([edge[name] for edge in edges], float)) for name in ("jump", "separation")
        )
        series = curves(where, {
            _with_unit("jump of the loss", s["loss_unit"]): jump,
            f"separation of the final states ({view.units.length})": separation,
        }, "points")  # fmt: skip
        yield TEXTS.plot("jumps", series, number=label)


def _with_unit(text: str, unit: str) -> str:
    return f"{text} ({unit})" if unit else text


# -- forecasts -----------------------------------------------------------------------------------------


@frame.keywords_checked
def fork_forecast(
    system: Simulation | System | str | Path, size: float, *, steps: int | None = None, **keep: Unpack[Keep]
) -> Outcome:
    """Predict which decisions change first if initial positions change randomly.

    Example:
        >>> mdnum.fork_forecast("argon/liquid-864", 1e-9)

    Args:
        system: a simulation, a system, a shipped name or the path of a system file; pair potentials only.
        size: displacement of the atom that is moved furthest, length.
        steps: last step; by default the system's own.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome whose result is a `mdnum.forks.linearized.Forecast`.

    Raises:
        InputError: the system cannot be run, its potential is a many-body one, or size is not a positive
            length.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.linearized import LINEAR, forecast

    if not 0 < size < float("inf"):
        raise InputError(f"the largest displacement is {size:g}; expected a length above 0")
    loaded = of_md(system, keep.get("overrides"), "forecast", pairwise=True)
    last = last_step(loaded, steps)
    with frame.answering("forecast", f"fork-{loaded.name}", loaded, **keep) as answer:
        frame.say(answer.log, "carrying a tangent along")
        answer.result = found = forecast(loaded, last)
        flips = {"first": found.first(size, _LISTED), "nearest": found.nearest(_LISTED)}
        good = found.good_until(size)
        answer.summary = basics(loaded, last) | {
            "size": size, **flips, "until": good.step, "ends": good.ends, "kicks": found.kicks,
            "examined": int(found.listed[: good.step + 1].sum()), "linear": LINEAR * loaded.r_cut,
            "ulp": found.ulp,
        }  # fmt: skip
        least = np.argmin(found.reach, axis=2, keepdims=True)
        reach = np.take_along_axis(found.reach, least, axis=2)[:, :, 0]
        sign, step = np.argmin(reach, axis=0), np.arange(reach.shape[1])
        pair = found.pairs[sign, step, least[sign, step, 0]]
        answer.tables = {
            "reach": {"step": step, "positive": reach[0], "negative": reach[1], "i": pair[:, 0],
                      "j": pair[:, 1], "furthest": found.furthest},
            "foretold": [{"asked": name, **vars(flip)} for name in flips for flip in flips[name]],
        }  # fmt: skip
    return answer.outcome


def judge_forecast(view: View) -> Verdict:
    """Return the verdict on a forecast: the first changed decisions, and the last valid step."""
    s, unit = view.summary, view.units.length
    first, nearest, until, ends = s["first"], s["nearest"], s["until"], s["ends"]
    values = {**s, "unit": unit, "after": until + 1}
    kind = "flips" if first else "none" if until < 0 else "nothing" if ends == "end" else "nothing_until"
    evidence, found = [], []
    if nearest:
        evidence += [TEXTS("nearest", **values, **nearest[0], needed=abs(nearest[0]["amplitude"]))]
    if until >= 0:
        evidence += [TEXTS(f"good_{ends}", **values)]
    if ends in ("size", "close", "list"):
        found += [TEXTS.finding(f"FORECAST_ENDS_{ends.upper()}", *["none"] * (until < 0), until=until)]
    if s["size"] < 8 * s["ulp"]:
        found += [TEXTS.finding("BELOW_ROUNDING", ulp=s["ulp"], unit=unit)]
    headline = TEXTS(f"forecast_{kind}", **{**values, **(first[0] if first else {})})
    return conclude(found, evidence, headline=headline, best="info" if first or ends != "end" else "good")


def page_forecast(view: View, verdict: Verdict) -> Page:
    """Return the report page of a forecast."""
    s, length, until = view.summary, view.units.length, view.summary["until"]
    first, near = (next(iter(s[name]), None) for name in ("first", "nearest"))
    values = {"first": first, "near": near, "needed": near and abs(near["amplitude"]), "length": length}
    keys = TEXTS.keys("keys_forecast", **{**s, **values, "until": until if until >= 0 else None})
    columns = {
        "step": "step", "pair": lambda one: f"{one['i']}–{one['j']}", f"displacement ({length})": "amplitude",
        "ulps of the start": "ulps", "margin": "margin",
    }  # fmt: skip
    titles = {"first": "Flips first", "nearest": "Nearest to flipping"}
    table = view.table("reach")
    series = curves(table["step"], {
        "forward along it": np.abs(table["positive"]), "backward along it": np.abs(table["negative"]),
    }, "points")  # fmt: skip
    plots = []
    if series:
        with np.errstate(divide="ignore", over="ignore"):
            limit = positive(s["linear"] / table["furthest"])
        series += (Series("too large for a forecast above", table["step"], limit, role="muted"),)
        plots = [TEXTS.plot("reach", series, horizontals=[(float(s["size"]), "asked for")], unit=length)]
    return view.page(f"{view.name}: forecast", TEXTS("forecast_about"), keys, [
        Section("Displacements that flip a decision", plots),
        Section("Decisions", [table_of(s[name], columns, title) for name, title in titles.items() if s[name]],
                terminal=True),
        Section("What was run", [pairs([*size(view), ("Direction", TEXTS("direction")), view.took])]),
    ])  # fmt: skip


KINDS = {
    "map": frame.Verb(judge_map, page_map),
    "forecast": frame.Verb(judge_forecast, page_forecast),
}
