"""report.html of a comparison: one file, from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.report import page
from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.fork import figures, findings, sections
from mdnum.report.fork.run import ROWS_LOADED, ForkFolder, load
from mdnum.report.words import count, many, number, plain
from mdnum.store import RunFolder

#: Rows of the table of flips that the page carries.
TABLE_ROWS = 5_000


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no comparison in the folder, or it cannot be written.
    """
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    run = load(folder)
    verdict = findings.judge(run)
    verdict.store(folder, run.summary)
    return page.publish(
        folder.path,
        figures.figures(run),
        lambda pictures, notes: render(run, verdict, pictures, notes),
    )


def render(
    run: ForkFolder,
    verdict: findings.Verdict,
    pictures: Mapping[str, str],
    notes: Mapping[str, list[str]],
) -> str:
    """The page's text.

    Args:
        pictures: markup by the names that `figures.figures` gives; one that is missing is left out.
        notes: what each of them cannot show.
    """
    flips = None if run.screened else _flips(run)
    return page.render(
        "fork/screen.html.j2" if run.screened else "fork/run.html.j2",
        run=run,
        verdict=verdict,
        pictures=pictures,
        notes=notes,
        captions=figures.captions(run),
        summary=run.summary,
        figures=list(ranked_figures(run) if run.screened else _key_figures(run)),
        what=list(_what(run)),
        decision=list(sections.decision(run)),
        runs=list(sections.runs(run)),
        shares=sections.shares(run),
        certain=list(sections.certain(run)),
        listed=sum((run.summary.get("ambiguous") or {}).values()),
        kept=sum((run.summary.get("ambiguous_kept") or {}).values()),
        pinned=sections.pinned(run),
        minimal=sections.minimal(run),
        growth=list(sections.growth(run)),
        changes=_changes(run.summary.get("changes") or {}),
        ranking=list(ranking(run)),
        flips=flips,
        flips_total=int(run.summary.get("cross_flips") or 0),
        scripted=bool(flips and flips.rows),
        rows_loaded=ROWS_LOADED,
        provenance=list(page.flat(run.provenance)),
    )


def _key_figures(run: ForkFolder) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the figure."""
    summary, time = run.summary, run.units.time
    for name, what in (
        ("seed", "bits differ"),
        ("fork", "a decision differs"),
        ("split", "beyond tolerance"),
    ):
        at = summary.get(name)
        when = summary.get(f"{name}_time")
        small = f"{what}, {plain(when, 6)} {time}" if at is not None else f"none in {many(run.steps, 'step')}"
        yield name.capitalize(), "–" if at is None else f"step {count(at)}", small
    guess = summary.get("predicted_split")
    rate = number(summary.get("growth_rate_time"), 3)
    fits = summary.get("r_squared")
    poor = fits is not None and fits < findings.FITS
    small = (
        f"per {time}, but no single exponential"
        if poor
        else f"per {time}; split expected at step {count(guess)}"
        if guess
        else f"per {time}, while they part"
    )
    yield "Growth rate", rate, small
    worth, small = _worth(run)
    yield "The flips were worth", worth, small
    yield "Cross-run flips", count(summary.get("cross_flips")), "of pairs in one run only"


def _worth(run: ForkFolder) -> tuple[str, str]:
    """How much later the runs would have split without the flips, in e-foldings; and what that is."""
    what = "e-foldings: growth rate × steps gained"
    nats = run.summary.get("nats")
    if nats is None and run.word == "cause":
        # no split in sight: the share is at least what was followed
        known = (share for share in run.summary.get("shares") or () if share["what"] == "decisions")
        least = next((share["nats"] for share in known if share["reference"] == "A"), None)
        return ("∞", what) if least is None else (f"> {number(least, 3)}", what)
    return number(nats, 3), what if nats is not None else "not known"


def _changes(changes: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(key, f"{_told(a)} in A, {_told(b)} in B") for key, (a, b) in changes.items()]


def _told(value: Any) -> str:
    return repr(value) if isinstance(value, float) else "none" if value is None else str(value)


def _what(run: ForkFolder) -> Iterator[tuple[str, str]]:
    """(what, words) for the table of the comparison."""
    summary = run.summary
    if summary.get("about"):
        yield "System", str(summary["about"])
    size = (
        f"{many(summary.get('atoms'), 'atom')}, {many(run.steps, 'step')} of {plain(summary.get('timestep'))}"
    )
    asked = summary.get("steps_asked")
    more = f" ({count(asked)} asked for)" if asked and asked > run.steps else ""
    yield "Size", f"{size} {run.units.time}{more}"
    if run.screened:
        return
    about = summary.get("choice_about")
    yield "Choice", f"{summary.get('choice')}{f': {about}' if about else ''}"
    yield "A and B differ in", str(summary.get("difference"))
    if summary.get("must_hold"):
        yield "Must hold", "by design this choice cannot change a bit; a difference is a finding"
    yield (
        "Split",
        f"when an atom is further than {number(summary.get('tolerance'), 3)} {run.units.length} from itself",
    )
    if summary.get("handed_until") is None:
        yield "Counterfactual", "none was run: nothing is said about the cause"
    if (chance := findings.chance(run)) is not None:
        yield "Chance", chance
    yield "Took", f"{number(summary.get('seconds'), 2)} s"


def _flips(run: ForkFolder) -> Browse:
    """The first cross-run flips."""
    table = {name: values[:TABLE_ROWS] for name, values in run.flips.items()}
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(table["margin"]) / table["bound"]
    run_b = (table["run"].astype(str) == "B").astype(int)
    columns: list[tuple[np.ndarray, int | None]] = [
        (table[name].astype(int), None) for name in ("step", "i", "j")
    ]
    columns += [(run_b, None), (table["entered"].astype(int), None), (table["differs"].astype(int), None)]
    columns += [(table["margin"].astype(float), 4), (ratio.astype(float), 3)]
    return Browse(
        name="flips",
        row_id="flip-rows",
        label="Search flips",
        placeholder="3-17, atom 5, step:100..200, entered, B, ambiguous",
        columns=(
            Column(0, "step", kind="count"),
            Column(1, "pair", kind="pair"),
            Column(3, "run", kind="word", words=("A", "B")),
            Column(4, "decision", kind="word", words=("left", "entered"), colors=("out", "in")),
            Column(5, "the runs now", kind="word", words=("agree", "differ")),
            Column(6, "margin"),
            Column(7, "margin", "÷ bound", digits=2),
        ),
        rows=plain_rows(columns),
        words={"entered": (4, 1), "in": (4, 1), "left": (4, 0), "out": (4, 0), "a": (3, 0), "b": (3, 1),
               "differ": (5, 1), "agree": (5, 0)},
        ranges={"step": 0},
        subjects=(1, 2),
        nouns=("atom", "pair"),
        ambiguous=7,
    )  # fmt: skip


# --- all choices --------------------------------------------------------------------------------------


def ranked_figures(run: ForkFolder) -> Iterator[tuple[str, str, str]]:
    """Figures of a screening: what each is, its value, and a note."""
    rows = run.ranking
    forked = [one for one in rows if one.get("fork") is not None]
    yield (
        "Choices",
        count(len(rows)),
        f"{count(len(run.summary.get('not_applicable') or ()))} more do not apply",
    )
    yield "Fork", count(len(forked)), f"in {many(run.steps, 'step')}"
    yield "Split", count(sum(one.get("split") is not None for one in rows)), "beyond tolerance"
    yield "No bit differs", count(sum(one.get("seed") is None for one in rows)), "the same trajectory"
    held = [one for one in rows if one.get("must_hold")]
    kept = sum(one.get("seed") is None for one in held)
    yield "Must hold", f"{count(kept)} of {count(len(held))}", "held bit for bit"
    yield "Took", f"{number(run.summary.get('seconds'), 2)} s", "compilation and all"


def ranking(run: ForkFolder) -> Iterator[dict[str, Any]]:
    """A row per choice, as text."""
    for one in run.ranking:
        yield {
            "choice": one["choice"],
            "difference": one.get("difference") or "",
            "must_hold": bool(one.get("must_hold")),
            "broken": bool(one.get("must_hold")) and one.get("seed") is not None,
            "failed": one.get("failed") or "",
            **{
                name: "–" if one.get(name) is None else count(one[name]) for name in ("seed", "fork", "split")
            },
        }
