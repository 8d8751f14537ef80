"""`mdnum fork`: where two runs that differ in one choice part, and what a flip had to do with it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import typer

from mdnum.cli import fork_ahead, fork_ball, fork_map, fork_options, fork_processes, fork_questions, output
from mdnum.cli.fork_print import print_rows
from mdnum.cli.progress import watched
from mdnum.errors import InputError


def fork(
    system: str | None = typer.Argument(
        None, metavar="SYSTEM", help="A name from `mdnum systems list`, or the path of a TOML file."
    ),
    other: Path | None = typer.Argument(
        None, metavar="[RUN]", help="With a run folder as SYSTEM: the run folder to compare it with."
    ),
    vary: str | None = typer.Option(
        None,
        metavar="CHOICE",
        help="What to vary: precision, reduction=exact, ...; all screens every choice. "
        "By default what the system file says.",
    ),
    steps: int | None = typer.Option(None, min=1, help="Steps to follow, instead of the system's own."),
    split: float | None = typer.Option(
        None, metavar="LENGTH", help="The separation that counts as split; 0.01 of the cutoff by default."
    ),
    repeats: int | None = typer.Option(
        None, min=0, metavar="K", help="Perturbed starts at most, to tell a delay from chance; 15 by default."
    ),
    settings: list[str] | None = output.SET_OPTION,
    no_counterfactual: bool = typer.Option(
        False,
        "--no-counterfactual",
        help="Do not run B under A's decisions, nor repeats: dates, but no cause.",
    ),
    no_back: bool = typer.Option(
        False, "--no-back", help="Do not run A under B's decisions: half of the table of two by two."
    ),
    no_lyapunov: bool = typer.Option(
        False, "--no-lyapunov", help="Do not carry a tangent along A for its Lyapunov exponent."
    ),
    minimal: bool = typer.Option(
        False,
        "--minimal",
        help="With --vary: the fewest decisions whose taking back keeps the runs together.",
    ),
    pin: str | None = typer.Option(
        None,
        metavar="DECISION",
        help="With --vary: run B once more, told what A decided: fork, a pair 3-75, or 3-75:600..700.",
    ),
    along: str | None = typer.Option(
        None, metavar="KEY=LOW:HIGH", help="Where the history of decisions changes along a number."
    ),
    most: int | None = typer.Option(
        None, min=1, metavar="N", help="With --along: stop after so many boundaries; 24 by default."
    ),
    processes: bool = typer.Option(
        False, "--processes", help="Which programs agree: jit, eager, vmap, grad, flags of XLA."
    ),
    certify: bool = typer.Option(
        False, "--certify", help="When runs leave the history in exact arithmetic, by precision."
    ),
    forecast: float | None = typer.Option(
        None, metavar="LENGTH", help="Which decisions a displacement of the start would flip first."
    ),
    benign: bool = typer.Option(
        False, "--benign", help="With --vary: whether anything that would be measured differs."
    ),
    replay: bool = typer.Option(
        False, "--replay", help="With two run folders: follow both again, for split, verdict and report."
    ),
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The fork folder; runs/fork-NAME-N by default."
    ),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Follow two runs that differ in one numerical choice, and judge the flip that parted them."""
    overrides = output.parse_overrides(settings)
    if vary == "processes":
        # what is varied then is no choice of two runs, but somebody may well ask so
        vary, processes = None, True
    asked = {
        "RUN": other is not None,
        "--along": along is not None,
        "--processes": processes,
        "--certify": certify,
        "--forecast": forecast is not None,
        "--vary": vary is not None,
    }
    if sum(asked.values()) > 1:
        names = " and ".join(name for name, is_asked in asked.items() if is_asked)
        raise InputError(f"{names} are different questions", remedy="Ask one at a time")
    given = {
        "--steps": steps is not None, "--split": split is not None, "--repeats": repeats is not None,
        "--set": bool(overrides), "--no-counterfactual": no_counterfactual, "--no-back": no_back,
        "--no-lyapunov": no_lyapunov, "--minimal": minimal, "--pin": pin is not None,
        "--most": most is not None, "--benign": benign, "-o": out is not None, "--no-report": no_report,
        "--replay": replay,
    }  # fmt: skip
    # along a number is the one question that is the same in both worlds
    if system is not None and other is None and along is None and fork_ball.is_ball(system):
        foreign = {
            "--most": most is not None, "--processes": processes,
            "--forecast": forecast is not None, "--benign": benign, "--minimal": minimal,
            "--pin": pin is not None, "--no-back": no_back, "--no-lyapunov": no_lyapunov,
        }  # fmt: skip
        return fork_ball.fork(
            system, vary, foreign=foreign, given=given, certify=certify, steps=steps, split=split,
            repeats=repeats,
            counterfactual=not no_counterfactual, out=out, overrides=overrides, report=not no_report,
            as_json=as_json,
        )  # fmt: skip
    if benign and vary is None:
        raise InputError("--benign needs a choice", remedy="Add --vary CHOICE")
    if benign and vary == "all":
        raise InputError("--benign is asked of one choice, not of all", remedy="Give one to --vary")
    for name, is_asked in (("--minimal", minimal), ("--pin", pin is not None)):
        if is_asked and vary is None and any(asked.values()) and not replay:
            raise InputError(f"{name} is asked of two runs", remedy="Add it to --vary CHOICE")
    if most is not None and along is None:
        raise InputError("--most needs a number to go along", remedy="Add --along KEY=LOW:HIGH")
    if (any(asked.values()) or any(given.values())) and system is None:
        raise InputError("no system given", remedy="`mdnum systems list` names those that come with mdnum")
    fork_options.check(_question(asked, vary, benign, replay), given)
    pair = {
        "steps": steps, "split": split, "repeats": repeats,
        "counterfactual": not no_counterfactual, "back": False if no_back else None,
        "lyapunov": False if no_lyapunov else None,
        "minimal": minimal, "pin": pin, "out": out, "report": not no_report,
    }  # fmt: skip
    if system is not None:
        if other is not None:
            if replay:
                return fork_questions.replay(Path(system), other, pair, as_json=as_json)
            return fork_questions.folders(Path(system), other, as_json=as_json)
        if along is not None:
            return fork_map.along(
                system, along, steps, most, overrides, out=out, report=not no_report, as_json=as_json
            )
        if processes:
            return fork_processes.processes(
                system, steps, overrides, out=out, report=not no_report, as_json=as_json
            )
        if certify:
            return fork_ahead.certify(
                system, steps, overrides, out=out, report=not no_report, as_json=as_json
            )
        if forecast is not None:
            return fork_ahead.foretell(
                system, forecast, steps, overrides, out=out, report=not no_report, as_json=as_json
            )
        if benign and vary is not None:
            return fork_questions.consistent(system, vary, steps, overrides, as_json=as_json)
    if system is None:
        return _choices(as_json)
    from mdnum.workflow import fork as compare

    with watched() as progress:
        result = compare(system, vary, overrides=overrides, progress=progress, **pair)
    return output.answer(result.folder, result.summary, print_rows, as_json=as_json)


def _question(asked: Mapping[str, bool], vary: str | None, benign: bool, replay: bool) -> str:
    """The key of `fork_options.TAKES` for what was asked."""
    if asked["RUN"]:
        return "RUN_A RUN_B --replay" if replay else "RUN_A RUN_B"
    if vary is not None and benign:
        return "--vary CHOICE --benign"
    if vary == "all":
        return "--vary all"
    return next((name for name, is_asked in asked.items() if is_asked), "--vary")


def _choices(as_json: bool) -> int:
    """What can be varied, for somebody who did not say."""
    from mdnum.forks.choices import shipped

    worlds = {"choices": ("", "md"), "ball_choices": (" of a ball", "ball")}
    rows = {
        key: [
            {"name": name, "about": choice.describe(world), "must_hold": choice.must_hold}
            for name, choice in shipped(world).items()
        ]
        for key, (_, world) in worlds.items()
    }
    if as_json:
        output.print_json(rows)
        return output.EXIT_FINE
    for key, (whose, _) in worlds.items():
        lines = [(row["name"], "must hold" if row["must_hold"] else "", row["about"]) for row in rows[key]]
        output.print_table(
            f"choices{whose}: `mdnum fork SYSTEM --vary CHOICE`", ("choice", "", "about"), lines
        )
    output.console().print(
        "jit, eager, vmap, grad and flags of XLA: `mdnum fork SYSTEM --processes`", markup=False
    )
    return output.EXIT_FINE
