"""Flips foretold by a tangent: the page of a forecast, from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.ball.demos.base import Plot, Series
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, declared, load, size_of, took, verdict, write_page
from mdnum.report.verdict import Finding
from mdnum.report.words import count, many, number, typeset
from mdnum.store import RunFolder


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no forecast in the folder, or it cannot be written.
    """
    folder, run = load(folder, "forecast")
    plot = reach(run)
    return write_page(
        folder,
        run,
        judge(run),
        "fork/forecast.html.j2",
        {} if plot is None else {"reach": declared(plot)},
        captions={
            "reach": "The smallest displacement, along the one direction that was followed, at which a "
            "decision of the step comes out otherwise: below the dashed line the one asked for flips it. "
            "Above the solid line the displacement has grown too large by then for a forecast. Where a flip "
            "kicks its atoms, nothing is foretold after the first one."
        },
        figures=list(_key_figures(run)),
        first=[_row(flip) for flip in run.summary["first"]],
        nearest=[_row(flip) for flip in run.summary["nearest"]],
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a forecast and writes headline and findings into its summary.json."""
    folder, run = load(folder, "forecast")
    judged = judge(run)
    judged.store(folder, run.summary)
    return judged


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of a forecast."""
    summary = run.summary
    size = f"{number(summary['size'], 2)} {run.units.length}"
    first, nearest = summary["first"], summary["nearest"]
    until, ends = _range(run)
    if first:
        flip = first[0]
        which = f"pair {flip['i']}–{flip['j']} at step {count(flip['step'])}"
        headline = f"A random displacement of {size} is expected to flip {which} first."
    elif until < 0:
        headline = f"Nothing is foretold of a random displacement of {size}."
    else:
        whole = f"in {many(run.steps, 'step')}" if ends == "end" else f"up to step {count(until)}"
        headline = f"A random displacement of {size} is expected to flip nothing {whole}."
    evidence = []
    if nearest:
        flip = nearest[0]
        evidence.append(
            f"Nearest to flipping is pair {flip['i']}–{flip['j']} at step {count(flip['step'])}: "
            f"{number(abs(flip['amplitude']), 2)} {run.units.length} will do, "
            f"{number(flip['ulps'], 2)} ulps of the start."
        )
    if "says" in summary:
        evidence.append(typeset(summary["says"]))
    return verdict(
        headline, evidence, _findings(run), plain_tone="info" if first or ends != "end" else "good"
    )


def _range(run: Question) -> tuple[int, str]:
    """The last step of which something is foretold, and why it is the last."""
    summary = run.summary
    if "until" in summary:
        return summary["until"], summary["ends"]
    # of folders that were written before a range ended with the first flip
    if summary["first"]:
        return summary["first"][0]["step"], "flip"
    return summary["linear_until"], "end" if summary["linear_until"] == run.steps else "size"


#: Code, title, text and remedy of what ends a forecast before the run, but for a flip.
_ENDS = {
    "size": (
        "NOT_LINEAR",
        "the displacement grows too large",
        "From there on it is more than half a percent of the cutoff: its square counts.",
        "Ask for a smaller displacement.",
    ),
    "close": (
        "TOO_CLOSE_TO_FORETELL",
        "whether a decision flips is within the error",
        "A decision of the step after comes out otherwise at very nearly the displacement asked for, and if "
        "it does, it kicks its atoms.",
        "Ask for a displacement that is a little larger or smaller.",
    ),
    "list": (
        "BEYOND_THE_LIST",
        "a pair that is not listed could come inside",
        "The atoms have used up so much of the skin that the displacement could bring in a pair from beyond "
        "the neighbor list, and such pairs are not looked at.",
        "Give a larger neighbors.skin.",
    ),
}


def _findings(run: Question) -> Iterator[Finding]:
    summary = run.summary
    until, ends = _range(run)
    if ends in _ENDS:
        code, title, text, remedy = _ENDS[ends]
        what = f"nothing is foretold beyond step {count(until)}" if until >= 0 else "nothing is foretold"
        yield Finding(code, "info", f"{what}: {title}", text, remedy)
    if summary["size"] < 8 * summary["ulp"]:
        yield Finding(
            "BELOW_ROUNDING",
            "warning",
            "the displacement is as small as rounding",
            f"An ulp of the largest start coordinate is {number(summary['ulp'], 2)} {run.units.length}; the "
            "rounding of the run itself perturbs as much.",
            "Ask for a larger displacement.",
        )


def reach(run: Question) -> Plot | None:
    """The displacement that flips a decision, by step."""
    table = run.tables["reach"]
    step = table["step"]
    signs = [
        (table[name], f"{word} along it")
        for name, word in (("positive", "forward"), ("negative", "backward"))
    ]
    series = []
    for (values, label), role in zip(signs, ("first", "second"), strict=True):
        shown = np.where(np.isfinite(values) & (np.abs(values) > 0), np.abs(values), np.nan)
        if np.isfinite(shown).any():
            which: Any = role
            series.append(Series(label, step, shown, mark="points", role=which))
    if not series:
        return None
    with np.errstate(divide="ignore", over="ignore"):
        limit = run.summary["linear"] / table["furthest"]
    limit = np.where(limit > 0, limit, np.nan)
    series.append(Series("too large for a forecast above", step, limit, role="muted"))
    return Plot(
        "Displacement of the start that flips a decision", "step",
        f"displacement of the start ({run.units.length})", tuple(series), y_scale="log",
        horizontals=((float(run.summary["size"]), "asked for"),),
    )  # fmt: skip


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the figure."""
    summary, length = run.summary, run.units.length
    first, nearest = summary["first"], summary["nearest"]
    yield "Displacement", number(summary["size"], 2), f"{length}, of the furthest atom"
    yield "First flip", f"step {count(first[0]['step'])}" if first else "–", "expected"
    yield (
        "Nearest decision",
        number(abs(nearest[0]["amplitude"]), 2) if nearest else "–",
        f"{length} flip it",
    )
    yield "In ulps", number(nearest[0]["ulps"], 2) if nearest else "–", "of the largest start coordinate"
    until = _range(run)[0]
    yield "Good until", f"step {count(until)}" if until >= 0 else "–", f"of {count(run.steps)}"
    yield "Took", f"{number(summary.get('seconds'), 2)} s", "one tangent run"


def _row(flip: Mapping[str, Any]) -> dict[str, str]:
    """A flip as text."""
    return {
        "step": count(flip["step"]),
        "pair": f"{flip['i']}–{flip['j']}",
        "amplitude": number(flip["amplitude"], 3, signed=True),
        "ulps": number(flip["ulps"], 3),
        "margin": number(flip["margin"], 3, signed=True),
    }


def _what(run: Question) -> Iterator[tuple[str, str]]:
    yield from size_of(run)
    yield (
        "Direction",
        "random displacements of all atoms, the furthest by the size asked for; a sign tells which way",
    )
    yield took(run)
