"""The parameter map: a run as a piecewise function of a number, as a page, from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.map_figures import captions, detail, jumps, numbered, parameter_map, with_unit
from mdnum.report.fork.question import Question, declared, load, size_of, took, verdict, write_page
from mdnum.report.verdict import Finding
from mdnum.report.words import count, listed, many, number
from mdnum.store import RunFolder


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no map in the folder, or it cannot be written.
    """
    folder, run = load(folder, "along")
    plots = {"map": parameter_map(run), "detail": detail(run), "jumps": jumps(run)}
    return write_page(
        folder,
        run,
        judge(run),
        "fork/map.html.j2",
        {name: declared(plot) for name, plot in plots.items() if plot is not None},
        captions=captions(run),
        figures=list(_key_figures(run)),
        boundaries=[_boundary(edge) for edge in run.summary["boundaries"]],
        bounds=_bounds(run.summary["boundaries"]),
        numbered=numbered(run),
        ball="balls" in run.summary,
        intervals=[_interval(one) for one in run.summary["intervals"]],
        unresolved=[f"{low!r} to {high!r}" for low, high in run.summary["unresolved"]],
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a map and writes headline and findings into its summary.json."""
    folder, run = load(folder, "along")
    judged = judge(run)
    judged.store(folder, run.summary)
    return judged


# --- verdict ------------------------------------------------------------------------------------------


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of a map."""
    edges = run.summary["boundaries"]
    quiet = not edges and not run.summary["unresolved"]
    return verdict(_headline(run), _evidence(run), _findings(run), plain_tone="good" if quiet else "info")


def _headline(run: Question) -> str:
    summary, edges = run.summary, run.summary["boundaries"]
    where = f"between {summary['key']} = {summary['low']!r} and {summary['high']!r}"
    if _all_failed(summary):
        # runs that end alike at once say nothing of decisions
        said = "what changes is how they fail" if edges else "nothing was mapped"
        return f"All {many(summary['evaluations'], 'run')} {where} blew up: {said}."
    if not edges:
        if summary["unresolved"]:
            return f"No decision was found to change {where}, and yet the runs at its ends fail differently."
        return f"One history: no decision of {many(run.steps, 'step')} changes {where}."
    places = many(len(edges), "place")
    if summary["unresolved"]:
        places += f" and more {where}, as far as they were searched for"
        return f"The decisions of {many(run.steps, 'step')} change at {places}."
    return f"The decisions of {many(run.steps, 'step')} change at {places} {where}."


def _all_failed(summary: Mapping[str, Any]) -> bool:
    return bool(summary["failed_runs"]) and summary["failed_runs"] == summary["evaluations"]


def _far(summary: Mapping[str, Any]) -> str:
    """That an interval is nowhere near the system's own value; "" where it is."""
    own, low, high = summary.get("value"), summary["low"], summary["high"]
    if own is None or low <= own <= high:
        return ""
    far = " far" if min(abs(low - own), abs(high - own)) > max(high - low, 0.1 * abs(own)) else ""
    return f"The interval is{far} {'above' if own < low else 'below'} the system's own value, {own!r}."


def _evidence(run: Question) -> Iterator[str]:
    summary, edges = run.summary, run.summary["boundaries"]
    if _all_failed(summary):
        if far := _far(summary):
            yield far
        return
    jumping = [edge for edge in edges if edge["jump"] is not None]
    if jumping:
        largest = max(jumping, key=lambda edge: abs(edge["jump"]))
        yield (
            f"The largest jump of the {summary['loss']} is "
            f"{number(largest['jump'], 3, signed=True)} {summary['loss_unit']}".rstrip()
            + f", where {largest['says']} at step {count(largest['step'])}."
        )
        known = "the jumps that were found" if summary["unresolved"] else "the jumps"
        total = number(sum(edge["jump"] for edge in jumping), 3, signed=True)
        ends = (summary["intervals"][-1]["loss_high"], summary["intervals"][0]["loss_low"])
        if None not in ends:
            change = number(ends[0] - ends[1], 3, signed=True)
            yield (
                f"From end to end the {summary['loss']} changes by {change}; {known} add up to {total}. "
                "A derivative of the program knows nothing of them."
            )
    if edges and summary["confirm"] and summary["confirmed"] == len(edges):
        yield (
            "Each boundary lies between two adjacent floats, and a fresh process finds the same history on "
            "either side."
        )
    if summary["complete"]:
        yield "Every float of the interval was run: nothing can hide."
    else:
        yield (
            f"{count(summary['evaluations'])} runs; two boundaries that undo each other within "
            f"{number(summary['resolution'], 2)} {summary['key_unit']}".rstrip()
            + " may have been missed."
        )


def _findings(run: Question) -> Iterator[Finding]:
    summary, edges = run.summary, run.summary["boundaries"]
    moved = [edge for edge in edges if edge["confirmed"] == "no"]
    if moved:
        places = ", ".join(repr(edge["above"]) for edge in moved[:4])
        yield Finding(
            "NOT_REPRODUCED",
            "warning",
            f"{many(len(moved), 'boundary', 'boundaries')} elsewhere in a fresh process",
            f"A process of its own decides otherwise beside {places}: the two programs do not round alike.",
            ""
            if "balls" in summary
            else "Run `mdnum fork SYSTEM --processes`: it tells which programs agree.",
        )
    if edges and not summary["confirm"]:
        yield Finding(
            "NOT_CONFIRMED", "info", "no boundary was confirmed in a fresh process", "It was not asked for."
        )
    left = [ends for ends in summary["unresolved"] if np.nextafter(ends[0], np.inf) < ends[1]]
    if left:
        yield Finding(
            "MORE_BOUNDARIES",
            "info",
            f"{many(len(left), 'more stretch', 'more stretches')} with a change of history",
            f"The search stopped after {many(len(edges), 'boundary', 'boundaries')}, at {left[0][0]!r}. "
            "The ends of these stretches were decided differently.",
            "Allow more with --most, or search a narrower interval or fewer steps.",
        )
    if summary["failed_runs"]:
        yield Finding(
            "RUNS_FAILED",
            "warning",
            f"{many(summary['failed_runs'], 'run')} of {count(summary['evaluations'])} ended in a blow-up",
            "No value of the interval can be run to the last step."
            if _all_failed(summary)
            else "Part of the interval cannot be run to the last step, and has no loss there.",
            f"{_far(summary)} Search an interval of values that can be run, or fewer steps.".lstrip(),
        )


# --- tables -------------------------------------------------------------------------------------------


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the figure."""
    summary, edges = run.summary, run.summary["boundaries"]
    more = len(summary["unresolved"])
    yield (
        "Boundaries",
        count(len(edges)),
        f"{count(more)} more not searched" if more else "to adjacent floats",
    )
    yield "Histories", count(summary["histories"]), "distinct, of all decisions"
    yield (
        "Largest jump",
        number(summary["jump_largest"], 3),
        f"of the {summary['loss']}{', ' + summary['loss_unit'] if summary['loss_unit'] else ''}",
    )
    if summary["apart_largest"] is None:
        yield "Resolution", number(summary["resolution"], 2), f"of the grid, {summary['key']}"
    else:
        yield "Final states", number(summary["apart_largest"], 3), f"{run.units.length} apart at most"
    sure = summary["confirmed"]
    yield "Confirmed", "–" if sure is None else f"{count(sure)} of {count(len(edges))}", "in a fresh process"
    yield "Runs", count(summary["evaluations"]), f"{number(summary.get('seconds'), 2)} s in all"


def _boundary(edge: Mapping[str, Any]) -> dict[str, Any]:
    """A boundary as text."""
    return {
        "below": repr(edge["below"]),
        "above": repr(edge["above"]),
        "step": count(edge["step"]),
        "who": edge["who"],
        "way": edge["way"],
        "also": f"+ {count(edge['also'])}" if edge["also"] else "",
        "margin_below": number(edge["margin_below"], 2, signed=True),
        "margin_above": number(edge["margin_above"], 2, signed=True),
        "jump": number(edge["jump"], 3, signed=True),
        "apart": number(edge["apart"], 2),
        "gradient_below": number(edge.get("gradient_below"), 3, signed=True),
        "gradient_above": number(edge.get("gradient_above"), 3, signed=True),
        "confirmed": edge["confirmed"],
    }


def _bounds(edges: Sequence[Mapping[str, Any]]) -> str:
    """The rounding bounds of the margins, in words; they differ from one kind of pair to another only."""
    known = sorted({number(edge["bound"], 2) for edge in edges if edge["bound"] is not None})
    return f"; rounding bound{'s' if len(known) > 1 else ''} {listed(known)}" if known else ""


def _interval(one: Mapping[str, Any]) -> dict[str, str]:
    """An interval as text."""
    return {
        "low": repr(one["low"]),
        "high": repr(one["high"]),
        "width": number(one["high"] - one["low"], 3),
        "history": count(one["history"] + 1),
        "loss_low": number(one["loss_low"], 6),
        "loss_high": number(one["loss_high"], 6),
        "runs": count(one["runs"]),
    }


def _what(run: Question) -> Iterator[tuple[str, str]]:
    summary, unit = run.summary, run.summary["key_unit"]
    yield from size_of(run)
    own = f"; the system’s own is {summary['value']!r}" if summary.get("value") is not None else ""
    yield "Number", f"{with_unit(summary['key'], unit)} from {summary['low']!r} to {summary['high']!r}{own}"
    yield "Loss", f"{with_unit(summary['loss'], summary['loss_unit'])} of the last step"
    if "balls" in summary:
        yield "Program", "a grid at once by a vectorized one; bisection by the one that `mdnum ball` runs"
        yield took(run)
        return
    program = (
        "searched in a twin of the program that is given the cutoff, as the program proper is compiled for "
        "each; confirmed in the program proper"
        if summary.get("compiles")
        else "one compiled program, the one that `mdnum run` runs"
    )
    yield "Program", program
    yield took(run)
