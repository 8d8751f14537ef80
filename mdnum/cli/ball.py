"""`mdnum ball`: a bouncing ball, or a demonstration with one."""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output
from mdnum.cli.progress import watched
from mdnum.errors import InputError


def ball(
    system: str | None = typer.Argument(
        None, metavar="SYSTEM", help="A ball's name from `mdnum systems list`, or the path of a TOML file."
    ),
    demo: str | None = typer.Option(
        None, "--demo", metavar="NAME", help="Run a demonstration instead, or all of them: --demo all."
    ),
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The run folder; runs/NAME-N by default."
    ),
    steps: int | None = typer.Option(None, min=1, help="Steps to run, instead of the system's own."),
    settings: list[str] | None = output.SET_OPTION,
    against: list[str] | None = typer.Option(
        None, metavar="KEY=VALUE", help="Compare with the system with this key changed; repeatable."
    ),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Bounce a ball and record every decision, or run a demonstration."""
    if demo is not None:
        given = {"a system": system, "--steps": steps, "--set": settings, "--against": against}
        foreign = [name for name, value in given.items() if value]
        if foreign:
            raise InputError(
                f"a demonstration has its own balls, so it takes no {foreign[0].removeprefix('a ')}",
                remedy="Leave one of them out",
                where="--demo",
            )
        from mdnum.verbs.demos import demonstrate

        with watched() as progress:
            outcome = demonstrate(demo, out=out, report=not no_report, progress=progress)
        return output.print_outcome(outcome, as_json=as_json)
    if system is None:
        return _list(as_json)
    overrides = output.parse_overrides(settings)
    from mdnum.verbs import bounce

    with watched() as progress:
        outcome = bounce(
            system,
            out=out,
            steps=steps,
            overrides=overrides,
            against=against or (),
            report=not no_report,
            progress=progress,
        )
    return output.print_outcome(outcome, as_json=as_json)


def _list(as_json: bool) -> int:
    """What there is to run, for somebody who named nothing."""
    from mdnum import systems
    from mdnum.verbs import demos

    balls = [systems.load(name, world="ball") for name in systems.names("ball")]
    rows = [{"name": one.name, "balls": one.balls, "about": one.spec.about} for one in balls]
    scripts = [{"name": name, "about": demos.about(name)} for name in demos.names()]
    if as_json:
        output.print_json({"systems": rows, "demos": scripts})
        return output.EXIT_FINE
    lines = [(row["name"], row["balls"], row["about"].partition(". ")[0]) for row in rows]
    output.print_table("systems: `mdnum ball NAME`", ("name", "balls", "about"), lines)
    output.say("")
    title = "demonstrations: `mdnum ball --demo NAME`, or all"
    output.print_table(title, ("name", "about"), [(row["name"], row["about"]) for row in scripts])
    return output.EXIT_FINE
