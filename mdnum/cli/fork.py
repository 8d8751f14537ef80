"""`mdnum fork`: where two runs that differ in one choice diverge; a sub-command for each question."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from mdnum.cli import output
from mdnum.cli.progress import watched
from mdnum.errors import InputError

_INTERVAL = re.compile(r"^\s*([^=\s]+)\s*=\s*([^:\s]+)\s*:\s*([^:\s]+)\s*$")


class _Questions(TyperGroup):
    """A group whose first word is a system where it is no sub-command; without one choices are listed."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        first = args[0] if args else "--json"
        if first == "--json" and set(args) <= {"--json"}:
            args = ["choices", *args]
        elif first not in self.commands and first != "--help":
            args = ["vary", *args]
        return super().parse_args(ctx, args)


fork = typer.Typer(
    cls=_Questions,
    help="Follow two runs that differ in one numerical choice, and judge the flip at their fork: "
    "`mdnum fork SYSTEM` is `mdnum fork vary SYSTEM`.",
    rich_markup_mode=None,
    add_completion=False,
)

_SYSTEM = typer.Argument(
    metavar="SYSTEM", help="A name from `mdnum systems list`, or the path of a TOML file."
)
_STEPS = typer.Option(None, min=1, help="Steps to follow, instead of the system's own.")
_OUT = typer.Option(None, "-o", "--out", metavar="DIR", help="The fork folder; runs/fork-NAME-N by default.")
_NO_REPORT = typer.Option(False, "--no-report", help="Do not write report.html.")
_SPLIT = typer.Option(
    None, metavar="LENGTH", help="The separation that counts as split; 0.01 of the cutoff by default."
)
_REPEATS = typer.Option(
    None, min=0, metavar="K", help="Perturbed starts at most, to tell a delay from chance; 15 by default."
)
_NO_COUNTERFACTUAL = typer.Option(
    False, "--no-counterfactual", help="Do not run B under A's decisions, nor repeats: dates, but no cause."
)
_NO_BACK = typer.Option(
    False, "--no-back", help="Do not run A under B's decisions: half of the table of two by two."
)
_NO_LYAPUNOV = typer.Option(
    False, "--no-lyapunov", help="Do not carry a tangent along A for its Lyapunov exponent."
)
_MINIMAL = typer.Option(
    False, "--minimal", help="The fewest decisions to override with A's that keep the runs together."
)
_PIN = typer.Option(
    None, metavar="DECISION", help="Run B once more with A's decision: fork, a pair 3-75, or 3-75:600..700."
)


@fork.command()
def vary(
    system: str = _SYSTEM,
    choice: str | None = typer.Option(
        None, "--vary", metavar="CHOICE", help="What to vary: precision, reduction=exact, contact=earlier; "
        "by default what the system file has in [fork], or precision.",
    ),
    steps: int | None = _STEPS,
    split: float | None = _SPLIT,
    repeats: int | None = _REPEATS,
    no_counterfactual: bool = _NO_COUNTERFACTUAL,
    no_back: bool = _NO_BACK,
    no_lyapunov: bool = _NO_LYAPUNOV,
    minimal: bool = _MINIMAL,
    pin: str | None = _PIN,
    settings: list[str] | None = output.SET_OPTION,
    out: Path | None = _OUT,
    no_report: bool = _NO_REPORT,
    as_json: bool = output.JSON_OPTION,
) -> int:  # fmt: skip
    """Vary one choice, and find where the runs fork, where they split, and what the flips did to that."""
    from mdnum.verbs import fork as compare

    overrides = output.parse_overrides(settings)
    with watched() as progress:
        outcome = compare(
            system, choice, steps=steps, split=split, repeats=repeats, minimal=minimal, pin=pin,
            counterfactual=not no_counterfactual, back=False if no_back else None, lyapunov=not no_lyapunov,
            out=out, overrides=overrides, report=not no_report, progress=progress,
        )  # fmt: skip
    return output.print_outcome(outcome, as_json=as_json)


@fork.command()
def choices(as_json: bool = output.JSON_OPTION) -> int:
    """List what can be varied."""
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
    output.say("jit, eager, vmap, grad and flags of XLA: `mdnum fork processes SYSTEM`")
    return output.EXIT_FINE


def _of_a_system(question: str, text: str) -> None:
    """Adds a question that is asked of a system alone."""

    @fork.command(question, help=text)
    def _(
        system: str = _SYSTEM,
        steps: int | None = _STEPS,
        settings: list[str] | None = output.SET_OPTION,
        out: Path | None = _OUT,
        no_report: bool = _NO_REPORT,
        as_json: bool = output.JSON_OPTION,
    ) -> int:
        return _answered(f"fork_{question}", (system,), settings, out, no_report, as_json, steps=steps)


_of_a_system("screen", "Vary every choice, and rank them by when they fork.")
_of_a_system("certify", "Find when runs leave the history in exact arithmetic, by precision.")
_of_a_system("processes", "Find which programs agree: jit, eager, vmap, grad, flags of XLA.")


@fork.command("map")
def map_(
    system: str = _SYSTEM,
    along: str = typer.Argument(metavar="KEY=LOW:HIGH", help="The number and its interval."),
    steps: int | None = _STEPS,
    most: int | None = typer.Option(
        None, min=1, metavar="N", help="Stop after this number of boundaries; 24 by default, 64 of a ball."
    ),
    settings: list[str] | None = output.SET_OPTION,
    out: Path | None = _OUT,
    no_report: bool = _NO_REPORT,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Map where the history of decisions changes along a number."""
    asked = (system, *interval(along))
    return _answered("fork_map", asked, settings, out, no_report, as_json, steps=steps, most=most)


@fork.command()
def compare(
    run_a: Path = typer.Argument(metavar="RUN_A", help="A run folder."),
    run_b: Path = typer.Argument(metavar="RUN_B", help="The run folder to compare it with."),
    replay: bool = typer.Option(
        False,
        "--replay",
        help="Follow both runs again, for split and verdict; the options below are of that.",
    ),
    steps: int | None = _STEPS,
    split: float | None = _SPLIT,
    repeats: int | None = _REPEATS,
    no_counterfactual: bool = _NO_COUNTERFACTUAL,
    no_back: bool = _NO_BACK,
    no_lyapunov: bool = _NO_LYAPUNOV,
    minimal: bool = _MINIMAL,
    pin: str | None = _PIN,
    out: Path | None = _OUT,
    no_report: bool = _NO_REPORT,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Compare two finished runs: what was different, and where they diverge."""
    from mdnum.verbs import fork_folders

    given: dict[str, Any] = {
        "steps": steps, "split": split, "repeats": repeats, "minimal": minimal or None, "pin": pin,
        "counterfactual": False if no_counterfactual else None, "back": False if no_back else None,
        "lyapunov": False if no_lyapunov else None,
    }  # fmt: skip
    asked = {name: value for name, value in given.items() if value is not None}
    with watched() as progress:
        outcome = fork_folders(
            run_a, run_b, replay=replay, out=out, report=not no_report, progress=progress, **asked
        )
    output.print_notes(run_a, run_b)
    return output.print_outcome(outcome, as_json=as_json)


@fork.command()
def forecast(
    system: str = _SYSTEM,
    length: float = typer.Argument(metavar="LENGTH", help="How far the furthest atom is displaced."),
    steps: int | None = _STEPS,
    settings: list[str] | None = output.SET_OPTION,
    out: Path | None = _OUT,
    no_report: bool = _NO_REPORT,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Forecast which decisions a displacement of the start would flip first, from one tangent run."""
    return _answered("fork_forecast", (system, length), settings, out, no_report, as_json, steps=steps)


@fork.command()
def benign(
    system: str = _SYSTEM,
    choice: str = typer.Argument(metavar="CHOICE", help="What to vary; `mdnum fork choices` lists all."),
    steps: int | None = _STEPS,
    settings: list[str] | None = output.SET_OPTION,
    out: Path | None = _OUT,
    no_report: bool = _NO_REPORT,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Find whether a choice changes anything that would be measured, with ensembles of runs."""
    return _answered("fork_benign", (system, choice), settings, out, no_report, as_json, steps=steps)


def _answered(
    name: str, asked: Any, settings: Any, out: Path | None, no_report: bool, as_json: bool, **options: Any
) -> int:
    """Asks a question of `mdnum.verbs`, and prints the answer."""
    from mdnum import verbs

    overrides = output.parse_overrides(settings)
    with watched() as progress:
        outcome = getattr(verbs, name)(
            *asked, out=out, overrides=overrides, report=not no_report, progress=progress, **options
        )
    return output.print_outcome(outcome, as_json=as_json)


def interval(text: str) -> tuple[str, float, float]:
    """The words of KEY=LOW:HIGH.

    Raises:
        InputError: not of that form.
    """
    found = _INTERVAL.match(text)
    try:
        if found is None:
            raise ValueError
        return found[1], float(found[2]), float(found[3])
    except ValueError:
        raise InputError(
            f"{text!r} is not of the form KEY=LOW:HIGH", remedy="Write for example potential.sigma=3.40:3.41"
        ) from None
