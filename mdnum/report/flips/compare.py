"""report.html of two trajectories: when their neighbor sets differ first, and what that does not say."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.ball.demos.base import Plot, Series
from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.flips.conclusions import cannot, concluded, findings, headline
from mdnum.report.flips.html import load
from mdnum.report.flips.words import frame, length, rule_words
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, declared, verdict, write_page
from mdnum.report.words import count, many, number
from mdnum.store import RunFolder

_TABLES = ("apart", "differing")


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no finished comparison in the folder, or it cannot be written.
    """
    folder, run = load(folder, "flips-compare", _TABLES)
    browsed = _pairs(run)
    drawn = {"separation": _separation(run), "differing": _differing(run)}
    return write_page(
        folder,
        _with_words(run),
        _judge(run),
        "flips/compare.html.j2",
        {name: declared(plot) for name, plot in drawn.items() if plot is not None},
        captions={
            "separation": "Largest and root mean square distance between an atom in A and the same atom in "
            "B, nearest images; up to the dashed line the files’ resolution explains it.",
            "differing": "Pairs inside in one trajectory only, and all pairs inside in A.",
        },
        figures=list(_key_figures(run)),
        cannot=list(cannot(run)),
        browsed=browsed,
        scripted=browsed is not None,
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a comparison and writes headline and findings into its summary.json."""
    folder, run = load(folder, "flips-compare", _TABLES)
    judged = _judge(run)
    judged.store(folder, _with_words(run).summary)
    return judged


def _judge(run: Question) -> Verdict:
    return verdict(headline(run), concluded(run), findings(run))


def _with_words(run: Question) -> Question:
    """With what is concluded in the summary, for the command line."""
    told = {"concluded": list(concluded(run)), "cannot": list(cannot(run))}
    frames = {
        "first_frame": (run.summary["first"] or {}).get("frame"),
        "certain_frame": run.summary["certain"],
    }
    told |= {name: None if at is None else frame(run, at) for name, at in frames.items()}
    summary = {**run.summary, **told}
    return Question(run.path, summary, run.system_toml, run.provenance, run.tables)


def _axis(run: Question) -> tuple[str, np.ndarray]:
    table = run.tables["apart"]
    if run.summary["timed"] and np.all(np.diff(table["time"]) > 0):
        return f"time ({run.summary['time']})", table["time"]
    return "frame", table["frame"]


def _marks(run: Question, x: np.ndarray) -> tuple[tuple[float, str], ...]:
    summary = run.summary
    marks = []
    if summary["beyond"]:
        marks.append((float(x[summary["beyond"]]), "positions differ"))
    if summary["first"] is not None:
        marks.append((float(x[summary["first"]["frame"]]), "sets differ"))
    return tuple(marks)


def _separation(run: Question) -> Plot | None:
    table = run.tables["apart"]
    if len(table["frame"]) < 2 or not table["furthest"].any():
        return None
    label, x = _axis(run)
    unit = run.summary["length"]
    series = (
        Series("furthest atom", x, table["furthest"]),
        Series("root mean square", x, table["typical"], role="second"),
        Series("explained by resolution", x, table["bound"], role="muted", dashed=True),
    )
    title = f"separation ({unit})" if unit else "separation"
    return Plot("How far apart the two are", label, title, series, y_scale="log", verticals=_marks(run, x))


def _differing(run: Question) -> Plot | None:
    table = run.tables["apart"]
    only = (table["only_a"] + table["only_b"]).astype(float)
    if len(only) < 2 or not only.any():
        return None
    label, x = _axis(run)
    series = (
        Series("inside in one only", x, only, role="bad"),
        Series("inside in A", x, table["pairs_a"].astype(float), role="muted", dashed=True),
    )
    return Plot("Pairs that differ", label, "pairs", series, y_scale="log", verticals=_marks(run, x))


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    summary = run.summary
    first = summary["first"]
    seed = summary["seed"]
    at_all = "the same bit for bit" if seed is None else f"at all from {frame(run, seed)} on"
    yield "Positions differ", _frame(summary["beyond"]), f"first frame, beyond resolution; {at_all}"
    yield "Sets differ", "never" if first is None else _frame(first["frame"]), "first frame"
    if first is not None:
        yield "Sets differ for certain", _frame(summary["certain"]), "first frame, beyond resolution"
        yield "Pairs then", count(first["pairs"]), f"{count(first['ambiguous'])} within the resolution"
        yield "Apart then", length(run, first["furthest"]), "furthest atom"
    yield "Apart at the end", length(run, summary["last"]["furthest"]), "furthest atom"


def _frame(at: int | None) -> str:
    return "never" if at is None else count(at)


def _pairs(run: Question) -> Browse | None:
    """Pairs that came to differ; None where none did."""
    table = run.tables["differing"]
    if not len(table["i"]):
        return None
    inside = (table["inside"] == "B").astype(int)
    names = ("distance_a", "distance_b", "margin_a", "margin_b")
    columns: list[tuple[np.ndarray, int | None]] = [
        (table["frame"].astype(int), None), (table["i"].astype(int), None), (table["j"].astype(int), None),
        (inside, None), *((table[name], 6) for name in names), (table["ambiguous"].astype(int), None),
    ]  # fmt: skip
    unit = run.summary["length"]
    return Browse(
        name="pairs",
        row_id="pair-rows",
        label="Search pairs",
        placeholder="3-17, atom 5, frame:100..200, undecidable",
        columns=(
            Column(0, "frame", kind="count"),
            Column(1, "pair", kind="pair"),
            Column(3, "inside in", kind="word", words=("A only", "B only")),
            *(Column(4 + at, name.replace("_a", " in A").replace("_b", " in B"), unit, digits=5)
              for at, name in enumerate(names)),
            Column(8, "", kind="word", words=("", "undecidable")),
        ),
        rows=plain_rows(columns),
        words={"undecidable": (8, 1)},
        ranges={"frame": 0},
        subjects=(1, 2),
        nouns=("atom", "pair"),
    )  # fmt: skip


def _what(run: Question) -> Iterator[tuple[str, str]]:
    summary: Any = run.summary
    yield "A", f"{summary['file']} ({summary['format']}); {summary['resolution']['words']}"
    yield "B", f"{summary['other_file']} ({summary['other_format']}); {summary['other_resolution']['words']}"
    yield "Size", f"{many(summary['atoms'], 'atom')}, {many(summary['frames'], 'frame')} of both"
    if summary["between"]:
        yield "Between", " and ".join(f"“{one}”" for one in summary["between"])
    yield "Inside", rule_words(run, summary)
    yield "Took", f"{number(summary['seconds'], 2)} s"
