"""report.html of two rollouts of a ball, or of all choices of one screened: from the folder alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mdnum.report import page
from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.fork import ball_figures, ball_words, findings, html, sections
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.run import ForkFolder, load
from mdnum.store import RunFolder

#: Rows of the table of decisions that the page carries.
TABLE_ROWS = 5_000


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a ball's fork folder and writes headline and findings into its summary.json."""
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    run = load(folder)
    verdict = _judge(run)
    verdict.store(folder, run.summary)
    return verdict


def _judge(run: ForkFolder) -> Verdict:
    return findings.judge(run) if run.screened else ball_words.judge(run)


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no comparison in the folder, or it cannot be written.
    """
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    run = load(folder)
    verdict = _judge(run)
    verdict.store(folder, run.summary)
    around = folder.read("around")
    return page.publish(
        folder.path,
        ball_figures.drawn(run, around),
        lambda pictures, notes: render(run, verdict, pictures, notes),
    )


def render(run: ForkFolder, verdict: Verdict, pictures: dict, notes: dict) -> str:
    """The page's text.

    Args:
        pictures: markup by the names that `ball_figures.drawn` gives; one that is missing is left out.
        notes: what each of them cannot show.
    """
    shared = {
        "run": run,
        "verdict": verdict,
        "pictures": pictures,
        "notes": notes,
        "captions": ball_figures.captions(run),
        "summary": run.summary,
        "what": list(ball_words.what(run)),
        "provenance": list(page.flat(run.provenance)),
    }
    if run.screened:
        return page.render(
            "fork/screen.html.j2",
            **shared,
            figures=list(html.ranked_figures(run)),
            ranking=list(html.ranking(run)),
            scripted=False,
        )
    decisions = _decisions(run)
    return page.render(
        "fork/ball.html.j2",
        **shared,
        figures=list(ball_words.key_figures(run)),
        decision=list(ball_words.decision(run)),
        runs=list(sections.runs(run)),
        shares=sections.shares(run),
        growth=list(sections.growth(run)),
        changes=ball_words.changes(run),
        decisions=decisions,
        total=int(run.summary.get("cross_flips") or 0),
        scripted=bool(decisions.rows),
    )


def _decisions(run: ForkFolder) -> Browse:
    """The first decisions that differ."""
    names = ("step", "channel", "ball", "a", "b", "margin_a", "margin_b", "bound_a", "bound_b")
    table = {name: run.flips.get(name, np.zeros(0))[:TABLE_ROWS] for name in names}
    channel = (table["channel"].astype(str) == "stop").astype(int)
    columns: list[tuple[np.ndarray, int | None]] = [(table["step"].astype(int), None), (channel, None)]
    columns += [(table[name].astype(int), None) for name in ("ball", "a", "b")]
    columns += [(table[name].astype(float), 4) for name in ("margin_a", "margin_b")]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = [np.abs(table[f"margin_{one}"].astype(float) / table[f"bound_{one}"]) for one in "ab"]
        smallest = np.fmin(*ratios)
    columns.append((smallest, 3))
    return Browse(
        name="decisions",
        row_id="decision-rows",
        label="Search decisions",
        placeholder="ball 3, step:100..200, contact, stop, ambiguous",
        columns=(
            Column(0, "step", kind="count"),
            Column(1, "decision", kind="word", words=("contact", "stop")),
            Column(2, "ball", kind="count"),
            Column(3, "in A", kind="count"),
            Column(4, "in B", kind="count"),
            Column(5, "margin in A"),
            Column(6, "margin in B"),
            Column(7, "margin", "÷ bound", digits=2, missing="∞"),
        ),
        rows=plain_rows(columns),
        words={"contact": (1, 0), "stop": (1, 1)},
        ranges={"step": 0, "ball": 2},
        subjects=(2,),
        nouns=("ball",),
        ambiguous=7,
    )
