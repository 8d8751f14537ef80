"""`mdnum fork`: where two runs that differ in one choice diverge; a sub-command for each question."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

import mdnum
from mdnum.cli import output
from mdnum.cli.output import SYSTEM_ARGUMENT
from mdnum.errors import InputError

_INTERVAL = re.compile(r"^\s*([^=\s]+)\s*=\s*([^:\s]+)\s*:\s*([^:\s]+)\s*$")
#: Questions that once were options of `mdnum fork`.
_ONCE = {
    "--along": "map SYSTEM KEY=LOW:HIGH", "--processes": "processes SYSTEM", "--certify": "certify SYSTEM",
    "--forecast": "forecast SYSTEM LENGTH", "--benign": "benign SYSTEM CHOICE",
    "--replay": "compare RUN_A RUN_B --replay",
}  # fmt: skip


class _Questions(TyperGroup):
    """A group whose first word is a system where it is no sub-command; without one choices are listed."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        first = args[0] if args else "--json"
        if first == "--json" and set(args) <= {"--json"}:
            args = ["choices", *args]
        elif first not in self.commands and first != "--help":
            once = next((word for word in args if word.partition("=")[0] in _ONCE), "").partition("=")[0]
            if once:
                raise InputError(
                    f"{once} is no option of `mdnum fork`, but a question",
                    remedy=f"Ask `mdnum fork {_ONCE[once]}`",
                )
            if len(args) > 1 and not args[1].startswith("-"):
                both = " ".join(args[:2])
                verb = "fork compare" if all(os.path.isdir(word) for word in args[:2]) else "flips"
                raise InputError(f"{both}: expected one system", remedy=f"Ask `mdnum {verb} {both}`")
            args = ["vary", *args]
        return super().parse_args(ctx, args)


fork = typer.Typer(
    cls=_Questions,
    help="Follow two runs that differ in one numerical choice, and judge the flip at their fork: "
    "`mdnum fork SYSTEM` is `mdnum fork vary SYSTEM`.",
    rich_markup_mode=None,
    add_completion=False,
)


_STEPS = typer.Option(None, min=1)


def of_a_horizon(steps: int | None = _STEPS) -> dict[str, Any]:
    """How far runs are followed."""
    return {"steps": steps}


def of_a_pair(
    steps: int | None = _STEPS,
    split: float | None = None,
    repeats: int | None = typer.Option(None, min=0),
    no_counterfactual: bool = False,
    no_back: bool = False,
    no_lyapunov: bool = False,
    minimal: bool = False,
    pin: str | None = None,
) -> dict[str, Any]:
    """What was asked about a pair of runs, and nothing that was not."""
    given = {
        "steps": steps, "split": split, "repeats": repeats, "minimal": minimal or None, "pin": pin,
        "counterfactual": False if no_counterfactual else None, "back": False if no_back else None,
        "lyapunov": False if no_lyapunov else None,
    }  # fmt: skip
    return {name: value for name, value in given.items() if value is not None}


_OF_A_SYSTEM = output.question(of_a_horizon, output.changed)


@fork.command()
@output.question(of_a_pair, output.changed)
def vary(
    system: str = SYSTEM_ARGUMENT,
    choice: str | None = typer.Option(None, "--vary"),
    how: Any = None,
) -> Any:
    """Vary one choice, and find where the runs fork, where they split, and what the flips did to that."""
    return mdnum.fork(system, choice, **how)


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
        title = f"choices{whose}: `mdnum fork SYSTEM --vary CHOICE`"
        output.print_table(title, ("choice", "", "about"), lines)
    output.say("jit, eager, vmap, grad and flags of XLA: `mdnum fork processes SYSTEM`")
    return output.EXIT_FINE


@fork.command()
@_OF_A_SYSTEM
def screen(system: str = SYSTEM_ARGUMENT, how: Any = None) -> Any:
    """Vary every choice, and rank them by when they fork."""
    return mdnum.fork_screen(system, **how)


@fork.command()
@_OF_A_SYSTEM
def certify(system: str = SYSTEM_ARGUMENT, how: Any = None) -> Any:
    """Find when runs leave the history in exact arithmetic, by precision."""
    return mdnum.fork_certify(system, **how)


@fork.command()
@_OF_A_SYSTEM
def processes(system: str = SYSTEM_ARGUMENT, how: Any = None) -> Any:
    """Find which programs agree: jit, eager, vmap, grad, flags of XLA."""
    return mdnum.fork_processes(system, **how)


@fork.command("map")
@_OF_A_SYSTEM
def map_(
    system: str = SYSTEM_ARGUMENT,
    along: str = typer.Argument(),
    most: int | None = typer.Option(None, min=1),
    how: Any = None,
) -> Any:
    """Map where the history of decisions changes along a number."""
    return mdnum.fork_map(system, *interval(along), most=most, **how)


@fork.command()
@output.question(of_a_pair, noted=("run_a", "run_b"))
def compare(
    run_a: Path = typer.Argument(), run_b: Path = typer.Argument(), replay: bool = False, how: Any = None
) -> Any:
    """Compare two finished runs: what was different, and where they diverge."""
    return mdnum.fork_folders(run_a, run_b, replay=replay, **how)


@fork.command()
@_OF_A_SYSTEM
def forecast(system: str = SYSTEM_ARGUMENT, length: float = typer.Argument(), how: Any = None) -> Any:
    """Forecast which decisions a displacement of the start would flip first, from one tangent run."""
    return mdnum.fork_forecast(system, length, **how)


@fork.command()
@_OF_A_SYSTEM
def benign(system: str = SYSTEM_ARGUMENT, choice: str = typer.Argument(), how: Any = None) -> Any:
    """Find whether a choice changes anything that would be measured, with ensembles of runs."""
    return mdnum.fork_benign(system, choice, **how)


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
