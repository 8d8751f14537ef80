"""Real runs against exact arithmetic: the page of a ranking of precision policies, from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mdnum.ball.demos.base import Plot, Series
from mdnum.report.axes import PAGE_WIDTH, drawn, folded
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Drawn, Question, declared, load, size_of, took, verdict, write_page
from mdnum.report.svg import FIRST, HALO, INK, MUTED
from mdnum.report.verdict import Finding
from mdnum.report.words import count, many, number, typeset
from mdnum.store import RunFolder

_ROLES = ("first", "second", "third", "bad", "ink", "muted")
#: Roles of numbers, as a policy names them.
_PARTS = ("state", "force", "decision", "accumulate")


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no ranking in the folder, or it cannot be written.
    """
    folder, run = load(folder, "certify")
    title = "Policies by the step at which they leave the exact history"
    pictures: dict[str, Drawn] = {"ranking": (title, partial(ranking, run), [])}
    plot = separations(run)
    if plot is not None:
        pictures["separations"] = declared(plot)
    return write_page(
        folder,
        run,
        judge(run),
        "fork/certify.html.j2",
        pictures,
        captions={
            "ranking": "Bars end at the first decision that the exact program makes otherwise; those that "
            "reach the edge kept to it. Circles: the first decision that rounding alone could have made "
            "otherwise.",
            "separations": "Largest distance of an atom from its place in exact arithmetic. A flip shows as "
            "a kink; before it only rounding grows.",
        },
        figures=list(_key_figures(run)),
        ranked=[_row(run, row) for row in run.summary["policies"]],
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a ranking and writes headline and findings into its summary.json."""
    folder, run = load(folder, "certify")
    judged = judge(run)
    judged.store(folder, run.summary)
    return judged


# --- verdict ------------------------------------------------------------------------------------------


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of a ranking."""
    policies = run.summary["policies"]
    left = [row for row in policies if row["horizon"] is not None]
    kept = len(policies) - len(left)
    if not left:
        headline = f"Every precision keeps the exact history of {many(run.steps, 'step')}."
    elif kept:
        first = min(left, key=lambda row: row["horizon"])
        verb = "keeps" if kept == 1 else "keep"
        headline = (
            f"{count(kept)} of {many(len(policies), 'precision')} {verb} the exact history of "
            f"{many(run.steps, 'step')}; {first['name']} leaves it first, at step {count(first['horizon'])}."
        )
    else:
        best, worst = policies[0], policies[-1]
        headline = (
            f"No precision keeps the exact history of {many(run.steps, 'step')}: {best['name']} leaves it at "
            f"step {count(best['horizon'])}, {worst['name']} at step {count(worst['horizon'])}."
        )
    says = [typeset(sentence) for sentence in run.summary["says"]]
    return verdict(headline, says, _findings(run), plain_tone="info" if left else "good")


def _findings(run: Question) -> Iterator[Finding]:
    for row in run.summary["policies"]:
        if row["failed"]:
            yield Finding(
                "RUN_FAILED",
                "warning",
                f"the run in {row['name']} ended in a {row['failed']}",
                "Its horizon may be that of the failure.",
                "Use a smaller time step.",
            )
    wrong = {name: one for name, one in run.summary["ambiguous"].items() if one["wrong"] is not None}
    for name, one in wrong.items():
        yield Finding(
            "WRONG_DECISION",
            "info",
            f"a wrong decision in {name}, at step {count(one['wrong'])}",
            "From its own positions at that step, exact arithmetic decides otherwise: it is the rounding of "
            "the decision itself, not of the path to it.",
        )


# --- figures ------------------------------------------------------------------------------------------


def ranking(run: Question, width: float = PAGE_WIDTH) -> Figure:
    """A bar per policy, as long as it keeps to the exact history."""
    rows = run.summary["policies"]
    wide = width >= PAGE_WIDTH
    height = 0.8 + 0.34 * len(rows) if wide else (0.9 + 0.42 * len(rows)) / 0.85
    return drawn(partial(_bars, run), height, width)


def _bars(run: Question, figure: Figure) -> None:
    axes = figure.subplots()
    wide = figure.get_figwidth() >= PAGE_WIDTH
    rows, last = run.summary["policies"], run.steps
    place = np.arange(len(rows))[::-1]
    for at, row in zip(place, rows, strict=True):
        end = last if row["horizon"] is None else row["horizon"]
        kept = row["horizon"] is None
        axes.barh(at, end, height=0.55, color=FIRST, alpha=0.85 if kept else 0.55, lw=0, zorder=2)
        text = f"beyond {last:,}" if kept else f"{end:,}"
        # inside where there is room, beside the bar where there is none
        inside = end > 0.5 * last
        label = axes.annotate(
            text, (end, at), (-5 if inside else 5, 0), textcoords="offset points", fontsize=8, va="center",
            ha="right" if inside else "left", color=INK, zorder=4,
        )  # fmt: skip
        label.set_gid(HALO)
        doubt = run.summary["ambiguous"].get(row["name"], {}).get("horizon")
        if doubt is not None:
            axes.plot(doubt, at, "o", ms=5, mfc="none", mec=MUTED, mew=1.1, zorder=3, clip_on=False)
    names = [row["name"] if wide else folded(row["name"], 95, 7.5) for row in rows]
    axes.set_yticks(place, names, fontsize=8.5 if wide else 7.5)
    axes.set_xlim(0, 1.02 * last)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.locator_params(axis="x", nbins=7 if wide else 4)
    axes.set_xlabel("leaves the exact history at step", color=INK)


def separations(run: Question) -> Plot | None:
    """How far the run of each policy is from the exact one, by step."""
    table = run.tables["policy_separations"]
    series = []
    for k, row in enumerate(run.summary["policies"]):
        mine = table["policy"] == row["name"]
        apart = table["separation"][mine]
        if np.any(apart > 0):
            shown = np.where(apart > 0, apart, np.nan)
            role: Any = _ROLES[k % len(_ROLES)]
            series.append(Series(row["name"], table["step"][mine], shown, role=role, dashed=k >= len(_ROLES)))
    if not series:
        return None
    return Plot(
        "Real runs leave the exact one",
        "step",
        f"largest distance from the exact place ({run.units.length})",
        tuple(series),
        y_scale="log",
    )


# --- tables -------------------------------------------------------------------------------------------


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the figure."""
    summary = run.summary
    policies = summary["policies"]
    kept = sum(row["horizon"] is None for row in policies)
    yield "Keep to it", f"{count(kept)} of {count(len(policies))}", f"for {many(run.steps, 'step')}"
    yield "One more bit", number(summary["steps_per_bit"], 3), "steps gained, by the growth seen"
    yield (
        "Closest decision",
        number(summary["smallest_margin"], 2),
        f"{run.units.length}², in the exact run, step {count(summary['smallest_margin_step'])}",
    )
    yield "Exact flips", count(summary["flips"]), "in time, all proven"
    yield "Carried", f"{count(summary['bits'])} bits", f"{count(summary['restarts'])} restarts with more"
    yield "Exact step", f"{number(summary['ms_per_step'], 2)} ms", f"{number(summary['seconds'], 2)} s in all"


def _row(run: Question, row: Mapping[str, Any]) -> dict[str, str]:
    """A policy as text."""
    doubt = run.summary["ambiguous"].get(row["name"])
    return {
        "name": row["name"],
        "roles": ", ".join(f"{part} {row[part]}" for part in _PARTS),
        "horizon": f"beyond {count(run.steps)}" if row["horizon"] is None else count(row["horizon"]),
        "pair": "–" if row["pair"] is None else f"{row['pair'][0]}–{row['pair'][1]}",
        "margin": number(row["margin"], 2, signed=True),
        "closer": number(row["closer_bits"], 2, signed=True),
        "growth": number(row["growth_rate"], 2),
        "ambiguous": "–" if doubt is None else count(doubt["total"]),
        "doubt": "" if doubt is None or doubt["horizon"] is None else f"from step {count(doubt['horizon'])}",
        "failed": row["failed"] or "",
    }


def _what(run: Question) -> Iterator[tuple[str, str]]:
    yield from size_of(run)
    yield (
        "Exact",
        "the same discrete map in ball arithmetic (Arb): every decision is proven, or the precision doubled",
    )
    yield (
        "Ambiguous",
        "a decision whose margin is within the rounding bound of the computed quantity, from the run’s own "
        "positions; each is decided once more in exact rational numbers",
    )
    yield took(run)
