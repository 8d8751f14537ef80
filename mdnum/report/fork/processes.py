"""Which programs of a system agree: the page of variants in processes of their own, from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mdnum.ball.demos.base import Plot, Series
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, declared, load, size_of, took, verdict, write_page
from mdnum.report.verdict import Finding
from mdnum.report.words import count, many, number
from mdnum.store import RunFolder

_ROLES: tuple[Literal["first", "second", "third", "bad", "ink", "muted"], ...] = (
    "first", "second", "third", "bad", "ink", "muted",
)  # fmt: skip
_PROGRAMS = {
    "scan": "one compiled loop over the steps",
    "rollout": "mdnum’s own epochs, those of any run",
    "vmap": "the first of a batch of equal copies",
    "grad": "the primal inside value_and_grad",
    "eager": "operation by operation, nothing compiled together",
}


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no comparison of programs in the folder, or it cannot be written.
    """
    folder, run = load(folder, "processes")
    plot = separations(run)
    return write_page(
        folder,
        run,
        judge(run),
        "fork/processes.html.j2",
        {} if plot is None else {"separations": declared(plot)},
        captions={
            "separations": "Largest distance of an atom from where the reference has it. A line stands for "
            "all programs of a cluster: they have the same bits at every step that they ran."
        },
        figures=list(_key_figures(run)),
        programs=[_row(run, row) for row in _ordered(run)],
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a comparison of programs and writes headline and findings into its summary.json."""
    folder, run = load(folder, "processes")
    judged = judge(run)
    judged.store(folder, run.summary)
    return judged


# --- verdict ------------------------------------------------------------------------------------------


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of a comparison of programs."""
    summary = run.summary
    clusters, failed = summary["clusters"], summary["failed_variants"]
    ran = len(summary["variants"]) - len(failed)
    if len(clusters) == 1:
        headline = f"All {count(ran)} programs have the same bits in {many(run.steps, 'step')}."
        if ran == 1:
            headline = f"One program alone ran, {summary['reference']}: there is nothing to compare it with."
    else:
        seeds = [row["seed"] for row in summary["variants"] if row["seed"] is not None]
        headline = (
            f"{count(ran)} programs of one system compute {count(len(clusters))} different trajectories; "
            f"the first bits differ at step {count(min(seeds))}."
        )
    tone = "good" if len(clusters) == 1 and ran > 1 else "info"
    causes = [sentence.replace("'", "’") for sentence in summary["causes"]]
    return verdict(headline, causes, _findings(run), plain_tone=tone)


def _findings(run: Question) -> Iterator[Finding]:
    for row in run.summary["variants"]:
        if row["failed"]:
            yield Finding(
                "VARIANT_FAILED",
                "warning",
                f"{row['variant']} did not run",
                f"Its process said: {row['failed']}",
                "The others are compared without it.",
            )
    asked = run.summary["steps_asked"]
    if run.steps < asked:
        yield Finding(
            "SKIN_USED_UP",
            "info",
            f"compared up to step {count(run.steps)} of {count(asked)}",
            "All programs use one list, and stop before an atom has used up its skin.",
        )


# --- figure -------------------------------------------------------------------------------------------


def separations(run: Question) -> Plot | None:
    """How far each cluster is from the reference, by step."""
    table = run.tables["variant_separations"]
    series = []
    for number_, names in enumerate(run.summary["clusters"]):
        parts = [table["variant"] == name for name in names]
        longest = max(parts, key=np.count_nonzero)
        step, apart = table["step"][longest], table["separation"][longest]
        if number_ == 0 or not np.any(apart > 0):
            continue
        role = _ROLES[(number_ - 1) % len(_ROLES)]
        shown = np.where(apart > 0, apart, np.nan)
        series.append(Series("; ".join(names), step, shown, mark="line", role=role))
    if not series:
        return None
    return Plot(
        "Programs and the reference part",
        "step",
        f"largest distance from the reference ({run.units.length})",
        tuple(series),
        y_scale="log",
    )


# --- tables -------------------------------------------------------------------------------------------


def _ordered(run: Question) -> list[Mapping[str, Any]]:
    """Variants by cluster, those that failed last."""
    return sorted(run.summary["variants"], key=lambda row: (row["cluster"] is None, row["cluster"] or 0))


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the figure."""
    summary = run.summary
    rows = [row for row in summary["variants"] if not row["failed"]]
    seeds = [row["seed"] for row in rows if row["seed"] is not None]
    failed = len(summary["failed_variants"])
    yield "Programs", count(len(rows)), f"{count(failed)} more did not run" if failed else "all ran"
    yield "Trajectories", count(len(summary["clusters"])), "that differ in a bit"
    yield "With the reference", count(len(summary["clusters"][0])), f"{summary['reference']} included"
    yield "First bit", f"step {count(min(seeds))}" if seeds else "–", "differs" if seeds else "none differs"
    yield (
        "Furthest apart",
        number(max(row["separation"] for row in rows), 3),
        f"{run.units.length} at the last step",
    )
    yield "Took", f"{number(summary.get('seconds'), 2)} s", "two processes at a time"


def _row(run: Question, row: Mapping[str, Any]) -> dict[str, str]:
    """A variant as text."""
    told = [_PROGRAMS[row["program"]]]
    if row["reduction"]:
        told.append(f"force sums {row['reduction']}")
    reference = row["variant"] == run.summary["reference"]
    leaves = "none" if row["seed"] is None else count(row["seed"])
    return {
        "cluster": "–" if row["cluster"] is None else count(row["cluster"] + 1),
        "variant": row["variant"],
        "about": "; ".join(told),
        "flags": row["flags"],
        "failed": row["failed"],
        "seed": "–" if row["failed"] else "reference" if reference else leaves,
        "steps": "–" if row["failed"] else count(row["steps"]),
        "separation": number(row["separation"], 3),
        "hash": row["hash"][:12],
        "seconds": f"{number(row['seconds'], 2)} s",
    }


def _what(run: Question) -> Iterator[tuple[str, str]]:
    yield from size_of(run)
    yield (
        "Programs",
        "each in a process of its own, with one Verlet list for all steps, as wide as twice the skin where "
        "the box has room; clusters by a hash of the positions at every step",
    )
    yield took(run)
