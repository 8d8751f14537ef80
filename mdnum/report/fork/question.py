"""What the pages of the other questions about forks share: a folder loaded once, its verdict, its figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mdnum import units
from mdnum.ball.demos.base import Plot
from mdnum.errors import FolderError
from mdnum.report import page, plots
from mdnum.report.fork.findings import Verdict
from mdnum.report.verdict import Finding
from mdnum.report.words import many, number, plain
from mdnum.store import TABLES, RunFolder
from mdnum.store.atomic import write_text
from mdnum.units import Units

#: Title of a figure, what draws it at a width in inches, and what it cannot show.
Drawn = tuple[str, Callable[[float], Figure], list[str]]

_ORDER = ("error", "warning", "info")


@dataclass(frozen=True)
class Question:
    """A fork folder that answers another question than where two runs part.

    Attributes:
        summary, provenance: as written.
        tables: arrays by column name, by table.
    """

    path: Path
    summary: Mapping[str, Any]
    system_toml: str
    provenance: Mapping[str, Any]
    tables: Mapping[str, Mapping[str, np.ndarray]]

    @property
    def name(self) -> str:
        """The system's name."""
        return str(self.summary.get("system") or self.path.name)

    @property
    def steps(self) -> int:
        """Last step."""
        return int(self.summary.get("steps") or 0)

    @cached_property
    def units(self) -> Units:
        """The unit system of all numbers in the folder."""
        return units.get(str(self.summary.get("units") or "lj"))


def load(folder: RunFolder | str | Path, question: str, verb: str = "fork") -> tuple[RunFolder, Question]:
    """A folder that answers a question.

    Args:
        question: a key of `store.TABLES`.
        verb: of the command line, which asks it.

    Raises:
        FolderError: it does not.
    """
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    summary = folder.summary
    if summary.get("question") != question:
        raise FolderError(
            "holds no finished answer", remedy=f"Run `mdnum {verb}` again", where=str(folder.path)
        )
    tables = {name: folder.read(name) for name in TABLES[question]}
    return folder, Question(folder.path, summary, folder.system_toml, folder.provenance, tables)


def verdict(
    headline: str,
    evidence: Iterable[str],
    found: Iterable[Finding],
    *,
    plain_tone: str = "info",
    judged: bool = False,
) -> Verdict:
    """A verdict whose tone is that of its worst finding, which its headline names.

    Args:
        plain_tone: where there is nothing worse than information.
        judged: whether the headline follows from the findings already.
    """
    findings = sorted(found, key=lambda finding: _ORDER.index(finding.severity))
    worst = findings[0].severity if findings else "info"
    tone: Any = plain_tone if worst == "info" else worst
    title = findings[0].title if findings else ""
    if judged or title.lower() in headline.lower():
        pass
    elif worst == "error":
        headline = f"{title[:1].upper()}{title[1:]}. {headline}"
    elif worst == "warning":
        more = sum(finding.severity == "warning" for finding in findings) - 1
        rest = f", and {many(more, 'more point')} below" if more else ""
        headline = f"{headline} Look first: {title}{rest}."
    return Verdict(tone, headline, tuple(evidence), tuple(findings))


def write_page(
    folder: RunFolder,
    run: Question,
    judged: Verdict,
    template: str,
    drawn: Mapping[str, Drawn],
    scripted: bool = False,
    **content: Any,
) -> Path:
    """Writes report.html and figures/*.svg, and puts headline and findings into summary.json.

    Args:
        drawn: figures by name.
        scripted: whether a table of the page can be searched.
    """
    judged.store(folder, run.summary)
    pictures = {
        name: page.picture(folder.path, name, title, draw) for name, (title, draw, _) in drawn.items()
    }
    path = folder.path / "report.html"
    text = page.render(
        template,
        run=run,
        verdict=judged,
        pictures=pictures,
        notes={name: notes for name, (_, _, notes) in drawn.items()},
        summary=run.summary,
        scripted=scripted,
        provenance=list(page.flat(run.provenance)),
        **content,
    )
    write_text(path, text)
    return path


def declared(plot: Plot) -> Drawn:
    """A plot as `write_page` wants it."""
    return plot.title, partial(plots.draw, plot), plots.notes(plot)


def size_of(run: Question) -> list[tuple[str, str]]:
    """Rows on the system: what, words."""
    summary = run.summary
    rows = [("System", str(summary["about"]))] if summary.get("about") else []
    balls = summary.get("balls")
    parts = many(summary.get("atoms"), "atom") if balls is None else many(balls, "ball")
    size = f"{parts}, {many(run.steps, 'step')}"
    return [*rows, ("Size", f"{size} of {plain(summary.get('timestep'))} {run.units.time}")]


def took(run: Question) -> tuple[str, str]:
    """The row on time."""
    return "Took", f"{number(run.summary.get('seconds'), 2)} s"
