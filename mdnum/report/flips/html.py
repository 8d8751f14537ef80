"""report.html of a trajectory: its flips, how long contacts last, who flips, what the file cannot tell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mdnum.errors import FolderError
from mdnum.report.flips import figures as drawn
from mdnum.report.flips import findings, sections
from mdnum.report.flips.words import box_words, duration, per_time, rule_words, size
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, declared, write_page
from mdnum.report.words import count, number, percent
from mdnum.store import RunFolder

# the ledger and the contacts may be larger than memory, and what is told of them is in the summary
_TABLES = ("frames", "lifetimes", "neighbors", "residues", "busiest")
# what summary.json says of a file and of each rule, without which there is no page
_NEEDED = (
    "atoms", "backward", "even", "file", "format", "frames", "has_times", "interval", "length", "notes",
    "reader", "resolution", "rules", "seconds", "slice", "stopped", "system", "time", "timed", "window",
)  # fmt: skip
_OF_A_RULE = (
    "ambiguous", "by_residue_name", "by_species", "chatter", "contacts", "directed", "entered", "flips",
    "flips_per_frame", "images", "intermittent", "left", "lifetime", "min_margin", "near_mean", "neighbors",
    "pairs_first", "pairs_flipped", "pairs_last", "pairs_mean", "rule", "stays_over", "stride",
)  # fmt: skip
# what was not looked for by the first versions
_LATER = {"between": None, "velocities_odd": False, "cut_short": False, "leaps": None, "interrupted": False}
_LATER_OF_A_RULE = {"grid": None, "flux": None}


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no finished ledger in the folder, or it cannot be written.
    """
    folder, run = _loaded(folder)
    browsed = sections.pairs(run)
    return write_page(
        folder,
        run,
        findings.judge(run),
        "flips/run.html.j2",
        {name: declared(plot) for name, plot in drawn.plots(run).items()},
        captions=drawn.captions(run),
        figures=list(_key_figures(run)),
        rules=[sections.rule(run, place) for place in range(len(run.summary["rules"]))],
        size=size(run),
        browsed=browsed,
        scripted=browsed is not None,
        what=list(_what(run)),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a trajectory and writes headline and findings into its summary.json."""
    folder, run = _loaded(folder)
    judged = findings.judge(run)
    judged.store(folder, run.summary)
    return judged


def _loaded(folder: RunFolder | str | Path) -> tuple[RunFolder, Question]:
    """The folder and what a page needs of it.

    Raises:
        FolderError: nothing in it was finished, or an older mdnum left out what a page needs by now.
    """
    folder, run = load(folder, "flips")
    summary = {**_LATER, **run.summary}
    rules = [{**_LATER_OF_A_RULE, **one} for one in summary.get("rules", ())]
    missing = [name for name in _NEEDED if name not in summary]
    missing += [name for name in _OF_A_RULE if any(name not in one for one in rules)]
    if missing:
        raise FolderError(
            f"this ledger was written by another version of mdnum and lacks {', '.join(missing)}",
            remedy=f"Look again: mdnum flips {summary.get('file', 'TRAJECTORY')}; the report that is there "
            "stays as it is",
            where=str(folder.path),
        )
    return folder, Question(run.path, {**summary, "rules": rules}, "", run.provenance, run.tables)


def load(
    folder: RunFolder | str | Path, question: str, tables: tuple[str, ...] = _TABLES
) -> tuple[RunFolder, Question]:
    """A folder, with the tables that a page needs.

    Raises:
        FolderError: nothing in it was finished.
    """
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    summary = folder.summary
    if summary.get("question") != question:
        raise FolderError(
            "holds no finished answer", remedy="Run `mdnum flips` again", where=str(folder.path)
        )
    read = {name: folder.read(name) for name in tables}
    return folder, Question(folder.path, summary, "", folder.provenance, read)


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the verdict."""
    one = run.summary["rules"][0]
    yield "Pairs inside", number(one["pairs_mean"], 4), f"on average, {rule_words(run, one)}"
    yield "Flips", count(one["flips"]), per_time(run, one["flips_per_frame"])
    share = one["ambiguous"] / one["flips"] if one["flips"] else 0.0
    yield "Undecidable", count(one["ambiguous"]), percent(share) if one["flips"] else ""
    median = one["lifetime"]["median"]
    at_most = "≤ " if median == 1 else ""
    yield "Median contact", at_most + duration(run, median, beyond="–"), "of those seen to begin"
    yield "Mean by rate", duration(run, one["lifetime"]["mean_by_rate"]), "all of them"


def _what(run: Question) -> Iterator[tuple[str, str]]:
    summary: Mapping[str, Any] = run.summary
    frames = f", frames {summary['slice']}" if summary["slice"] else ""
    yield "File", f"{summary['file']}{frames} ({summary['format']}, read by {summary['reader']})"
    yield "Size", size(run)
    if summary.get("box"):
        varies = "" if summary["frames"] < 2 else ", at the first frame"
        yield "Box", box_words(run, summary["box"]) + varies
    if summary["between"]:
        yield "Between", " and ".join(f"“{one}”" for one in summary["between"])
    for one in summary["rules"]:
        yield "Inside", rule_words(run, one)
    yield "Resolution", summary["resolution"]["words"]
    seconds = summary["seconds"]
    yield "Took", f"{number(seconds['frames'] + seconds['statistics'], 2)} s"
