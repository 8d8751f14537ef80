"""`mdnum fork` as a function: vary one numerical choice, follow both runs, judge the flips, report."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.store.naming import default_folder

if TYPE_CHECKING:
    from mdnum.forks import Fork, Twin
    from mdnum.systems import BallSystem
    from mdnum.systems.load import System

Progress = Callable[[int, int, dict[str, Any]], None]

#: Screens every choice that there is.
ALL = "all"
_LOG_LINES = 50


@dataclass(frozen=True)
class ForkResult:
    """A finished comparison.

    Attributes:
        folder: the fork folder.
        fork: dates, series and verdict; None where all choices were screened.
        summary: what summary.json says, findings included.
    """

    folder: Path
    fork: Fork | None
    summary: dict[str, Any]


@dataclass(frozen=True)
class Asked:
    """What is to be found out beside dates and verdict; the exponent unless it is left out."""

    lyapunov: bool | None
    minimal: bool
    pin: str | None


def fork(
    system: System | BallSystem | str | Path,
    vary: str | None = None,
    *,
    steps: int | None = None,
    split: float | None = None,
    repeats: int | None = None,
    counterfactual: bool = True,
    back: bool | None = None,
    lyapunov: bool | None = None,
    minimal: bool = False,
    pin: str | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ForkResult:
    """Run a system and its twin that differs in one choice, and say where, why and whether they part.

    Args:
        system: a loaded system, a shipped name or the path of a system file; of molecular dynamics or a
            ball. A ball has choices of its own, and always both counterfactuals unless they are left out;
            back, lyapunov, minimal and pin are not asked of it.
        vary: the choice, such as "precision" or "reduction=exact"; "all" screens every choice. Default what
            the [fork] table of the system file says, as for steps and split.
        steps: last step; default the system's own.
        split: separation that counts as split, length; default 0.01 of the longest cutoff, of a ball 0.01 of
            the largest start height.
        repeats: further pairs of runs with perturbed starts at most, to tell a delay from chance; default 15.
            They are run until the verdict is clear.
        counterfactual: whether to run B's arithmetic under A's decisions, which the verdict rests on.
        back: whether to run A's arithmetic under B's decisions too, for the table of two by two; default
            with the counterfactual.
        lyapunov: whether to carry a tangent along A, for the largest Lyapunov exponent; default yes.
        minimal: whether to look for the fewest decisions whose taking back keeps the runs together; it takes
            up to 80 runs.
        pin: a decision to take back in one more run of B: "fork", a pair "3-75", or a pair over a window
            "3-75:600..700".
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values, such as {"cutoff.kind": "switched"}.
        report: write report.html.
        progress: called now and then with step, steps and a dictionary of figures.

    Raises:
        InputError: the system cannot be run, the choice is unknown or does not apply to it, or something was
            asked for that would not be done.
        FolderError: the folder cannot be used.
    """
    from mdnum.systems import BallSystem

    loaded = loaded_of_any(system, overrides)
    _check(steps, split, repeats)
    if isinstance(loaded, BallSystem):
        given = {"minimal": minimal, "pin": pin is not None, "back": back is not None,
                 "lyapunov": lyapunov is not None}  # fmt: skip
        refuse(
            given,
            f"of molecular dynamics, and {loaded.name} is a ball",
            "A ball is run under either run's decisions unless counterfactual=False, and has no tangent run; "
            'a contact is taken back by vary="contact=STEP:BALL"',
        )
        from mdnum.workflow.fork_ball import fork_ball

        return fork_ball(
            loaded, vary, steps=steps, split=split, repeats=repeats, counterfactual=counterfactual, out=out,
            report=report, progress=progress,
        )  # fmt: skip
    system = loaded
    given = {"split": split is not None, "repeats": repeats is not None, "back": back is not None,
             "counterfactual": not counterfactual, "lyapunov": lyapunov is not None, "minimal": minimal,
             "pin": pin is not None}  # fmt: skip
    vary, steps, split = _as_in_file(system, vary, steps, split)
    _check(steps, split, repeats)
    if pin is not None:
        from mdnum.forks.replays import parse_pin

        parse_pin(pin, len(system.atoms))
    if vary == ALL:
        refuse(given, "of one comparison, and all choices were asked for", "Give one choice to vary")
        from mdnum.workflow.fork_screen import screen

        return screen(system, steps, out=out, report=report, progress=progress)
    options = {
        "steps": steps,
        "split": split,
        "repeats": repeats,
        "counterfactual": counterfactual,
        "back": back,
    }
    return _one(system, vary, options, Asked(lyapunov, minimal, pin), out, report, progress)


def _one(
    system: System,
    vary: str,
    options: dict[str, Any],
    asked: Asked,
    out: str | Path | None,
    report: bool,
    progress: Progress | None,
) -> ForkResult:
    from mdnum.forks.choices import parse, twin_of

    choice = parse(vary)
    say(progress, 0, "compile")
    return follow_into_folder(
        twin_of(choice, system), vary, choice, options, asked, None, out, report, progress
    )


def follow_into_folder(
    twin: Twin,
    vary: str,
    choice: Any,
    options: dict[str, Any],
    asked: Asked,
    further: Callable[[Fork], dict[str, Any]] | None,
    out: str | Path | None,
    report: bool,
    progress: Progress | None,
) -> ForkResult:
    """Follow a twin and leave a fork folder.

    Args:
        twin: the two programs.
        vary, choice: what was asked, as a word and as an object with a line about it.
        options: of `mdnum.forks.fork`.
        asked: further questions about the pair.
        further: entries of the summary beside those of any pair of runs.
        out, report, progress: as for `fork`.
    """
    from mdnum.forks import fork as follow
    from mdnum.forks.pair import counterfactuals
    from mdnum.forks.replays import neighborhood
    from mdnum.workflow import fork_answers, fork_record

    began = time.perf_counter()
    asked_of = {name: options[name] for name in ("counterfactual", "back", "repeats")}
    counterfactuals(twin, **asked_of)
    folder = new_folder(twin.a.simulation.system, out)
    try:
        made = follow(twin, progress=_logged(folder, progress), **options)
        say(progress, made.steps, "the atoms at the fork")
        around = neighborhood(made)
        answers: dict[str, Any] = {"lyapunov": None, "lyapunov_reason": "not asked for", "minimal": None}
        taken = None
        if asked.lyapunov is not False:
            say(progress, made.steps, "the Lyapunov exponent")
            answers |= fork_answers.exponent(made)
        if asked.minimal:
            answers["minimal"] = fork_answers.minimal(made, progress)
        if asked.pin is not None:
            say(progress, made.steps, "a decision taken back")
            answers["pinned"], taken = fork_answers.take_back(made, asked.pin)
        fork_record.write(folder, made, around, taken)
        folder.finalize()
        seconds = time.perf_counter() - began
        summary = fork_record.summarize(made, around, vary, choice, seconds, answers)
        folder.write_summary(summary | (further(made) if further is not None else {}))
    except BaseException:
        folder.close()
        raise
    say(progress, made.steps, "report" if report else "check")
    judge(folder, report)
    return ForkResult(folder.path, made, folder.summary)


def new_folder(system: System, out: str | Path | None) -> RunFolder:
    """An empty fork folder with the system and its provenance."""
    from mdnum.provenance import collect

    folder = RunFolder.create(default_folder(f"fork-{system.name}") if out is None else out, world="fork")
    try:
        system.write(folder.path)
        folder.write_provenance(collect(system))
    except BaseException:
        folder.close()
        raise
    return folder


def judge(folder: RunFolder, report: bool) -> None:
    """Puts headline and findings into the summary, and writes the report where it is wanted."""
    if report:
        from mdnum.report.fork.html import write_report

        write_report(folder)
    else:
        from mdnum.report.fork.findings import record

        record(folder)


def say(progress: Progress | None, step: int, phase: str) -> None:
    """Tells the phase."""
    if progress is not None:
        progress(step, 0, {"phase": phase})


def loaded_of_any(
    system: System | BallSystem | str | Path, overrides: Mapping[str, Any] | None
) -> System | BallSystem:
    """A system of either world."""
    from mdnum.systems import BallSystem, System, load

    if isinstance(system, System | BallSystem):
        if overrides:
            raise InputError(
                "overrides change a system while it is loaded",
                remedy="Load it with the overrides, or give its name",
                where=system.name,
            )
        return system
    return load(system, overrides)


def _as_in_file(
    system: System, vary: str | None, steps: int | None, split: float | None
) -> tuple[str, int | None, float | None]:
    """What was asked, and what the system file asks where nothing was said."""
    table = system.spec.fork
    if table is not None:
        vary = table.vary if vary is None else vary
        steps = table.steps if steps is None else steps
        split = table.split if split is None else split
    if vary is None:
        raise InputError(
            "nothing to vary",
            where=system.name,
            remedy="Add --vary CHOICE, or --vary all; `mdnum fork` alone lists the choices. A system file "
            "says it as vary in a table [fork]",
        )
    return vary, steps, split


def refuse(given: Mapping[str, bool], whose: str, remedy: str) -> None:
    """Refuses arguments that would change nothing.

    Args:
        given: argument to whether it was given.
        whose: they are instead.
        remedy: what to do.

    Raises:
        InputError: one was given.
    """
    names = [name for name, is_given in given.items() if is_given]
    if names:
        what = "an option" if len(names) == 1 else "options"
        verb = "is" if len(names) == 1 else "are"
        raise InputError(f"{' and '.join(names)} {verb} {what} {whose}", remedy=remedy)


def _check(steps: int | None, split: float | None, repeats: int | None) -> None:
    """Refuses what cannot be, before a folder is made."""
    from mdnum.forks.pair import repeats_asked

    if steps is not None and steps < 1:
        raise InputError(f"steps = {steps}; expected at least 1")
    if split is not None and not 0 < split < float("inf"):
        raise InputError(f"split = {split:g}; expected a length above 0")
    repeats_asked(repeats, True)


def _logged(folder: RunFolder, progress: Progress | None) -> Progress:
    """Passes progress on, and writes a line of log.txt now and then."""
    folder.log("    step    largest separation of A and B")
    last = -1.0

    def note(step: int, steps: int, info: dict[str, Any]) -> None:
        nonlocal last
        if step - last >= steps / _LOG_LINES or step == steps:
            folder.log(f"{step:8d}    {info.get('separation', float('nan')):.6e}")
            last = step
        if progress is not None:
            progress(step, steps, info)

    return note
