"""`mdnum fork`: when and why two runs diverge that differ in one numerical choice.

`fork` varies one numerical choice of an MD or bouncing-ball simulation. `fork_screen` varies each choice in
turn. `fork_folders` compares or replays two finished runs. `fork_benign` compares ensembles of runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.errors import InputError
from mdnum.plain import headed, plain
from mdnum.report.drawing import BAD, FIRST, MUTED, SECOND, legend
from mdnum.report.finding import Verdict
from mdnum.report.section import Figure, Page, Section, Table, pairs, table_of
from mdnum.report.words import count
from mdnum.store import RunFolder
from mdnum.verbs import Reply, frame
from mdnum.verbs.fork_page import differences, page, size
from mdnum.verbs.fork_pair import PairQuestion, basics, check, followed, of_md
from mdnum.verbs.fork_verdict import RANKING, TEXTS, judge, judge_benign, judge_compare, judge_screen, of_pair
from mdnum.verbs.frame import Keep, Outcome, View

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from matplotlib.figure import Figure as Canvas

    from mdnum.forks import Fork
    from mdnum.systems import BallSystem, System
    from mdnum.systems.simulation import Simulation

#: Word that requests a screening of all choices.
ALL = "all"


@frame.keywords_checked
def fork(
    system: Simulation | System | BallSystem | str | Path,
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
    **keep: Unpack[Keep],
) -> Outcome:
    """Run a system twice with one difference, and find when and why the runs diverge.

    Example:
        >>> mdnum.fork("argon/crystal-108", "precision.force=float32", steps=500)

    Args:
        system: a simulation, a system, a shipped name or the path of a system file (also of a ball).
        vary: the choice, such as "precision" or "contact=earlier"; "all" screens every choice. Defaults of
            vary, steps and split are in the [fork] table of the file, if any; else vary is "precision".
        steps: last step; by default the system's own.
        split: separation that counts as a split, length; default 0.01 of the longest cutoff, for a ball 0.01
            of the largest start height.
        repeats: maximum number of further pairs of runs with perturbed starts, which distinguish a delay from
            chance; default 15. Pairs are run until the verdict is clear, and again with starts displaced a
            hundredth as far.
        counterfactual: whether to run B's arithmetic under A's decisions; this run is needed for a verdict.
        back: whether to run A's arithmetic under B's decisions too, for the two-by-two table; by default the
            same as counterfactual.
        lyapunov: whether to propagate a tangent along A, for the largest Lyapunov exponent (not for a ball).
        minimal: whether to find the smallest set of B's decisions that must be replaced by A's to keep the
            runs together; this takes up to 80 runs.
        pin: a decision that one additional run of B takes over from A: "fork", a pair "3-75", or a pair over
            a window "3-75:600..700". minimal and pin are for molecular dynamics only.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome whose result is a `mdnum.forks.Fork`, or, if all choices were screened, a list of
        `mdnum.forks.pair.Screened`.

    Raises:
        InputError: the system cannot be run, the choice is unknown or does not apply to the system, or an
            option would have no effect.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.choices import parse, twin_of, world_of
    from mdnum.systems import BallSystem, opened

    loaded = opened(system, keep.pop("overrides", None))
    own = _asked_by_default(loaded)
    vary = own.get("vary") if vary is None else vary
    asked = PairQuestion(
        own.get("steps") if steps is None else steps, own.get("split") if split is None else split,
        repeats, counterfactual, back, lyapunov, minimal, pin,
    )  # fmt: skip
    check(asked)
    if vary == ALL:
        given = {"split": split is not None, "repeats": repeats is not None, "minimal": minimal,
                 "counterfactual": not counterfactual, "back": back is not None,
                 "pin": pin is not None}  # fmt: skip
        frame.refuse(given, "of one comparison, but all choices were requested", "Give one choice to vary")
        return fork_screen(loaded, steps=asked.steps, **keep)
    if isinstance(loaded, BallSystem):
        remedy = 'To override one decision of a ball, vary the choice "contact=STEP:BALL"'
        given = {"minimal": minimal, "pin": pin is not None}
        frame.refuse(given, f"of molecular dynamics, and {loaded.name} is a ball", remedy)
        loaded = loaded if asked.steps is None else loaded.for_steps(asked.steps)
    elif pin is not None:
        from mdnum.forks.replays import parse_pin

        parse_pin(pin, loaded.atoms)
    word, world = vary or "precision", world_of(loaded)
    choice = parse(word, world)
    labels = {"choice": word, "choice_about": choice.describe(world), "must_hold": choice.must_hold}
    frame.say(keep.get("progress"), "compile")
    return followed(loaded, twin_of(choice, loaded), labels, asked, **keep)


def _asked_by_default(system: Any) -> Mapping[str, Any]:
    """Return the defaults from the [fork] table of a system file."""
    from mdnum.systems.load import world_of

    if world_of(system) == "md":
        return system.origin.fork
    return {} if system.spec.fork is None else system.spec.fork.model_dump()


@frame.keywords_checked
def fork_screen(
    system: Simulation | System | BallSystem | str | Path,
    *,
    steps: int | None = None,
    on: str | Executor | None = None,
    workers: int | None = None,
    **keep: Unpack[Keep],
) -> Outcome:
    """Run a system once per numerical choice. Rank the choices by the step of the first different decision.

    For one choice, `fork` also tests whether a flip is the cause.

    Example:
        >>> mdnum.fork_screen("argon/crystal-108", steps=200)

    Args:
        system: as for `fork`.
        steps: last step; by default that of the [fork] table, or the system's own.
        on, workers: where to compute, as for `mdnum.sweep`; by default in this process.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome whose result is a list of `mdnum.forks.pair.Screened`.
    """
    from mdnum.forks.pair import screen
    from mdnum.systems import opened

    loaded = opened(system, keep.get("overrides"))
    steps = _asked_by_default(loaded).get("steps") if steps is None else steps
    check(PairQuestion(steps))
    with frame.answering("screen", f"fork-{loaded.name}", loaded, **keep) as answer:

        def note(done: int, count: int, name: str) -> None:
            answer.log(done, count, {"phase": f"{name} ({done + 1} of {count})"})

        answer.result = screen(loaded, steps, progress=note, on=on, workers=workers)
        ran = [row for row in answer.result if row.reason_unavailable is None]
        left = [row for row in answer.result if row.reason_unavailable is not None]
        answer.summary = basics(loaded, steps) | {
            "ranking": [plain(row) | {"held": row.held} for row in ran],
            "not_applicable": [{"choice": row.choice, "reason": row.reason_unavailable} for row in left],
        }
    return answer.outcome


@partial(frame.keywords_checked, more=PairQuestion.__annotations__)
def fork_folders(
    a: str | Path, b: str | Path, *, replay: bool = False, objects: Sequence[Simulation] = (), **asked: Any
) -> Outcome:
    """Compare two finished runs, and find the step at which they diverge.

    Example:
        >>> mdnum.fork_folders("runs/liquid-864", "runs/liquid-864-2")

    Args:
        a, b: run folders; or two folders of `mdnum.Recorder` or `mdnum flips`, whose steps are frames.
        replay: run both again (molecular dynamics), and judge the flip at their fork as `fork` does. The
            summary then states whether the replay diverges where the stored tables do; the replay has the
            same bits if versions and processor are the same. Without replay nothing is run, and all steps are
            those of the stored tables.
        objects: the simulations of these runs, if the runs were made from objects; the data in the folders
            show which simulation belongs to which folder, and check it.
        asked: out, report and progress; for a replay also steps, split, repeats, counterfactual, back,
            lyapunov, minimal and pin of `fork`, with at most as many steps as both runs have.

    Returns:
        an outcome whose result is a `mdnum.forks.folders.FolderFork`, or for a replay a `mdnum.forks.Fork`.

    Raises:
        InputError: the folders contain runs of different systems, or no runs.
        FolderError: a folder contains no run, or the new folder cannot be used.
    """
    from mdnum.forks.folders import compare_folders, simulation_in, twin_of

    keep: Any = {name: asked.pop(name) for name in ("out", "report", "progress") if name in asked}
    frame.say(keep.get("progress"), "compare")
    found = compare_folders(a, b)
    frames = found.world == "flips"
    system: Any = None if frames else simulation_in(found.a, objects, built=replay)
    if not replay:
        frame.refuse(dict.fromkeys(asked, True), "of a replay", "Add replay=True, or leave them out")
        known = RunFolder.open(found.a).summary if frames else {"system": system.name}
        with frame.answering("compare", f"fork-{known['system']}", system, **keep) as answer:
            told = basics(system, found.steps) if system else {
                **{name: known[name] for name in ("system", "atoms")}, "about": "", "units": "",
                "steps_asked": found.steps, "timestep": None, "status": "complete", "findings": [],
            }  # fmt: skip
            answer.result, answer.summary = found, told | plain(found)
        return answer.outcome
    if found.world != "md":
        remedy = "Vary the choice in which they differ: mdnum fork SYSTEM --vary CHOICE"
        message, remedy = ("frames", "Omit the option `replay`") if frames else ("runs of a ball", remedy)
        raise InputError(f"{message} cannot be simulated again", where=str(found.a), remedy=remedy)
    question = PairQuestion(**asked)
    check(question)
    last = min(found.steps, question.steps or found.steps)

    def stored(made: Fork) -> dict[str, Any]:
        known = found.fork if found.fork is not None and found.fork <= made.steps else None
        return {
            "runs": [found.a, found.b], "differences": found.differences,
            "stored": {"steps": found.steps, "first_bit": found.first_bit, "fork": known},
            "reproduced": known == made.dates.fork,
        }  # fmt: skip

    labels = {"choice": "replay", "choice_about": TEXTS("replay"), "must_hold": False}
    frame.say(keep.get("progress"), "compile")
    return followed(system, twin_of(found, objects), labels, replace(question, steps=last), stored, **keep)


@frame.keywords_checked
def fork_benign(
    system: Simulation | System | str | Path, vary: str, *, steps: int | None = None, **keep: Unpack[Keep]
) -> Outcome:
    """Test, by an ensemble-consistency test, whether a numerical choice changes any measured quantity.

    Example:
        >>> mdnum.fork_benign("argon/liquid-864", "order")

    Args:
        system: a system of molecular dynamics, as for `fork`.
        vary: the choice.
        steps: step at which the ensembles are compared; by default calibrated.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome whose result is a `mdnum.forks.benign.Benign`.
    """
    from mdnum.forks.benign import benign
    from mdnum.forks.choices import parse, twin_of

    system = of_md(system, keep.get("overrides"), "benign")
    twin = twin_of(parse(vary, "md"), system)
    with frame.answering("benign", f"fork-{system.name}", system, **keep) as answer:
        answer.result = found = benign(twin, steps=steps, progress=answer.log)
        what = {"choice": vary, "difference": twin.difference}
        answer.summary = basics(system, found.window) | what | plain(found)
    return answer.outcome


def listed() -> Reply:
    """List the numerical choices that can differ between two runs (`mdnum fork choices`)."""
    from mdnum.forks.choices import shipped

    document, tables = {}, []
    for key, whose, world in (("choices", "", "md"), ("ball_choices", " of a ball", "ball")):
        document[key] = [
            {"name": name, "about": choice.describe(world), "must_hold": choice.must_hold}
            for name, choice in shipped(world).items()
        ]
        rows = [(row["name"], "must hold" * row["must_hold"], row["about"]) for row in document[key]]
        tables.append((f"choices{whose}: `mdnum fork SYSTEM --vary CHOICE`", ("choice", "", "about"), rows))
    return Reply(headed("fork-choices", document), [*tables, TEXTS("other_programs")])


# -- pages ---------------------------------------------------------------------------------------------


def _page(view: View, what: str, about: str, keys: Mapping[str, Any], sections: list[Section]) -> Page:
    rows, kind = [*size(view), view.took], view.folder.kind
    sections = [*sections, Section("What was run", [pairs(rows)])]
    of = "_frames" * (view.summary.get("world") == "flips")
    keyed = TEXTS.keys(f"keys_{kind}{of}", **{**view.summary, **keys})
    return view.page(f"{view.name}: {what}", about, keyed, sections)


def page_screen(view: View, verdict: Verdict) -> Page:
    """Return the report page that ranks all numerical choices."""
    s, rows, left = view.summary, view.summary["ranking"], view.summary["not_applicable"]
    same = [row["first_bit"] is None for row in rows]
    held = [whole for whole, row in zip(same, rows, strict=True) if row["must_hold"]]
    dates = {name: sum(row[name] is not None for row in rows) for name in ("fork", "split")}
    counts = {"choices": len(rows), "left": len(left), "same": sum(same), "kept": sum(held), "of": len(held)}

    def holds(row: Mapping[str, Any]) -> str:
        return "" if not row["must_hold"] else "holds" if row["first_bit"] is None else "broken"

    table = table_of(rows, {
        "choice": "choice", "first bit": "first_bit", "fork": "fork", "split": "split", "must hold": holds,
        "difference": lambda row: row["failed"] or row["difference"],
    }, shown=100, bad=lambda row: holds(row) == "broken")  # fmt: skip
    alt = "; ".join(f"{row['choice']}: {count(row['fork'])}" for row in rows if row["fork"] is not None)
    figure = Figure(
        "ranking", TEXTS("ranking_caption"), f"Step at which each choice forks. {alt or 'None does'}.",
        lambda canvas: _ranking(rows, s["steps"], canvas), 0.9 + 0.24 * len(rows),
    )  # fmt: skip
    others = table_of(left, {"choice": "choice", "reason": "reason"}, shown=100)
    return _page(view, "all choices", TEXTS("screen_about"), {**dates, **counts}, [
        Section(RANKING, [TEXTS("ranking"), table, figure], terminal=True),
        Section("Choices that do not apply", [others] * bool(left), terminal=True),
    ])  # fmt: skip


def _ranking(rows: Any, steps: int, figure: Canvas) -> None:
    """For each numerical choice, draw when decisions first differ and when runs split."""
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
    """Return the report page of a comparison of two finished runs."""
    s = view.summary
    same = [TEXTS("folders_0_causes")] * (s["world"] != "flips")
    different = [differences(s["differences"])] if s["differences"] else same
    decisions = table_of(s["decisions"], {
        "only in": "run", s["channel"] if s["channel"] == "pair" else "ball":
of_pair,
        "enters": "entered", "margin": "margin", "bound": "bound", "ambiguous": "ambiguous",
    })  # fmt: skip
    iterations = Table(("in A", "in B"), [s["iterations"]])
    return _page(view, "two runs", f"A: {s['a']}, B: {s['b']}", {}, [
        Section("What was different", different, terminal=True),
        Section("Decisions at the fork", [decisions] * bool(s["decisions"]), terminal=True),
        Section("Iterations at the fork", [iterations] * bool(s["iterations"]), terminal=True),
    ])  # fmt: skip


def page_benign(view: View, verdict: Verdict) -> Page:
    """Return the report page of an ensemble-consistency test."""
    s = view.summary
    failing = Table(("feature", "standard deviations"), list(s["failing"].items()))
    names = tuple(f"component {k + 1}" for k in range(s["components"]))
    scores = Table(("run", *names), [(k + 1, *row) for k, row in enumerate(s["scores"])])
    return _page(view, f"{s['choice']}, benign?", str(s["difference"]), {}, [
        Section("Quantities that distinguish B from A", [failing] * bool(s["failing"]), terminal=True),
        Section("Components", [TEXTS("components"), scores]),
    ])  # fmt: skip


KINDS = {
    "fork": frame.Verb(judge, page),
    "screen": frame.Verb(judge_screen, page_screen),
    "compare": frame.Verb(judge_compare, page_compare),
    "benign": frame.Verb(judge_benign, page_benign),
}
