"""report.html of a gradient: how large it is by each method, how it grows, what the flips add."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, declared, load, size_of, took, write_page
from mdnum.report.grad import figures as drawn
from mdnum.report.grad import findings, sections
from mdnum.report.grad.words import (
    EXACT,
    by,
    difference,
    digits_note,
    half,
    slope,
    slope_unit,
    value_text,
)
from mdnum.report.words import count, heading, number
from mdnum.store import RunFolder


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no gradient in the folder, or it cannot be written.
    """
    folder, run = load(folder, "grad", "grad")
    browsed = sections.flips(run)
    return write_page(
        folder,
        run,
        findings.judge(run),
        "grad/run.html.j2",
        {name: declared(plot) for name, plot in drawn.plots(run).items()},
        captions=drawn.captions(run),
        figures=list(_key_figures(run)),
        parameters=[_parameter(run, one) for one in run.summary["parameters"]],
        methods=list(_methods(run)),
        differences=list(sections.differences(run)),
        shares=sections.shares(run),
        edges=list(sections.edges(run)),
        left=[one for one in run.summary["left_out"] if one["how"]],
        never=[(one["what"], one["why"]) for one in run.summary["left_out"] if not one["how"]],
        browsed=browsed,
        rows_shown=sections.TABLE_ROWS,
        scripted=browsed is not None,
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a gradient and writes headline and findings into its summary.json."""
    folder, run = load(folder, "grad", "grad")
    judged = findings.judge(run)
    judged.store(folder, run.summary)
    return judged


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the verdict."""
    summary = run.summary
    loss = summary["loss"]
    yield (
        loss["word"].upper() if len(loss["word"]) <= 4 else loss["word"],
        number(summary["value"], 4),
        loss["unit"],
    )
    reference = by(run, summary["reference"])
    for one in summary["parameters"][:4]:
        small = [slope_unit(summary, one), digits_note(summary, one["name"])]
        yield (
            f"by {one['name']}",
            slope(summary, reference, one["name"], 4),
            ", ".join(part for part in small if part),
        )
    details = {} if reference is None else reference["details"]
    if "crossings" in details:
        yield "Flips on the way", count(details["crossings"]), f"{count(details['grazing'])} of them grazing"


def _parameter(run: Question, one: Mapping[str, Any]) -> dict[str, str]:
    """A column of the table of methods."""
    unit = slope_unit(run.summary, one)
    entries = one.get("entries")
    return {"name": one["name"], "unit": f"{unit}, by {', '.join(entries)}" if entries else unit}


def _methods(run: Question) -> Iterator[dict[str, Any]]:
    """A row for each method, the reference first."""
    summary = run.summary
    rows = sorted(summary["methods"], key=lambda one: one["method"] != summary["reference"])
    if summary.get("exact"):
        cells = [(number(summary["exact"].get(one["name"]), 6), ("", "")) for one in summary["parameters"]]
        yield {"method": "closed form", "says": EXACT, "cells": cells}
    for one in rows:
        first = one["method"] == summary["reference"]
        cells = [
            (
                slope(summary, one, each["name"]),
                (digits_note(summary, each["name"]),)
                if first
                else difference(run, one["method"], each["name"])[:2],
            )
            for each in summary["parameters"]
        ]
        yield {"method": one["method"], "says": one["says"], "cells": cells}
        shorter = half(summary)
        if shorter is not None and first:
            cells = [(slope(summary, shorter, each["name"]), ("", "")) for each in summary["parameters"]]
            yield {"method": shorter["method"], "says": shorter["says"], "cells": cells}


def _what(run: Question) -> Iterator[tuple[str, str]]:
    summary = run.summary
    yield from size_of(run)
    loss = summary["loss"]
    yield "Loss", f"{loss['about']} ({loss['unit']})" if loss["unit"] else loss["about"]
    for one in summary["parameters"]:
        if text := value_text(one):
            yield heading(one["name"]), text
    yield took(run)
