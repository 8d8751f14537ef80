"""report.html of two trajectories: when their neighbor sets differ first, and what that does not say."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.ball.demos.base import Plot, Series
from mdnum.errors import FolderError
from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.flips.compare_findings import findings
from mdnum.report.flips.conclusions import cannot, concluded, headline, views
from mdnum.report.flips.html import load
from mdnum.report.flips.words import frame, length, rule_words
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, declared, verdict, write_page
from mdnum.report.words import count, many, number
from mdnum.store import RunFolder

_TABLES = ("apart", "differing")
# what summary.json says of each rule, and what else a page cannot be without
_OF_A_RULE = ("rule", "first", "certain", "first_pairs", "growth")
_NEEDED = (*_OF_A_RULE, "seed", "beyond", "other_box", "resolution", "other_resolution", "in_file", "last")


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no finished comparison in the folder, or it cannot be written.
    """
    folder, run = _loaded(folder)
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
            "differing": f"Pairs inside in one trajectory only, and all pairs inside in A{_of_first(run)}.",
        },
        figures=list(_key_figures(run)),
        cannot=list(cannot(run)),
        rules=list(_rules(run)),
        browsed=browsed,
        scripted=browsed is not None,
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a comparison and writes headline and findings into its summary.json."""
    folder, run = _loaded(folder)
    judged = _judge(run)
    judged.store(folder, _with_words(run).summary)
    return judged


def _loaded(folder: RunFolder | str | Path) -> tuple[RunFolder, Question]:
    """The folder and what a page needs of it.

    Raises:
        FolderError: nothing in it was finished, or an older mdnum left out what a page needs by now.
    """
    folder, run = load(folder, "flips-compare", _TABLES)
    missing = [name for name in _NEEDED if name not in run.summary]
    missing += [name for name in ("bound", "time_b") if name not in run.tables["apart"]]
    if missing:
        raise FolderError(
            f"this comparison was written by another version of mdnum and lacks {', '.join(missing)}",
            remedy=f"Compare again: mdnum flips {run.summary.get('file', 'A')} "
            f"{run.summary.get('other_file', 'B')}; the report that is there stays as it is",
            where=str(folder.path),
        )
    # one rule was all there was, once
    summary = run.summary
    rules = summary.get("rules") or [{name: summary[name] for name in _OF_A_RULE}]
    return folder, Question(run.path, {**summary, "rules": rules}, "", run.provenance, run.tables)


def _of_first(run: Question) -> str:
    """Which rule a figure is about, where there are several."""
    return f" ({rule_words(run, run.summary)})" if len(run.summary["rules"]) > 1 else ""


def _rules(run: Question) -> Iterator[tuple[str, ...]]:
    """Rows of the table of rules; none where there is one."""
    if len(run.summary["rules"]) < 2:
        return
    for one in views(run):
        first, certain = one.summary["first"], one.summary["certain"]
        pairs = "–" if first is None else count(first["pairs"])
        undecided = "–" if first is None else count(first["ambiguous"])
        frames = (_frame(None if first is None else first["frame"]), _frame(certain))
        yield rule_words(one, one.summary), frames[0], pairs, undecided, frames[1]


def _judge(run: Question) -> Verdict:
    return verdict(headline(run), concluded(run), findings(run))


def _with_words(run: Question) -> Question:
    """With what is concluded in the summary, for the command line."""
    rules = [{**one, **_named(run, one)} for one in run.summary["rules"]]
    told = {"concluded": list(concluded(run)), "cannot": list(cannot(run)), "rules": rules}
    summary = {**run.summary, **told, **_named(run, run.summary)}
    return Question(run.path, summary, run.system_toml, run.provenance, run.tables)


def _named(run: Question, one: Mapping[str, Any]) -> dict[str, str | None]:
    """The frames at which the sets of a rule come to differ, in words."""
    frames = {"first_frame": (one["first"] or {}).get("frame"), "certain_frame": one["certain"]}
    return {name: None if at is None else frame(run, at) for name, at in frames.items()}


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
    small = f"first frame{_of_first(run)}"
    yield "Sets differ", "never" if first is None else _frame(first["frame"]), small
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
        (table["rule"].astype(int), None),
    ]  # fmt: skip
    several = len(run.summary["rules"]) > 1
    rules = tuple(rule_words(one, one.summary) for one in views(run))
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
            Column(4, "r in A", unit, digits=5),
            Column(5, "r in B", unit, digits=5),
            Column(6, "margin in A", unit),
            Column(7, "margin in B", unit),
            Column(8, "decided", kind="word", words=("yes", "no")),
            *((Column(9, "rule", kind="word", words=rules),) if several else ()),
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
    for one in views(run):
        yield "Inside", rule_words(one, one.summary)
    yield "Took", f"{number(summary['seconds'], 2)} s"
