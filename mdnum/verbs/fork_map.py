"""`mdnum fork map` and `forecast`: where decisions change along a number, and what would flip them first."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.report.finding import Finding, Texts, Verdict, conclude
from mdnum.report.section import Key, Page, Plot, Role, Section, Series, Table, pairs
from mdnum.report.words import count, many, number
from mdnum.verbs import frame
from mdnum.verbs.fork_page import size
from mdnum.verbs.fork_pair import basics, few_steps, of_any, of_md
from mdnum.verbs.frame import Outcome, Progress, View

if TYPE_CHECKING:
    from mdnum.forks.boundaries import Boundary
    from mdnum.rollout.program import Loss
    from mdnum.systems import BallSystem, System

TEXTS = Texts(__file__)

#: Flips that are listed of each kind.
_LISTED = 10
#: Jumps that are a smaller share of the range of the loss are shown once more, without its trend: a cubic.
_VISIBLE, _TREND = 0.05, 3
#: Boundaries closer than this share of the interval are numbered in the figure.
_ROOM = 0.03


def fork_map(
    system: System | BallSystem | str | Path,
    key: str,
    low: float,
    high: float,
    *,
    steps: int | None = None,
    cells: int = 64,
    most: int | None = None,
    loss: Loss | None = None,
    confirm: bool = True,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """Where the history of a run's decisions changes along a number, to adjacent floats.

    Args:
        system: a loaded system, a shipped name or the path of a system file, of either world.
        key: the number, such as "potential.sigma", "timestep" or "position.17.x"; of a ball "k", "tol", "y0".
        low, high: the interval, in the units of the system's file; both belong to it.
        steps: last step of every run; default the system's own, but no more than 500 of molecular dynamics.
        cells: of the grid that is searched first.
        most: stop after this number of boundaries; default 24, and of a ball 64.
        loss: of the final state, called with the simulation, unwrapped positions and velocities; default the
            mean squared displacement from the start. That of a ball is the file's.
        confirm: whether to run both sides of every boundary again in a fresh process.
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values, such as {"cutoff.kind": "switched"}.
        report: write report.html.
        progress: called now and then with what is done, of how much, and a dictionary of figures.

    Returns:
        its result is a `mdnum.forks.boundaries.BoundaryMap`.

    Raises:
        InputError: the system cannot be run, no such number, or an interval that makes no sense.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.boundaries import boundaries, checked
    from mdnum.forks.worlds import program_of
    from mdnum.systems import BallSystem

    began = time.perf_counter()
    system = of_any(system, overrides)
    if isinstance(system, BallSystem):
        if loss is not None:
            raise InputError("the loss of a ball is that of its system file", remedy="Leave out loss")
        system = system if steps is None else system.for_steps(steps)
        last, kind = system.spec.integrator.steps, str(system.spec.loss.kind)
        lost = {"loss": kind.replace("-", " "), "loss_unit": "m²" if kind == "residual-penetration" else "m"}
    else:
        last = few_steps(system, steps)
        lost = {"loss": "mean squared displacement", "loss_unit": f"{system.units.length}²"}
        if loss is not None:
            lost = {"loss": getattr(loss, "__name__", "loss"), "loss_unit": ""}
    # what cannot be is refused before there is a folder
    spelled = checked(program_of(system), key, low, high)
    with frame.new_folder("map", f"fork-{system.name}", out, system=system) as folder:
        found = boundaries(
            system, spelled.key, low, high, last, cells=cells, most=most, loss=loss, confirm=confirm,
            progress=frame.logged(folder, progress, frame.STEPWISE),
        )  # fmt: skip
        edges = [_row(edge) for edge in found.boundaries]
        intervals = plain(found.intervals)
        starts = [one["low"] for one in intervals]
        pieces = np.searchsorted(starts, found.at, side="right") - 1
        points = {
            "at": found.at, "history": np.array([one["history"] for one in intervals])[pieces],
            "loss": found.loss, "energy": found.energy,
        }  # fmt: skip
        jumps = [abs(edge.jump) for edge in found.boundaries if np.isfinite(edge.jump)]
        summary = basics(system, last) | {
            "key": spelled.key, "key_unit": spelled.unit, "value": spelled.value, **lost,
            "low": found.low, "high": found.high, "histories": found.histories, "complete": found.complete,
            "resolution": found.resolution, "evaluations": found.evaluations, "failed_runs": found.failed,
            "confirm": confirm,
            "confirmed": sum(edge.confirmed is True for edge in found.boundaries) if confirm else None,
            "jump_largest": max(jumps, default=None),
            "separation_largest": max((edge.separation for edge in found.boundaries), default=None),
            "boundaries": edges, "intervals": intervals, "unresolved": found.unresolved,
            "compiles": found.number.compiles, "seconds": time.perf_counter() - began,
        }  # fmt: skip
        tables: dict[str, Any] = {"points": points}
        for name, rows, left in (
            ("boundaries", edges, ("who", "way", "channel")),
            ("intervals", intervals, ()),
        ):
            if rows:
                columns = [column for column in rows[0] if column not in left]
                tables[name] = {column: [row[column] for row in rows] for column in columns}
        frame.store(folder, summary, tables)
    return frame.finish(folder, report=report, result=found, progress=progress)


def _row(edge: Boundary) -> dict[str, Any]:
    """A boundary in plain values."""
    below, above = edge.below, edge.above
    first, second = [*edge.subject, -1, -1][:2]
    side = "above" if above.decided else "below"
    if edge.channel == "pair":
        who, way = "–".join(map(str, edge.subject)), f"in {side}"
    elif edge.channel == "contact":
        who, way = f"ball {first}", f"touches {side}"
    else:
        who = f"ball {first}" if edge.subject else "solver"
        way = f"{below.decided} → {above.decided}"
    gradients = {"gradient_below": below.gradient, "gradient_above": above.gradient}
    return {
        "below": below.at, "above": above.at, "step": edge.step, "i": first, "j": second, "who": who,
        "way": way, "channel": edge.channel,
        "inside": above.decided < below.decided if edge.channel == "stop" else bool(above.decided),
        "also": edge.also, "margin_below": below.margin, "margin_above": above.margin, "bound": edge.bound,
        "loss_below": below.loss, "loss_above": above.loss, "jump": edge.jump,
        **(gradients if edge.channel != "pair" else {}),
        "energy_below": below.energy, "energy_above": above.energy, "separation": edge.separation,
        "confirmed": {True: "yes", False: "no", None: "not asked"}[edge.confirmed],
    }  # fmt: skip


def judge_map(view: View) -> Verdict:
    """What changes along a number, how much, and how sure that is."""
    s = view.summary
    edges, left, failed = s["boundaries"], s["unresolved"], s["failed_runs"]
    all_failed = bool(failed) and failed == s["evaluations"]
    ends = {name: repr(s[name]) for name in ("low", "high", "value")}
    values = {**s, **ends, "n": len(edges), "more": len(left), "unit": view.units.length}
    kind = "failing" if all_failed and edges else "failed" if all_failed else (
        ("change" if edges else "same") + ("_more" if left else ""))  # fmt: skip
    evidence = [] if all_failed else list(_map_evidence(s, values))
    own, away = s["value"], ""
    if own is not None and not s["low"] <= own <= s["high"]:
        nearest = min(abs(s["low"] - own), abs(s["high"] - own))
        far = nearest > max(s["high"] - s["low"], 0.1 * abs(own))
        away = TEXTS(f"{'far_' if far else ''}{'above' if own < s['low'] else 'below'}", **values)
    found = []
    moved = [repr(edge["above"]) for edge in edges if edge["confirmed"] == "no"]
    if moved:
        ball = ["ball"] * ("balls" in s)
        places = ", ".join(moved[:4])
        found.append(
            TEXTS.finding("NOT_REPRODUCED", *ball, section="Boundaries", n=len(moved), places=places)
        )
    if edges and not s["confirm"]:
        found.append(TEXTS.finding("NOT_CONFIRMED", section="Boundaries"))
    wide = [low for low, high in left if np.nextafter(low, np.inf) < high]
    if wide:
        found.append(TEXTS.finding("MORE_BOUNDARIES", more=len(wide), n=len(edges), at=repr(wide[0])))
    if failed:
        variants = ["all"] * all_failed + ["away"] * bool(away)
        found.append(TEXTS.finding("RUNS_FAILED", *variants, failed=failed, runs=s["evaluations"], away=away))
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
    """The page of a map."""
    s, ball = view.summary, "balls" in view.summary
    edges, unit, length = s["boundaries"], s["key_unit"], view.units.length
    sure = s["confirmed"]
    more = f"{count(len(s['unresolved']))} more not searched" if s["unresolved"] else "to adjacent floats"
    keys = [
        Key("Boundaries", count(len(edges)), more),
        Key("Histories", count(s["histories"]), "distinct, of all decisions"),
        Key("Largest jump", number(s["jump_largest"]), f"{s['loss_unit']}, of the {s['loss']}"),
        Key(
            "Final states", number(s["separation_largest"]), f"{length}, separation across a boundary at most"
        ),
        Key(
            "Confirmed",
            "–" if sure is None else f"{count(sure)} of {count(len(edges))}",
            "in a fresh process",
        ),
        Key("Runs", count(s["evaluations"]), f"{number(s['seconds'], 2)} s in all"),
    ]
    at = [edge["above"] for edge in edges]
    numbered = len(at) > 1 and bool(np.diff(at).min() < _ROOM * (s["high"] - s["low"]))
    figures = list(_map_figures(view, numbered))
    ends = ("derivative below", "above") if ball else (f"separation ({length})",)
    rows = [
        (k + 1, repr(edge["below"]), repr(edge["above"]), edge["step"], edge["who"], edge["way"],
         edge["also"], edge["margin_below"], edge["margin_above"], edge["bound"], edge["jump"],
         *((edge["gradient_below"], edge["gradient_above"]) if ball else (edge["separation"],)),
         edge["confirmed"])
        for k, edge in enumerate(edges)
    ]  # fmt: skip
    columns = ("", "below", "above", "step", "decision", "differs", "others", "margin below", "margin above",
               "bound", f"jump ({s['loss_unit']})", *ends, "confirmed")  # fmt: skip
    intervals = [
        (
            repr(one["low"]),
            repr(one["high"]),
            one["history"] + 1,
            one["loss_low"],
            one["loss_high"],
            one["runs"],
        )
        for one in s["intervals"]
    ]
    named = ("from", "to", "history", f"{s['loss']} at its low end", "at its high end", "runs")
    own = "" if s["value"] is None else f"; the system’s own is {s['value']!r}"
    what = [
        *size(view), ("Number", f"{_with_unit(s['key'], unit)} from {s['low']!r} to {s['high']!r}{own}"),
        ("Loss", f"{_with_unit(s['loss'], s['loss_unit'])} of the last step"),
        ("Program", TEXTS("program_compiles" if s["compiles"] else "program")),
        ("Took", f"{number(s['seconds'], 2)} s"),
    ]  # fmt: skip
    left = [(repr(low), repr(high)) for low, high in s["unresolved"]]
    sections = [
        Section(f"Along {s['key']}", figures[:2]),
        Section(
            "Boundaries",
            [TEXTS("boundaries"), Table(columns, rows)] if rows else [TEXTS("none")],
            terminal=True,
        ),
        Section("What changes at each boundary", figures[2:]),
        Section("Intervals", [TEXTS("intervals"), Table(named, intervals)]),
        Section("Not searched", [TEXTS("unresolved"), Table(("from", "to"), left)] if left else []),
        Section("What was run", [pairs(what)]),
    ]
    sections = [one for one in sections if one.parts]
    title = f"{view.name}: along {s['key']}"
    return Page(title, TEXTS("map_about"), keys, sections, view.system_toml, view.folder.provenance)


def _map_figures(view: View, numbered: bool) -> Iterator[Plot]:
    """The loss piece by piece; less its trend, where jumps are too small to be seen; how large they are."""
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
    caption = TEXTS("map_caption_numbered" if numbered else "map_caption")

    def pieces(name: str, values: np.ndarray, title: str, less: str) -> Plot:
        series = [
            Series(
                "one history", np.insert(at, breaks, np.nan), np.insert(values, breaks, np.nan), "line+points"
            )
        ]
        # a stretch whose ends differ and that was not searched holds jumps, and nobody knows where
        searched = np.isin(at[breaks - 1], [edge["below"] for edge in edges])
        named: tuple[tuple[np.ndarray, str, Role], ...] = (
            (~searched, "not searched", "muted"), (searched, "jump", "bad"),
        )  # fmt: skip
        for which, text, role in named:
            if which.any():
                x, y = (np.stack([v[breaks - 1], v[breaks], np.full(len(breaks), np.nan)])[:, which].T.ravel()
                        for v in (at, values))  # fmt: skip
                series.append(Series(text, x, y, role=role, dashed=role == "muted"))
        loss_label = _with_unit(s["loss"], s["loss_unit"]) + less
        return Plot(name, title, label, loss_label, tuple(series), verticals=marks, caption=caption)

    yield pieces("map", loss, f"The {s['loss']} at step {s['steps']:,}", "")
    largest = s["jump_largest"]
    if largest is not None and finite.sum() >= 3 * _TREND and largest <= _VISIBLE * np.ptp(loss[finite]):
        # a cubic through the intervals, each counted by its width: the runs crowd at the boundaries
        sides = np.concatenate([[at[0]], (at[1:] + at[:-1]) / 2, [at[-1]]])
        weight, x = np.sqrt(np.diff(sides)), (at - at[0]) / (at[-1] - at[0])
        fit = np.polynomial.polynomial.polyfit(x[finite], loss[finite], _TREND, w=weight[finite])
        rest = loss - np.polynomial.polynomial.polyval(x, fit)
        yield pieces("detail", rest, f"The {s['loss']}, less its trend", ", less a cubic")
    else:
        yield from ()
    if len(edges) < 2:
        return
    where = np.array([edge["above"] for edge in edges])
    jump, separation = (
        np.abs([np.nan if edge[name] is None else edge[name] for edge in edges])
        for name in ("jump", "separation")
    )
    series = [Series(_with_unit("jump of the loss", s["loss_unit"]), where, jump, "points", "bad")]
    if np.isfinite(separation).any():
        text = f"separation of the final states ({view.units.length})"
        series.append(Series(text, where, separation, "points", "muted"))
    yield Plot("jumps", "What changes at each boundary", label, "across the boundary", tuple(series),
               y_scale="log", caption=TEXTS("jumps_caption"))  # fmt: skip


def _with_unit(text: str, unit: str) -> str:
    return f"{text} ({unit})" if unit else text


# -- forecasts -----------------------------------------------------------------------------------------


def fork_forecast(
    system: System | str | Path,
    size: float,
    *,
    steps: int | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """Which decisions a random displacement of the start would flip first, from one tangent run.

    Args:
        system: a loaded system, a shipped name or the path of a system file; pair potentials only.
        size: of the displacement: how far the furthest atom is moved, length.
        steps: last step; default the system's own.
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values.
        report: write report.html.
        progress: called at each phase with a dictionary that names it.

    Returns:
        its result is a `mdnum.forks.linearized.Forecast`.

    Raises:
        InputError: the system cannot be run, its potential is a many-body one, or size is no length.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.linearized import LINEAR, forecast
    from mdnum.systems import build

    if not 0 < size < float("inf"):
        raise InputError(f"a displacement of {size:g}; expected a length above 0")
    began = time.perf_counter()
    loaded = of_md(system, overrides, "forecast")
    simulation = build(loaded)
    if not simulation.pairwise:
        raise InputError(
            "decisions of a many-body potential are not forecast",
            where=loaded.name,
            remedy="Use a system with a pair potential",
        )
    last = loaded.spec.dynamics.steps if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    with frame.new_folder("forecast", f"fork-{loaded.name}", out, system=loaded) as folder:
        frame.logged(folder, progress, frame.STEPWISE)(0, 0, {"phase": "carrying a tangent along"})
        found = forecast(simulation, last)
        flips = {"first": found.first(size, _LISTED), "nearest": found.nearest(_LISTED)}
        good = found.good_until(size)
        examined = int(found.listed[: good.step + 1].sum())
        summary = basics(loaded, last) | {
            "size": size, **flips, "until": good.step, "ends": good.ends, "kicks": found.kicks,
            "examined": examined, "linear": LINEAR * simulation.r_cut, "ulp": found.ulp,
            "seconds": time.perf_counter() - began,
        }  # fmt: skip
        rows = [{"asked": name, **vars(flip)} for name, listed in flips.items() for flip in listed]
        least = np.argmin(found.reach, axis=2, keepdims=True)
        reach = np.take_along_axis(found.reach, least, axis=2)[:, :, 0]
        sign, step = np.argmin(reach, axis=0), np.arange(reach.shape[1])
        pair = found.pairs[sign, step, least[sign, step, 0]]
        tables: dict[str, Any] = {
            "reach": {"step": step, "positive": reach[0], "negative": reach[1], "i": pair[:, 0],
                      "j": pair[:, 1], "furthest": found.furthest}
        }  # fmt: skip
        if rows:
            tables["foretold"] = {name: [row[name] for row in rows] for name in rows[0]}
        frame.store(folder, summary, tables)
    return frame.finish(folder, report=report, result=found, progress=progress)


def judge_forecast(view: View) -> Verdict:
    """What a displacement is expected to flip first, and how far that is good."""
    s = view.summary
    first, nearest, ends = s["first"], s["nearest"], s["ends"]
    values = {**s, "unit": view.units.length, "after": s["until"] + 1, "first": None}
    kind = "flips" if first else "none" if s["until"] < 0 else "nothing" if ends == "end" else "nothing_until"
    evidence = (
        [TEXTS("nearest", **values, **nearest[0], needed=abs(nearest[0]["amplitude"]))] if nearest else []
    )
    if s["until"] >= 0:
        evidence.append(TEXTS(f"good_{ends}", **values))
    found: list[Finding] = []
    if ends in ("size", "close", "list"):
        variants = ["none"] * (s["until"] < 0)
        found.append(TEXTS.finding(f"FORECAST_ENDS_{ends.upper()}", *variants, until=s["until"]))
    if s["size"] < 8 * s["ulp"]:
        found.append(TEXTS.finding("BELOW_ROUNDING", ulp=s["ulp"], unit=view.units.length))
    headline = TEXTS(f"forecast_{kind}", **{**values, **(first[0] if first else {})})
    return conclude(found, evidence, headline=headline, best="info" if first or ends != "end" else "good")


def page_forecast(view: View, verdict: Verdict) -> Page:
    """The page of a forecast."""
    s, length = view.summary, view.units.length
    first, nearest, until = s["first"], s["nearest"], s["until"]
    keys = [
        Key("Displacement", number(s["size"], 2), f"{length}, of the furthest atom"),
        Key("First flip", f"step {count(first[0]['step'])}" if first else "–", "expected"),
        Key("Nearest decision", number(abs(nearest[0]["amplitude"]), 2) if nearest else "–",
            f"{length} flip it"),
        Key("In ulps", number(nearest[0]["ulps"], 2) if nearest else "–", "of the largest start coordinate"),
        Key("Good until", f"step {count(until)}" if until >= 0 else "–",
            f"of {count(s['steps'])}; {many(s['examined'], 'decision')} of listed pairs examined"),
    ]  # fmt: skip
    columns = ("step", "pair", f"displacement ({length})", "ulps of the start", "margin")
    listed = []
    for title, flips in (("Flips first", first), ("Nearest to flipping", nearest)):
        rows = [
            (one["step"], f"{one['i']}–{one['j']}", one["amplitude"], one["ulps"], one["margin"])
            for one in flips
        ]
        if rows:
            listed.append(Table(columns, rows, title))
    table, series = view.table("reach"), []
    named: tuple[tuple[str, str, Role], ...] = (
        ("positive", "forward along it", "first"), ("negative", "backward along it", "second"),
    )  # fmt: skip
    for name, label, role in named:
        size_of = np.abs(table[name])
        if np.any(np.isfinite(size_of) & (size_of > 0)):
            shown = np.where(np.isfinite(size_of) & (size_of > 0), size_of, np.nan)
            series.append(Series(label, table["step"], shown, "points", role))
    plots = []
    if series:
        with np.errstate(divide="ignore", over="ignore"):
            limit = s["linear"] / table["furthest"]
        limit = np.where(limit > 0, limit, np.nan)
        series.append(Series("too large for a forecast above", table["step"], limit, role="muted"))
        plots.append(Plot(
            "reach", "Displacement of the start that flips a decision", "step",
            f"displacement of the start ({length})", tuple(series), y_scale="log",
            horizontals=((float(s["size"]), "asked for"),), caption=TEXTS("reach_caption"),
        ))  # fmt: skip
    what = [*size(view), ("Direction", TEXTS("direction")), ("Took", f"{number(s['seconds'], 2)} s")]
    sections = [
        Section("Displacements that flip a decision", plots),
        Section("Decisions", listed, terminal=True),
        Section("What was run", [pairs(what)]),
    ]
    sections = [one for one in sections if one.parts]
    return Page(f"{view.name}: forecast", TEXTS("forecast_about"), keys, sections, view.system_toml,
                view.folder.provenance)  # fmt: skip


VERBS = {
    "map": frame.Verb(judge_map, page_map),
    "forecast": frame.Verb(judge_forecast, page_forecast),
}
