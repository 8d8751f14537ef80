"""`mdnum conform`: tests whether a neighbor list contains the right pairs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from mdnum.deadline import Deadline
from mdnum.errors import InputError
from mdnum.plain import headed
from mdnum.references.conformance.case import AREAS
from mdnum.references.conformance.judge import CODES, DOUBLE, SILENT, SINGLE, CaseAnswers, Report
from mdnum.references.conformance.lists import LIMITS, PairList
from mdnum.registry import expect_known
from mdnum.report.drawing import BAD, FIRST, MUTED, SECOND
from mdnum.report.finding import Finding, Texts, Verdict, conclude
from mdnum.report.section import Code, Figure, Page, Section, Table, pairs, table_of
from mdnum.report.words import count, listed
from mdnum.store import RunFolder, answers, files
from mdnum.store.files import read_text, write_text
from mdnum.verbs import Reply, frame
from mdnum.verbs.frame import Outcome, Verb, View, Wanted

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

TEXTS = Texts(__file__)
#: Unit roundoff by name of the precision.
PRECISIONS = {"float64": DOUBLE, "float32": SINGLE}
#: Largest number of random cases.
MOST_CASES = 100_000
#: Errors below this multiple of the float64 rounding error are no evidence of float32.
_SLIGHT = 2.0**16
#: Areas of tests for a list that is kept and updated.
_IN_USE = ("motion", "wrapping", "strain", "rule")
_RETURNS = "(i, j), (i, j, shift), (i, j, shift, distance) or a mapping with i and j: an entry for each pair"


@dataclass(frozen=True)
class Options:
    """Options of the examination of a neighbor list, fixed when the examination starts."""

    cases: Annotated[int, Ge(0), Le(MOST_CASES)]
    seed: int = 0
    large: bool = True
    full: bool | None = None
    precision: Literal["float64", "float32"] | None = None
    superset: bool | None = None
    limits: tuple[str, ...] = ()

    def declared(self, tested: PairList) -> PairList:
        """Return a neighbor list with the declared properties: precision, convention and limits.

        Raises:
            InputError: an invalid precision, limit or number of cases.
        """
        if not 0 <= self.cases <= MOST_CASES:
            raise InputError(
                f"{self.cases:,} random test cases were requested", remedy=f"Give 0 to {MOST_CASES:,} cases"
            )
        expect_known("precision", [] if self.precision is None else [self.precision], PRECISIONS)
        expect_known("limit", self.limits, LIMITS)
        unit = PRECISIONS.get(self.precision or "")
        tested = tested.with_options(full=self.full, superset=self.superset, unit=unit)
        limits: Any = {LIMITS[word]: True for word in self.limits}
        return replace(tested, limits=replace(tested.limits, **limits))


@dataclass
class Examination(CaseAnswers):
    """State of an examination, stored in answers.json for later continuation."""

    word: str = field(kw_only=True)  # what names the list; empty where it has no name
    tested: tuple[str, str | None] = field(kw_only=True)  # name and version of the list
    options: Options = field(kw_only=True)  # that it was begun with
    seconds: Annotated[float, Ge(0)] = 0.0  # that were spent


@frame.keywords_checked
def conform(
    pairs: str | Callable[..., Any] | PairList | None = None,
    *,
    cases: int | None = None,
    seed: int = 0,
    large: bool = True,
    full: bool | None = None,
    precision: str | None = None,
    superset: bool | None = None,
    limits: str | Sequence[str] = (),
    time: float | None = None,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    report: bool = True,
    progress: Wanted = None,
) -> Outcome:
    """Test a neighbor list with the conformance suite: does the list contain the right pairs?

    Each result is saved at once. `resume` continues an interrupted examination.

    Example:
        >>> mdnum.conform("vesin", time=60)

    Args:
        pairs: a name (`references.conformance.known`), `package.module:function`, `file.py:function`, or a
            function of (positions, cell, pbc, r_cut) that returns (i, j), (i, j, shift), (i, j, shift,
            distance) or a mapping; or a class with `allocate` and `update`. A list with a name is called in a
            separate process, so that a crash is reported as a finding. With `resume`, give the list again
            only if it had no name.
        cases: number of random cases in addition to the named cases, at most `MOST_CASES`; default 500.
        seed: seed of the random cases.
        large: include cases with 5,000 and 100,000 atoms.
        full: whether every pair is listed from both of its atoms (True) or once (False); by default detected.
        precision: precision of the list's arithmetic, "float64" or "float32"; by default detected.
        superset: whether pairs beyond the cutoff may be listed.
        limits: features that the list does not support, as words of `LIMITS`; cases with them are skipped.
        time: time limit in minutes, after which no further case is tested and no failure is reproduced.
        out: the new folder; default runs/conform-<name>-<n>.
        resume: a folder to resume instead, with its original options.
        report: write report.html.
        progress: see `mdnum.verbs.frame.Keep`.

    Returns:
        the outcome; its result is the `references.conformance.Report`. The status in the summary is "partial"
        if the time limit was reached after `BREADTH` cases of each area, "undecided" if it was reached
        earlier.

    Raises:
        InputError: the list does not exist, cannot be called, or returns something other than pairs; or the
            list differs from the one with which the folder was started.
        FolderError: the folder cannot be used.
        Interrupted: by control-C or SIGTERM; the results so far are in the folder, with its page.
    """
    from mdnum.references.conformance.lists import from_object
    from mdnum.references.conformance.peers import load
    from mdnum.references.conformance.suite import CASES, Examiner, examine

    deadline = Deadline(time)
    with ExitStack() as stack:
        frame.end_on_sigterm(stack)
        folder = state = None
        if resume is not None:
            folder = answers.take(resume, frame.layout("conform"))
            stack.callback(folder.close)
            state = answers.restored(folder, Examination)
            pairs = pairs or state.word
        options = state.options if state is not None else Options(
            CASES if cases is None else cases, seed, large, full, precision, superset,  # type: ignore
            frame.words(limits),
        )  # fmt: skip
        if not pairs:
            raise InputError(
                "no neighbor list was given", remedy="Give the name of a known list, or a function"
            )
        tested = options.declared(load(pairs) if isinstance(pairs, str) else from_object(pairs))
        name = tested.name, tested.version
        if state is not None and state.tested != name:
            was, now = (" ".join(filter(None, words)) for words in (state.tested, name))
            remedy = "Start in a new folder"
            raise InputError(f"the folder has tests of {was}, not of {now}", where=str(resume), remedy=remedy)
        # scripts of what is known already need its conventions
        opening = deadline if state is None else Deadline(time and max(time, 0.2))
        examiner = Examiner(tested, reuse=True, apart=True, deadline=opening)
        examiner.session.deadline = deadline
        stack.callback(examiner.session.close)
        if (why := examiner.unusable()) is not None:
            calls = "Let allocate and update return" if tested.kept else (
                "Give a function of (positions, cell, pbc, r_cut) that returns"
            )  # fmt: skip
            lacks = re.search(r"No module named '(\w+)", why)
            install = f"Run python3 -m pip install {lacks[1]}, or a package that has it" if lacks else ""
            raise InputError(why, where=tested.name, remedy=install or f"{calls} {_RETURNS}")
        if folder is None:
            slug = f"conform-{tested.name.replace(':', '-')}"
            folder = stack.enter_context(frame.new_folder("conform", slug, out))
        else:
            folder.restart()
        state = state or Examination(word=tested.word, tested=name, options=options)
        found, kept = examiner.report, answers.Answers(folder, state)
        kept.save()
        due = 0.0

        def summarized() -> dict[str, Any]:
            found.seconds = state.seconds
            return summary_of(found, _write_scripts(folder, found), options.seed)

        def saved(urgent: bool) -> None:
            """Save the latest result. At intervals, also write scripts and summary."""
            nonlocal due
            kept.save(urgent)
            if (now := monotonic()) >= due:
                folder.write_summary(summarized() | {"status": "stopped"})
                # most of the time is for asking, and what a kill leaves is not old
                due = monotonic() + min(max(1.0, 20 * (monotonic() - now)), 5.0)

        interrupted = False
        try:
            examine(
                tested, cases=options.cases, seed=options.seed, large=options.large, apart=True, saved=saved,
                progress=frame.logged(folder, progress), examiner=examiner, deadline=deadline, answers=state,
            )  # fmt: skip
        except KeyboardInterrupt:
            interrupted = True
            examiner.session.close()
        kept.save()
        summary = summarized()
        if interrupted:
            summary |= {"status": "stopped", "interrupted": True}
        tables = {
            name: [{column: row[column] for column in folder.layout.columns(name)} for row in summary[name]]
            for name in folder.layout.always
        }
        frame.store(folder, summary, tables)
        outcome = frame.finish(folder, report=report, result=found, progress=progress)
        if interrupted:
            raise frame.Interrupted(outcome)
        return outcome


def command(pairs: str | None = None, *, resume: Path | None = None, **given: Any) -> Outcome | Reply:
    """Execute `mdnum conform`. Without a neighbor list, print the names of known ones."""
    from mdnum.references.conformance.peers import known

    if pairs is not None or resume is not None:
        return conform(pairs, resume=resume, **given)
    keys = {"list": "name", "version": "version", "lacks": "lacks", "kept": "kept", "what": "description"}
    rows = [{key: getattr(one, name) for key, name in keys.items()} for one in known()]
    lines = [
        (row["list"], f"install {' '.join(row['lacks'])}" if row["lacks"] else row["version"], row["what"])
        for row in rows
    ]
    table = ("neighbor lists that are known by name", ("list", "version", "what"), lines)
    return Reply(headed("conform-list", {"lists": rows}), [table, TEXTS("own_lists")])


def _script(code: str) -> str:
    """Return the ending of a script's file name for failures with the given code."""
    return f"{code.lower().replace('_', '-')}.py"


def _write_scripts(folder: RunFolder, found: Report) -> list[str]:
    """Write a script for each failure and remove obsolete scripts. Return the file names."""
    from mdnum.references.conformance.reproduction import script

    scripts = []
    for n, failed in enumerate(found.failed, 1):
        scripts.append(f"reproduce-{n}-{_script(failed.code)}")
        lines = script(found.tested, failed, found.how, found.superset, found.reach(failed.case))
        path = folder.path / scripts[-1]
        # what a link leads to is not examined
        same = path.is_file() and not path.is_symlink()
        if not (same and files.digest(path) == files.digest_of(lines.encode())):
            write_text(path, lines)
    listed = files.load(folder.path)
    own = re.compile(rf"reproduce-\d+-({'|'.join(re.escape(_script(code)) for code in CODES)})")
    for name in listed.files if listed is not None else ():
        if own.fullmatch(name) and name not in scripts:
            files.remove(folder.path / name)
    return scripts


def summary_of(found: Report, scripts: list[str], seed: int) -> dict[str, Any]:
    """Return the content of an examination's summary.json."""
    tested = found.tested
    own = ("superset", "found_out", "keeps_order", "shifts", "aliased", "questions", "left", "breadth",
           "running", "padding", "asked", "wrong", "conforms", "seconds")  # fmt: skip
    why = {area: sorted(tally.why.items(), key=lambda one: -one[1]) for area, tally in found.areas.items()}
    return {
        "question": "conform",
        "system": tested.name,
        "about": tested.description,
        **{name: getattr(tested, name) for name in ("package", "version", "kept", "known")},
        **{name: getattr(found, name) for name in own},
        "full": found.how.full,
        "shift_sign": found.how.sign,
        "precision": "float64" if found.how.unit == DOUBLE else "float32",
        "single": found.single and found.single.name,
        "error": dict(zip(("length", "times"), found.error, strict=True)),
        "ties": dict(zip(("counted", "not_counted"), found.ties, strict=True)),
        "refusals": [
            {
                "why": one.exception, "case": one.case.name, "atoms": one.case.atoms, "uneven": one.uneven,
                "answers": one.answers,
            }
            for one in found.refusals
        ],
        "padding_stated": found.stated,
        "rule": {"motions": found.motions, "calls": found.calls},
        "silent": sum(tally.silent for tally in found.areas.values()),
        "areas": [
            asdict(tally)
            | {name: getattr(tally, name) for name in ("passed", "failed", "silent")}
            | {"area": area, "about": AREAS[area]}
            | {"why": [{"why": text, "cases": cases} for text, cases in why[area]]}
            for area, tally in found.areas.items()
        ],
        "failures": [
            {
                "code": one.code, "area": one.case.area, "case": one.case.name, "atoms": one.case.atoms,
                "steps": one.case.steps, "step": one.worst.step, "text": one.worst.text, "script": script,
                "alone": one.alone, "earlier": sum(case.steps for case in one.earlier),
                "reproduced": one.reproduced,
            }
            for one, script in zip(found.failed, scripts, strict=True)
        ],
        "large": None if found.large is None else dict(zip(("atoms", "seconds"), found.large, strict=True)),
        "seed": seed,
        "findings": [],
        "status": "complete" if not found.left and found.whole
        else frame.PARTIAL if found.questions - found.left >= found.breadth
        else frame.UNDECIDED,
    }  # fmt: skip


def _cases(summary: Mapping[str, Any], code: str) -> int:
    """Return the number of test cases whose most severe failure has the given code."""
    return sum(row["codes"].get(code, 0) for row in summary["areas"])


def _total(summary: Mapping[str, Any], name: str) -> int:
    return sum(row[name] for row in summary["areas"])


def judge(view: View) -> Verdict:
    """Return the verdict on a neighbor list from its folder."""
    summary = view.summary
    asked, wrong, left = summary["asked"], summary["wrong"], summary["left"]
    silent = {code.lower(): _cases(summary, code) for code in SILENT}
    ways = [code for code, cases in silent.items() if cases]
    answered = asked - _total(summary, "refused") - _cases(summary, "RAISED")
    values = {"name": view.name, "asked": asked, "answered": answered, "wrong": wrong, **silent}
    values["right"] = _total(summary, "passed")
    said = (
        "nothing_asked" if not asked
        else "nothing_answered" if not answered
        else "conforms" if not wrong
        else "failed" if summary["silent"] < wrong
        else f"silent_{ways[0]}" if len(ways) == 1
        else "silent"
    )  # fmt: skip
    headline = TEXTS(said, **values)
    done, questions = summary["questions"] - left, summary["questions"]
    undecided = done < summary["breadth"]
    if left:
        early = "stopped_early" if summary["status"] == "stopped" else "too_few"
        few = early if undecided and not wrong else "so_far"
        headline = TEXTS(few, headline=headline, done=done, questions=questions)
        if summary["running"]:
            headline += f" {TEXTS('running', case=summary['running'])}"
    findings = [*_failures(summary), *_conduct(summary, answered)]
    best = "info" if undecided else "good"
    return conclude(findings, _evidence(view), headline=headline, best=best, judged=True)


def _evidence(view: View) -> Iterator[str]:
    summary = view.summary
    worst = sorted((row for row in summary["areas"] if row["failed"]), key=lambda row: -row["failed"])
    if worst:
        areas = [f"{row['area']} ({count(row['failed'])} of {count(row['asked'])})" for row in worst]
        yield TEXTS("where", areas=listed(areas))
    if summary["failures"]:
        shown = [row for row in summary["failures"] if row["reproduced"]]
        if shown:
            yield TEXTS("scripts", scripts=len(shown), atoms=min(row["atoms"] for row in shown))
    if summary["rule"]["motions"]:
        lost = any(row["failed"] for row in summary["areas"] if row["area"] == "rule")
        how = "stated" if summary["padding_stated"] else "shown" if summary["padding"] else "unknown"
        name = "rule_failed" if lost else f"rule_{how}"
        yield TEXTS(name, **summary["rule"], padding=summary["padding"])
    if summary["status"] != "complete":
        yield TEXTS("stopped", folder=view.folder.path.name)
    for name in ("refused", "skipped"):
        if cases := _total(summary, name):
            yield TEXTS(name, cases=cases)


def _failures(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield one finding per failure code. A finding names another failure that may be the cause."""
    by_code: dict[str, list[Mapping[str, Any]]] = {}
    for row in summary["failures"]:
        by_code.setdefault(row["code"], []).append(row)
    severity = {code: TEXTS.entries[code]["severity"] for code in by_code}
    causes = [code for code, rows in by_code.items() if any(row["alone"] for row in rows)]
    for code, rows in by_code.items():
        # one that fails by itself shows more than a smaller one that does not
        first = min(rows, key=lambda row: (not row["alone"], row["atoms"], row["steps"]))
        areas = [row["area"] for row in summary["areas"] if row["codes"].get(code)]
        asked = sum(1 for row in summary["areas"] if row["asked"])
        values = {name: first[name] for name in ("atoms", "step", "steps", "case", "script")}
        values |= {"cases": _cases(summary, code), "text": first["text"].rstrip(". ")}
        everywhere = len(areas) == asked > 2
        values["areas"] = "every area" if everywhere else listed(areas)
        shown = {True: "reproduced", False: "not_reproduced", None: "not_run"}[first["reproduced"]]
        seen = f"{TEXTS('failure', **values)} {TEXTS(shown, **values)}"
        cause = ""
        if first["earlier"]:
            seen += f" {TEXTS('earlier', calls=first['earlier'])}"
        if not first["alone"]:
            as_bad = (one for one in causes if severity[one] in ("error", severity[code]))
            cause = next(as_bad, "")
        if code in summary["known"]:
            seen += f" {summary['known'][code]}"
        rounding = all(row["text"].startswith("within rounding") for row in rows)
        ends = any("exit" in row["text"].lower() for row in rows)
        variants = ["rounding"] * rounding + ["exit"] * ends
        yield TEXTS.finding(code, *variants, seen=seen, **values, cause=cause)


def _conduct(summary: Mapping[str, Any], answered: int) -> Iterator[Finding]:
    """Yield findings on properties that are not errors, such as single precision."""
    ties = summary["ties"]
    if ties["counted"] and ties["not_counted"]:
        yield TEXTS.finding("TIES", **ties)
    if "float32" in summary["found_out"]:
        slight = ["slight"] * (summary["error"]["times"] < _SLIGHT)
        yield TEXTS.finding("SINGLE_PRECISION", *slight, case=summary["single"], **summary["error"])
    if summary["keeps_order"] is False:
        yield TEXTS.finding("ORDER")
    if summary["aliased"] is not None:
        yield TEXTS.finding("ALIASED", case=summary["aliased"])
    for refusal in summary["refusals"]:
        if refusal["uneven"]:
            words = {"exception": refusal["why"].rstrip(". "), "case": refusal["case"]}
            yield TEXTS.finding("UNEVEN_REFUSALS", **words, how=listed(refusal["uneven"]))
    reasons = [
        (row, one) for row in summary["areas"] for one in row["why"] if row["refused"] and ": " in one["why"]
    ]
    often = max(reasons, key=lambda each: each[1]["cases"], default=({"area": ""}, {"why": ""}))
    total = _total(summary, "refused")
    values = {"refused": total, "exception": often[1]["why"].rstrip(". "), "area": often[0]["area"]}
    if not answered:
        variants = ["time"] * (not summary["asked"]) + ["first"] * bool(reasons)
        yield TEXTS.finding("NOTHING_ANSWERED", *variants, **values)
    elif reasons:
        also = " ".join(
            TEXTS("answers", exception=one["why"].rstrip(". "), case=one["case"], how=listed(one["answers"]))
            for one in summary["refusals"] if one["answers"]
        )  # fmt: skip
        variants = ["many"] * (total > 0.2 * summary["asked"]) + ["also"] * bool(also)
        yield TEXTS.finding("REFUSES", *variants, **values, also=also)


def page(view: View, verdict: Verdict) -> Page:
    """Return the report page of an examination."""
    summary = view.summary
    wrong = summary["wrong"] - summary["silent"]
    kinds = sum(row["code"] not in SILENT for row in summary["failures"])
    totals = {name: _total(summary, name) for name in ("passed", "skipped")}
    values = {**summary, **totals, "wrong": wrong, "kinds": kinds or None}
    package = f"{summary['package'] or ''} {summary['version'] or ''}".strip()
    what = TEXTS.rows("what", **{
        **summary, "list": summary["about"] or summary["system"], "package": package or None,
        "oracle": TEXTS("oracle"),
    })  # fmt: skip
    sections = [
        Section("Cases by subject", [_figure(summary), *_tables(summary)], terminal=True),
        Section("Conventions", [TEXTS("conventions"), pairs(_conventions(summary))]),
        Section("What was run", [pairs(what)]),
    ]
    if summary["failures"]:
        words = {True: "yes", False: "no", None: "not run"}
        rows = [
            (row["script"], words[row["reproduced"]], row["atoms"], row["steps"], row["text"])
            for row in summary["failures"]
        ]
        table = Table(("script", "reproduces it", "atoms", "steps", "what is wrong"), rows)
        # a name of a file, wherever else the table would have it
        scripts = [read_text(view.folder.path / Path(row["script"]).name) for row in summary["failures"]]
        titles = [f"{row['code']}: {row['case']} ({row['area']})" for row in summary["failures"]]
        parts = [TEXTS("brought_down"), table, *map(Code, titles, scripts)]
        sections.insert(1, Section("Failures, reproduced", parts, terminal=True))
    about = ", ".join(filter(None, [summary["about"] or "A neighbor list", package]))
    keys = TEXTS.keys(**values)
    return view.page(f"{view.name}: conformance", f"{about}, against an exact oracle.", keys, sections)


def _tables(summary: Mapping[str, Any]) -> Iterator[Table]:
    """Yield two tables of results: for lists built once, and for lists updated during a run."""
    columns: dict[str, Any] = {
        "area": "area", "tested": "asked", "right": "passed",
        "wrong": lambda row: row["failed"] - row["silent"] or None,
        "no answer": lambda row: row["silent"] or None, "refused": lambda row: row["refused"] or None,
        "not tested": lambda row: row["skipped"] or None, "about": "about",
        "not answered": lambda row: "; ".join(
            f"{one['why']} ({count(one['cases'])})" for one in row["why"][:3]
        ),
    }  # fmt: skip
    for title, used in (("a list that is built once", False), ("a list that is kept in use", True)):
        if rows := [row for row in summary["areas"] if (row["area"] in _IN_USE) == used]:
            yield table_of(rows, columns, title, bad=lambda row: row["failed"])


def _figure(summary: Mapping[str, Any]) -> Figure:
    rows = [row for row in summary["areas"] if row["asked"]]

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        # a share of each area: one of 100,000 atoms counts as much as 500 drawn at random
        left, asked = np.zeros(len(rows)), np.array([row["asked"] for row in rows])
        place = np.arange(len(rows))[::-1]
        for label, cases, color in (
            ("right", [row["passed"] for row in rows], FIRST),
            ("refused", [row["refused"] for row in rows], MUTED),
            ("no answer", [row["silent"] for row in rows], SECOND),
            ("wrong", [row["failed"] - row["silent"] for row in rows], BAD),
        ):
            # a case that fails is never too small to be seen
            share = np.where(np.array(cases) > 0, np.maximum(np.array(cases) / asked, 0.006), 0.0)
            axes.barh(place, share, left=left, height=0.6, color=color, alpha=0.75, lw=0, label=label)
            left += share
        axes.set_yticks(place, [f"{row['area']} ({row['failed']:,} of {row['asked']:,})" for row in rows])
        axes.set_xlim(0, 1.0)
        axes.set_xlabel("share of the cases tested")
        axes.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=4, frameon=False, fontsize=8)

    alt = ", ".join(f"{row['area']} {row['failed']} of {row['asked']}" for row in rows) or "none asked"
    return Figure("areas", TEXTS("figure"), TEXTS("figure_alt", areas=alt), draw, 0.9 + 0.27 * len(rows))


def _conventions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return table rows that describe the conventions of the neighbor list."""
    more = "pairs of its skin" if summary["kept"] else "pairs beyond the cutoff"
    ties = {name: pairs_of or None for name, pairs_of in summary["ties"].items()}
    inside = "counts as inside (r ≤ r_cut)" if ties["counted"] else "does not count (r < r_cut)"
    return TEXTS.rows("kind_of_list", **{
        **summary, **ties, "more": more if summary["superset"] else None,
        "at_cutoff": inside if any(ties.values()) else None,
        "atom": ("j" if summary["shift_sign"] > 0 else "i") if summary["shifts"] else None,
        "found_out": listed(summary["found_out"]) if summary["found_out"] else None,
    })  # fmt: skip


KINDS = {"conform": Verb(judge, page)}
