"""`mdnum ball --demo`: short demonstrations of numerical effects, with tested claims.

A demonstration is a script `NN_its_name.py` in the folder `demos`. The script's first line states the
subject. The script's function `run()` returns a `Demo`.
"""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Unpack

import numpy as np

from mdnum.plain import plain, shipped_folder
from mdnum.registry import unknown
from mdnum.report.finding import Texts, Verdict, conclude
from mdnum.report.section import Page, Plot, Region, Section, Series, Table, pairs, points_of
from mdnum.report.words import typeset
from mdnum.verbs import frame
from mdnum.verbs.frame import Keep, Outcome, Verb, View

__all__ = ["Claim", "Demo", "Plot", "Region", "Series", "Table", "demonstrate", "load", "names", "table"]

TEXTS = Texts(__file__)
#: Largest number of elements of a list that are printed; of longer lists, the first and last are printed.
_LISTED = 16


@dataclass(frozen=True)
class Claim:
    """A claim of a demonstration, with expected and observed value."""

    what: str  # the statement, in words
    seen: Any  # the number or word that was found
    expected: str  # what it was held against, in words ("0.0009765625", "below 1e-12")
    ok: bool  # whether it held


@dataclass(frozen=True)
class Demo:
    """Result of one demonstration: its texts, numbers, checked claims, tables and plots."""

    title: str  # a short heading
    question: str  # what it asks, one sentence
    result: str  # what it shows, in one or two sentences with the numbers that matter: the headline
    answer: str  # what it shows, one to three sentences, with its numbers in words
    numbers: Mapping[str, Any]  # the numbers it must show, plain values by name; the first is the headline
    checks: Sequence[Claim]  # statements tested while it ran
    # tables, plots: what it shows
    tables: Sequence[Table] = ()
    plots: Sequence[Plot] = ()
    in_md: str = ""  # the counterpart in molecular dynamics, one sentence
    # more plain values for `--json` (histories and the like)
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """True if every claim of the demonstration was confirmed."""
        return all(claim.ok for claim in self.checks)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> Table:
    """Return a table with the given title, columns and rows."""
    return Table(tuple(columns), rows, title)


@frame.keywords_checked
def demonstrate(name: str, **keep: Unpack[Keep]) -> Outcome:
    """Run one demonstration, or all demonstrations.

    Example:
        >>> mdnum.demonstrate("fork")

    Args:
        name: name of a demonstration, or "all".
        keep: see `frame.Keep`; without overrides.

    Returns:
        the outcome with numbers, checks and curves; `result` is the list of `Demo`.

    Raises:
        InputError: no demonstration has this name.
    """
    # an unknown name is refused before anything runs
    asked = names() if name == "all" else [_known(name)]
    done: dict[str, Demo] = {}
    for number, one in enumerate(asked):
        frame.say(keep.get("progress"), f"demonstration {one}", number, len(asked))
        done[one] = load(one).run()
    documents = [_document(one, demo) for one, demo in done.items()]
    with frame.answering("demos", f"demo-{name}", **keep) as answer:
        summary = documents[0] if name != "all" else {"demos": documents}
        answer.summary = {**summary, "ok": all(demo.ok for demo in done.values())}
        answer.tables, answer.result = (
            {
                "curves": points_of(
                    (name, plot.name, line.label, line.x, line.y)
                    for name, demo in done.items()
                    for plot in demo.plots
                    for line in plot.series
                )
            },
            list(done.values()),
        )
    return answer.outcome


# --- the scripts --------------------------------------------------------------------------------------


def names() -> list[str]:
    """Return the names of the demonstrations, in the recommended order of reading."""
    return list(_files())


def about(name: str) -> str:
    """Return the first line of a demonstration's file without importing the file."""
    text = ast.get_docstring(ast.parse(_files()[_known(name)].read_text(encoding="utf-8")))
    return (text or "").partition("\n")[0].rstrip(".")


def load(name: str) -> ModuleType:
    """Return the module of a demonstration. The function `run()` runs the demonstration.

    Raises:
        InputError: no demonstration has this name.
    """
    path = _files()[_known(name)]
    spec = importlib.util.spec_from_file_location(f"mdnum_demo_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    # a script's own classes look their module up by name
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _files() -> dict[str, Path]:
    found = sorted(shipped_folder("demos").glob("[0-9][0-9]_*.py"))
    return {path.stem[3:].replace("_", "-"): path for path in found}


def _known(name: str) -> str:
    known = names()
    if name not in known:
        raise unknown("demonstration", name, [*known, "all"], where="--demo")
    return name


# --- on disk ------------------------------------------------------------------------------------------


def _document(name: str, demo: Demo) -> dict[str, Any]:
    """Return a demonstration as plain values. The points of its plots are in a separate table."""
    document = {"name": name, "ok": demo.ok, **plain(demo)}
    for table in document["tables"]:
        del table["shown"], table["bad"]
    for plot in document["plots"]:
        plot["series"] = [
            {key: one[key] for key in ("label", "mark", "role", "dashed")} for one in plot["series"]
        ]
    return document


def _plots(document: Mapping[str, Any], curves: Mapping[str, np.ndarray]) -> Iterator[Plot]:
    """Yield the plots of a demonstration, each with a name for its file."""
    mine = curves["part"].astype(str) == document["name"]
    for stored in document["plots"]:
        here = mine & (curves["curve"].astype(str) == stored["name"])
        lines = curves["line"].astype(str)
        series = []
        for one in stored["series"]:
            at = here & (lines == one["label"])
            series.append(Series(x=curves["x"][at], y=curves["y"][at], **one))
        region = stored["region"]
        if region is not None:
            arrays: dict[str, Any] = {key: np.array(region[key]) for key in ("x", "y", "value")}
            region = Region(words=tuple(region["words"]), **arrays)
        marks = {key: tuple(map(tuple, stored[key])) for key in ("verticals", "horizontals")}
        name = f"{document['name']}-{stored['name']}"
        yield Plot(**{**stored, **marks, "name": name, "series": tuple(series), "region": region})


# --- judged and shown ---------------------------------------------------------------------------------


def judge(view: View) -> Verdict:
    """Return a finding for every demonstration in which a check failed."""
    demos = _demos(view)
    found = []
    for demo in demos:
        failed = [claim["what"] for claim in demo["checks"] if not claim["ok"]]
        if failed:
            values = {"name": demo["name"], "failed": len(failed), "checks": len(demo["checks"])}
            section = _heading(demo, demos)
            found.append(TEXTS.finding("DEMO_FAILED", section=section, which="; ".join(failed), **values))
    checks = [claim["ok"] for demo in demos for claim in demo["checks"]]
    counts = {"demos": len(demos), "right": len(demos) - len(found)}
    evidence, headline = [TEXTS("held", held=sum(checks), checks=len(checks))], TEXTS("some", **counts)
    if len(demos) > 1:
        results = (f"{demo['name']}: {_result(demo)}" for demo in demos)
        evidence, headline = [*results, *evidence], headline if found else TEXTS("all", **counts)
    elif not found:
        headline = _result(demos[0])
    return conclude(found, evidence, headline=headline, best="good")


def page(view: View, verdict: Verdict) -> Page:
    """Return the report page of one or several demonstrations."""
    demos, curves = _demos(view), view.table("curves")
    sections: list[Section] = []
    for demo in demos:
        rows = [("ok" if one["ok"] else "failed", one["what"], shown(one["seen"]), one["expected"])
                for one in demo["checks"]]  # fmt: skip
        bad = frozenset(row for row, one in enumerate(demo["checks"]) if not one["ok"])
        digits = _digits(demo["numbers"].values(), 10)
        numbers = pairs(
            [(key.replace("_", " "), shown(value, digits)) for key, value in demo["numbers"].items()]
        )
        checks = Table(("", "check", "seen", "expected"), rows, shown=1000, bad=bad)
        figures = list(_plots(demo, curves))
        asked = [demo["question"], *([_result(demo)] if len(demos) > 1 else [])]
        parts = [*asked, *figures[:1], typeset(demo["answer"]), numbers, checks]
        sections.append(Section(_heading(demo, demos), parts, terminal=True))
        more: list[Any] = [_table(one) for one in demo["tables"]]
        more += [*figures[1:], *([TEXTS("in_md", text=demo["in_md"])] if demo["in_md"] else [])]
        # of all of them the command prints no tables: they would hide the answers
        sections.append(Section(TEXTS("more", name=demo["name"]), more, terminal=len(demos) == 1, level=3))
    title = demos[0]["title"] if len(demos) == 1 else TEXTS("title")
    return view.page(title, "", [], sections)


def _demos(view: View) -> Sequence[Mapping[str, Any]]:
    return view.summary.get("demos", [view.summary])


def _heading(demo: Mapping[str, Any], demos: Sequence[Any]) -> str:
    """Return the heading of a section. With several demonstrations, it is the demonstration's title."""
    return demo["title"] if len(demos) > 1 else TEXTS("detail")


def _result(demo: Mapping[str, Any]) -> str:
    """Return the sentence on a demonstration's result, with typeset numbers and symbols."""
    return typeset(demo["result"] or demo["answer"])


def _table(stored: Mapping[str, Any]) -> Table:
    """Format a table with the fewest digits that distinguish the numbers in each column (at least five)."""
    columns = []
    for values in zip(*stored["rows"], strict=True):
        digits = _digits(values, 10)
        columns.append(
            [shown(value, digits) if isinstance(value, float | list) else value for value in values]
        )
    return Table(tuple(stored["columns"]), list(zip(*columns, strict=True)), stored["title"])


def _digits(values: Iterable[Any], least: int) -> int:
    """Return the smallest number of significant digits that distinguishes all numbers."""
    floats = {value for value in values if isinstance(value, float)}
    apart = (n for n in range(least, 17) if len({f"{x:.{n}g}" for x in floats}) == len(floats))
    return next(apart, 17)


def shown(value: Any, digits: int = 10) -> str:
    """Format a plain value as text. Numbers have at most `digits` significant digits."""
    if isinstance(value, Mapping):
        return ", ".join(f"{str(key).replace('_', ' ')} {shown(item, digits)}" for key, item in value.items())
    if isinstance(value, list):
        digits = _digits(value, min(digits, 5) if len(value) > 3 else digits)
        texts = [shown(item, digits) for item in value]
        if len(texts) > _LISTED:
            return f"[{', '.join(texts[:6])}, …, {texts[-1]}] ({len(texts)} values)"
        return f"[{', '.join(texts)}]"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return typeset(f"{value:.{digits}g}")
    return "–" if value is None else typeset(str(value))


KINDS = {"demos": Verb(judge, page)}
