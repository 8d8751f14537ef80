"""report.html of a neighbor list: what it got right, what it got wrong, and the scripts that show it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mdnum.report.axes import PAGE_WIDTH, drawn
from mdnum.report.conform.findings import conventions, judge, silent
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, load, took, write_page
from mdnum.report.svg import FIRST, INK, MUTED, SECOND
from mdnum.report.words import count, heading, many, number
from mdnum.store import RunFolder
from mdnum.store.atomic import read_text

_TOLD = 3  # reasons of not answering that a row tells


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no finished examination in the folder, or it cannot be written.
    """
    folder, run = load(folder, "conform", "conform")
    title = "Cases by what they are about"
    return write_page(
        folder,
        run,
        judge(run),
        "conform/run.html.j2",
        {"areas": (title, partial(areas, run), [])},
        captions={
            "areas": "Cases asked, by what they are about: right, wrong, without an answer, and refused by "
            "the list itself. Beside the bars, how many are wrong or without an answer."
        },
        figures=list(_key_figures(run)),
        about=[_area(row) for row in run.summary["areas"]],
        failures=[_failure(folder.path, row) for row in run.summary["failures"]],
        conventions=list(conventions(run)),
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges an examination and writes headline and findings into its summary.json."""
    folder, run = load(folder, "conform", "conform")
    judged = judge(run)
    judged.store(folder, run.summary)
    return judged


def areas(run: Question, width: float = PAGE_WIDTH) -> Figure:
    """A bar per area: right, wrong, refused."""
    rows = len(run.summary["areas"])
    height = 0.9 + 0.27 * rows if width >= PAGE_WIDTH else 1.1 + 0.33 * rows
    figure = drawn(partial(_bars, run), height, width)
    # lines along the bars would strike through the numbers beside them
    figure.axes[0].grid(visible=False, axis="y")
    return figure


def _bars(run: Question, figure: Figure) -> None:
    axes = figure.subplots()
    rows = [row for row in run.summary["areas"] if row["asked"]]
    place = np.arange(len(rows))[::-1]
    # a share of each area: one of 100,000 atoms counts as much as 500 drawn at random
    for at, row in zip(place, rows, strict=True):
        left = 0.0
        for cases, color, alpha in (
            (row["passed"], FIRST, 0.75),
            (row["refused"], MUTED, 0.45),
            (silent(row), SECOND, 0.45),
            (row["failed"] - silent(row), SECOND, 0.9),
        ):
            # a case that fails is never too small to be seen
            share = max(cases / row["asked"], 0.006) if cases else 0.0
            axes.barh(at, share, left=left, height=0.6, color=color, alpha=alpha, lw=0)
            left += share
        text = f"{row['failed']:,} of {row['asked']:,}" if row["failed"] else f"{row['asked']:,}"
        axes.annotate(
            text, (1.0, at), (6, 0), textcoords="offset points", fontsize=8, va="center", color=INK,
            annotation_clip=False,
        )  # fmt: skip
    for name, color, alpha in (
        ("right", FIRST, 0.75), ("refused", MUTED, 0.45), ("no answer", SECOND, 0.45), ("wrong", SECOND, 0.9),
    ):  # fmt: skip
        axes.barh(0, 0, color=color, alpha=alpha, label=name)
    axes.set_yticks(place, [row["area"] for row in rows], fontsize=8.5)
    axes.set_xlim(0, 1.16 if figure.get_figwidth() >= PAGE_WIDTH else 1.3)
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0], ["0", "25 %", "50 %", "75 %", "100 %"])
    axes.set_xlabel("share of the cases asked", color=INK)
    axes.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=4, frameon=False, fontsize=8)


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the figure."""
    summary = run.summary
    right = sum(row["passed"] for row in summary["areas"])
    yield "Right", count(right), f"of {many(summary['asked'], 'case')}"
    kinds = many(len(summary["failures"]), "kind")
    mute = sum(silent(row) for row in summary["areas"])
    if mute:
        yield "No answer", count(mute), "ends the process, takes too long or raises"
    yield (
        "Wrong",
        count(summary["wrong"] - mute),
        f"{kinds}, shrunk" if summary["failures"] else "nothing to show",
    )
    skipped = sum(row["skipped"] for row in summary["areas"])
    yield "Not asked", count(skipped), "outside of what it claims"
    if summary["large"]:
        yield (
            "Largest",
            f"{count(summary['large']['atoms'])} atoms",
            f"{number(summary['large']['seconds'], 2)} s",
        )


def _area(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the table of areas."""
    why = [f"{one['why']} ({count(one['cases'])})" for one in row["why"][:_TOLD]]
    if len(row["why"]) > _TOLD:
        why.append("…")
    return {
        "name": heading(row["area"]),
        "about": row["about"],
        "cells": [
            count(cases) if cases else "–"
            for cases in (
                row["asked"],
                row["failed"] - silent(row),
                silent(row),
                row["refused"],
                row["skipped"],
            )
        ],
        "bad": bool(row["failed"]),
        "why": "; ".join(why),
    }


def _failure(folder: Path, row: Mapping[str, Any]) -> dict[str, Any]:
    """A failure with its script."""
    # a name of a file, wherever else the table would have it
    path = folder / Path(row["script"]).name
    size = many(row["atoms"], "atom") + (f", {many(row['steps'], 'step')}" if row["steps"] > 1 else "")
    return {
        **row,
        "size": size,
        "lines": read_text(path),
    }


def _what(run: Question) -> Iterator[tuple[str, str]]:
    summary = run.summary
    if summary["about"]:
        yield "List", summary["about"]
    if summary["package"]:
        yield "Package", f"{summary['package']} {summary['version'] or ''}".strip()
    kind = "allocated once and brought up to date" if summary["kept"] else "made anew at every question"
    yield "Kind", kind
    yield "Random cases", f"drawn by hypothesis, seed {summary['seed']}"
    yield (
        "Oracle",
        "all pairs and all images by brute force, in rational arithmetic near the cutoff; lattices of whole "
        "numbers by counting",
    )
    yield took(run)
