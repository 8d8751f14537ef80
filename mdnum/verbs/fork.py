"""`mdnum fork`: where two runs that differ in one choice diverge, and what a flip had to do with it.

One question of either world: a choice is varied (`fork`), all of them are (`fork_screen`), two finished runs
are compared or followed again (`fork_folders`), or ensembles are (`fork_benign`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.report.drawing import BAD, FIRST, MUTED, SECOND, legend
from mdnum.report.finding import Verdict
from mdnum.report.section import Figure, Key, Page, Section, Table, pairs
from mdnum.report.words import count, many, number
from mdnum.verbs import frame
from mdnum.verbs.fork_page import differences, page, size
from mdnum.verbs.fork_pair import PairQuestion, basics, check, followed, of_any, of_md
from mdnum.verbs.fork_verdict import RANKING, TEXTS, judge, judge_benign, judge_compare, judge_screen
from mdnum.verbs.frame import Outcome, Progress, View

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from mdnum.forks import Fork
    from mdnum.systems import BallSystem, System

#: Screens every choice that there is, where one is asked for.
ALL = "all"


def fork(
    system: System | BallSystem | str | Path,
    vary: str | None = None,
    *,
    steps: int | None = None,
    split: float | None = None,
    repeats: int | None = None,
    counterfactual: bool = True,
    back: bool | None = None,
    lyapunov: bool = True,
    minimal: bool = False,
    pin: str | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """Run a system and its twin that differs in one choice, and say where and why they diverge.

    Args:
        system: a loaded system, a shipped name or the path of a system file, of either world.
        vary: the choice, such as "precision" or "contact=earlier"; "all" screens every choice. Default what
            the [fork] table of the system file says, as for steps and split, and else "precision".
        steps: last step; default the system's own.
        split: separation that counts as split, length; default 0.01 of the longest cutoff, of a ball 0.01 of
            the largest start height.
        repeats: further pairs of runs with perturbed starts at most, to tell a delay from chance; default 15.
            They are run until the verdict is clear.
        counterfactual: whether to run B's arithmetic under A's decisions, which the verdict rests on.
        back: whether to run A's arithmetic under B's decisions too, for the table of two by two; default
            with the counterfactual.
        lyapunov: whether to carry a tangent along A, for the largest Lyapunov exponent (not of a ball).
        minimal: whether to look for the fewest decisions that have to be overridden with A's to keep the runs
            together; it takes up to 80 runs.
        pin: a decision to override with A's in one more run of B: "fork", a pair "3-75", or a pair over a
            window "3-75:600..700". minimal and pin are of molecular dynamics.
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values, such as {"cutoff.kind": "switched"}.
        report: write report.html.
        progress: called now and then with step, steps and a dictionary of figures.

    Returns:
        its result is a `mdnum.forks.Fork`, and where all choices were screened a list of
        `mdnum.forks.pair.Screened`.

    Raises:
        InputError: the system cannot be run, the choice is unknown or does not apply to it, or something was
            asked for that would not be done.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.choices import parse, twin_of, world_of
    from mdnum.systems import BallSystem

    system = of_any(system, overrides)
    table, own_split = system.spec.fork, split
    if table is not None:
        vary = table.vary if vary is None else vary
        steps = table.steps if steps is None else steps
        split = table.split if split is None else split
    asked = PairQuestion(steps, split, repeats, counterfactual, back, lyapunov, minimal, pin)
    check(asked)
    if vary == ALL:
        given = {"split": own_split is not None, "repeats": repeats is not None, "minimal": minimal,
                 "counterfactual": not counterfactual, "back": back is not None,
                 "pin": pin is not None}  # fmt: skip
        frame.refuse(given, "of one comparison, and all choices were asked for", "Give one choice to vary")
        return fork_screen(system, steps=steps, out=out, report=report, progress=progress)
    if isinstance(system, BallSystem):
        remedy = 'A decision of a ball is overridden by itself by the choice "contact=STEP:BALL"'
        given = {"minimal": minimal, "pin": pin is not None}
        frame.refuse(given, f"of molecular dynamics, and {system.name} is a ball", remedy)
        system = system if steps is None else system.for_steps(steps)
    elif pin is not None:
        from mdnum.forks.replays import parse_pin

        parse_pin(pin, len(system.atoms))
    word = vary or "precision"
    choice = parse(word)
    labels = {
        "choice": word,
        "choice_about": choice.describe(world_of(system)),
        "must_hold": choice.must_hold,
    }
    frame.say(progress, "compile")
    twin = twin_of(choice, system)
    return followed(system, twin, labels, asked, lambda made: {}, out, report, progress)


def fork_screen(
    system: System | BallSystem | str | Path,
    *,
    steps: int | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """Follow the free runs of every choice, and rank the choices by when they fork.

    Counterfactuals are left to the choices that turn out to matter.

    Args:
        system, out, overrides, report: as for `fork`.
        steps: last step; default that of the [fork] table, or the system's own.
        progress: called with choices done, how many there are, and the name of the next as the phase.

    Returns:
        its result is a list of `mdnum.forks.pair.Screened`.
    """
    from mdnum.forks.pair import screen

    began = time.perf_counter()
    system = of_any(system, overrides)
    if steps is None and system.spec.fork is not None:
        steps = system.spec.fork.steps
    check(PairQuestion(steps))
    with frame.new_folder("screen", f"fork-{system.name}", out, system=system) as folder:

        def note(done: int, count: int, name: str) -> None:
            folder.log(f"{done:4d} of {count}  {name}")
            if progress is not None:
                progress(done, count, {"phase": f"{name} ({done + 1} of {count})"})

        rows = screen(system, steps, progress=note)
        ran = [row for row in rows if row.reason_unavailable is None]
        summary = basics(system, steps) | {
            "ranking": [
                {
                    "choice": row.choice, "difference": row.difference, "first_bit": row.first_bit,
                    "fork": row.fork, "split": row.split, "must_hold": row.must_hold, "held": row.held,
                    "steps": row.steps, "failed": row.failed,
                }
                for row in ran
            ],
            "not_applicable": [
                {"choice": row.choice, "reason": row.reason_unavailable} for row in rows if row not in ran
            ],
            "seconds": time.perf_counter() - began,
        }  # fmt: skip
        frame.store(folder, summary, {})
    return frame.finish(folder, report=report, result=rows, progress=progress)


def fork_folders(
    a: str | Path,
    b: str | Path,
    *,
    replay: bool = False,
    out: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
    **asked: Any,
) -> Outcome:
    """Compare two finished runs of one world: what was different, and where they diverge.

    Args:
        a, b: run folders.
        replay: follow both again (molecular dynamics), and judge the flip at their fork as `fork` does. The
            summary then says whether the replay diverges where the stored tables do: it has their bits where
            versions and processor are the same. Else nothing is run: dates are those of the stored tables.
        out: the new fork folder; default runs/fork-<name>-<n>.
        report, progress: as for `fork`.
        asked: of a replay, steps, split, repeats, counterfactual, back, lyapunov, minimal and pin of `fork`;
            no more steps than both runs have.

    Returns:
        its result is a `mdnum.forks.folders.FolderFork`, of a replay a `mdnum.forks.Fork`.

    Raises:
        InputError: the folders hold runs of other systems, or no runs.
        FolderError: a folder holds no run, or the new one cannot be used.
    """
    from mdnum.forks.folders import compare_folders, twin_of
    from mdnum.systems.load import load

    began = time.perf_counter()
    frame.say(progress, "compare")
    found = compare_folders(a, b)
    system: Any = load(found.a)
    if not replay:
        frame.refuse(dict.fromkeys(asked, True), "of a replay", "Add replay=True, or leave them out")
        with frame.new_folder("compare", f"fork-{system.name}", out, system=system) as folder:
            row = plain(found)
            row["seconds"] = time.perf_counter() - began
            frame.store(folder, basics(system, found.steps) | row, {})
        return frame.finish(folder, report=report, result=found, progress=progress)
    if found.world != "md":
        raise InputError(
            "runs of a ball are not followed again",
            where=str(found.a),
            remedy="Vary the choice in which they differ: mdnum fork SYSTEM --vary CHOICE",
        )
    question = PairQuestion(**asked)
    check(question)
    last = found.steps if question.steps is None else min(question.steps, found.steps)

    def stored(made: Fork) -> dict[str, Any]:
        known = found.fork if found.fork is not None and found.fork <= made.steps else None
        return {
            "runs": [found.a, found.b],
            "differences": found.differences,
            "stored": {"steps": found.steps, "first_bit": found.first_bit, "fork": known},
            "reproduced": known == made.dates.fork,
        }

    labels = {"choice": "replay", "choice_about": TEXTS("replay"), "must_hold": False}
    frame.say(progress, "compile")
    twin, question = twin_of(found), PairQuestion(**{**asked, "steps": last})
    return followed(system, twin, labels, question, stored, out, report, progress)


def fork_benign(
    system: System | str | Path,
    vary: str,
    *,
    steps: int | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """Whether a choice changes anything that would be measured: an ensemble-consistency test.

    Args:
        system: of molecular dynamics, as for `fork`.
        vary: the choice.
        steps: at which the ensembles are compared; default calibrated.
        out, overrides, report, progress: as for `fork`.

    Returns:
        its result is a `mdnum.forks.benign.Benign`.
    """
    from mdnum.forks.benign import benign
    from mdnum.forks.choices import parse, twin_of

    began = time.perf_counter()
    system = of_md(system, overrides, "benign")
    twin = twin_of(parse(vary), system)
    with frame.new_folder("benign", f"fork-{system.name}", out, system=system) as folder:
        found = benign(twin, steps=steps, progress=progress)
        summary = basics(system, found.window) | {"choice": vary, "difference": twin.difference}
        summary |= {**plain(found), "seconds": time.perf_counter() - began}
        frame.store(folder, summary, {})
    return frame.finish(folder, report=report, result=found, progress=progress)


# -- pages ---------------------------------------------------------------------------------------------


def _page(view: View, what: str, about: str, keys: list[Key], sections: list[Section]) -> Page:
    rows = [*size(view), ("Took", f"{number(view.summary['seconds'], 2)} s")]
    sections = [*sections, Section("What was run", [pairs(rows)])]
    title = f"{view.name}: {what}"
    return Page(title, about, keys, sections, view.system_toml, view.folder.provenance)


def page_screen(view: View, verdict: Verdict) -> Page:
    """The page of all choices side by side."""
    s, rows = view.summary, view.summary["ranking"]
    held = [row for row in rows if row["must_hold"]]
    kept = sum(row["first_bit"] is None for row in held)
    keys = [
        Key("Choices", count(len(rows)), f"{count(len(s['not_applicable']))} more do not apply"),
        Key("Fork", count(sum(row["fork"] is not None for row in rows)), f"in {many(s['steps'], 'step')}"),
        Key("Split", count(sum(row["split"] is not None for row in rows)), "beyond the tolerance"),
        Key("No bit differs", count(sum(row["first_bit"] is None for row in rows)), "the same trajectory"),
        Key("Must hold", f"{count(kept)} of {count(len(held))}", "held bit for bit"),
    ]
    lines = [
        (row["choice"], row["first_bit"], row["fork"], row["split"],
         "" if not row["must_hold"] else "holds" if row["first_bit"] is None else "broken",
         row["failed"] or row["difference"])
        for row in rows
    ]  # fmt: skip
    bad = frozenset(k for k, row in enumerate(rows) if row in held and row["first_bit"] is not None)
    columns = ("choice", "first bit", "fork", "split", "must hold", "difference")
    alt = "; ".join(f"{row['choice']}: {count(row['fork'])}" for row in rows if row["fork"] is not None)
    figure = Figure(
        "ranking", TEXTS("ranking_caption"), f"Step at which each choice forks. {alt or 'None does'}.",
        lambda canvas: _ranking(rows, s["steps"], canvas), 0.9 + 0.24 * len(rows),
    )  # fmt: skip
    sections = [
        Section(RANKING, [TEXTS("ranking"), Table(columns, lines, shown=100, bad=bad), figure], terminal=True)
    ]
    if left := s["not_applicable"]:
        table = Table(("choice", "reason"), [(row["choice"], row["reason"]) for row in left], shown=100)
        sections.append(Section("Choices that do not apply", [table], terminal=True))
    return _page(view, "all choices", TEXTS("screen_about"), keys, sections)


def _ranking(rows: Any, steps: int, figure: Canvas) -> None:
    """A line per choice: where the first bit and the first decision differ, and where the runs split."""
    axes = figure.subplots()
    place = np.arange(len(rows))[::-1]
    for name, label, marker, color, filled in (
        ("first_bit", "first bit", "o", MUTED, "none"), ("fork", "fork", "o", FIRST, FIRST),
        ("split", "split", "X", SECOND, SECOND),
    ):  # fmt: skip
        seen = [(row[name], at) for at, row in zip(place, rows, strict=True) if row[name] is not None]
        if seen:
            axes.plot(*zip(*seen, strict=True), marker, color=color, mfc=filled, ms=6, label=label, zorder=3)
    for at, row in zip(place, rows, strict=True):
        known = [row[name] for name in ("first_bit", "fork", "split") if row[name] is not None]
        broken = row["must_hold"] and known
        if known:
            axes.plot([min(known), max(known)], [at, at], color=BAD if broken else MUTED, lw=0.8, zorder=1.5)
    axes.set_xscale("symlog", linthresh=10, linscale=0.6)
    axes.set_xlim(-1.5, 1.5 * max(steps, 10))
    axes.set_yticks(place, [row["choice"] for row in rows], fontsize=8.5)
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_xlabel("step")
    legend(axes)


def page_compare(view: View, verdict: Verdict) -> Page:
    """The page of two finished runs."""
    s = view.summary
    keys = [
        Key(label, "–" if s[name] is None else f"step {count(s[name])}", f"{what}, of {count(s['steps'])}")
        for name, label, what in (
            ("first_bit", "First bit", "a stored number differs"),
            ("fork", "Fork", "a stored decision differs"),
        )
    ]
    different = differences(s) if s["differences"] else TEXTS("folders_0_causes")
    sections = [Section("What was different", [different], terminal=True)]
    if s["decisions"]:
        rows = [
            (flip["run"], "–".join(map(str, flip["subject"])), "yes" if flip["entered"] else "no",
             flip["margin"], flip["bound"], flip["ambiguous"])
            for flip in s["decisions"]
        ]  # fmt: skip
        label = "pair" if s["channel"] == "pair" else "ball"
        columns = ("only in", label, "enters", "margin", "bound", "ambiguous")
        sections.append(Section("Decisions at the fork", [Table(columns, rows)], terminal=True))
    if s["iterations"]:
        table = Table(("in A", "in B"), [s["iterations"]])
        sections.append(Section("Iterations at the fork", [table], terminal=True))
    return _page(view, "two runs", f"A: {s['a']}, B: {s['b']}", keys, sections)


def page_benign(view: View, verdict: Verdict) -> Page:
    """The page of an ensemble-consistency test."""
    s = view.summary
    failed, of = s["false_positives"]
    keys = [
        Key("Step", count(s["window"]), "of the comparison"),
        Key("Components", count(s["components"]), f"limit {number(s['limit'], 3)} standard deviations"),
        Key("Fails on A itself", f"{count(failed)} of {count(of)}", "verdicts on runs that were held out"),
    ]
    sections = []
    if s["failing"]:
        table = Table(("feature", "standard deviations"), list(s["failing"].items()))
        sections.append(Section("What tells B from A", [table], terminal=True))
    scores = [(k + 1, *row) for k, row in enumerate(s["scores"])]
    names = tuple(f"component {k + 1}" for k in range(s["components"]))
    sections.append(Section("Components", [TEXTS("components"), Table(("run", *names), scores)]))
    return _page(view, f"{s['choice']}, benign?", str(s["difference"]), keys, sections)


VERBS = {
    "fork": frame.Verb(judge, page),
    "screen": frame.Verb(judge_screen, page_screen),
    "compare": frame.Verb(judge_compare, page_compare),
    "benign": frame.Verb(judge_benign, page_benign),
}
