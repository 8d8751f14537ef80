"""`mdnum grad`: the derivative of a loss through a whole rollout, by several methods."""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output
from mdnum.cli.progress import watched


def grad(
    system: str = typer.Argument(
        metavar="SYSTEM", help="A name from `mdnum systems list`, or the path of a TOML file."
    ),
    of: str | None = typer.Option(
        None, metavar="LOSS", help="What to differentiate: msd, vacf, potential, temperature, pressure, ..."
    ),
    wrt: list[str] | None = typer.Option(
        None, metavar="NAME,NAME", help="By which parameters: epsilon, r_cut, initial.velocities, ..."
    ),
    steps: int | None = typer.Option(
        None, min=1, help="The horizon; the system's own steps, but no more than 500, by default."
    ),
    methods: list[str] | None = typer.Option(
        None,
        metavar="WORD,WORD",
        help="Ways to differentiate, or all; by default those that answer within about a minute.",
    ),
    replicas: int = typer.Option(
        0, min=0, metavar="N", help="Other starts, for the standard error of the gradient; none by default."
    ),
    also: list[str] | None = typer.Option(
        None, metavar="WORD,WORD", help="Further parts of the diagnosis: spectrum, edges, scaling, or all."
    ),
    no_half_step: bool = typer.Option(
        False,
        "--no-half-step",
        help="Do not make the gradient at half the time step too; then nothing is called trusted.",
    ),
    settings: list[str] | None = output.SET_OPTION,
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The gradient folder; runs/grad-NAME-N by default."
    ),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Differentiate a loss through a rollout, compare the ways of doing it, and say how far to trust it."""
    overrides = output.parse_overrides(settings)
    from mdnum.verbs import grad as differentiate

    with watched() as progress:
        outcome = differentiate(
            system,
            of,
            wrt or (),
            steps=steps,
            methods=methods or None,
            replicas=replicas,
            also=also or (),
            half_step=not no_half_step,
            out=out,
            overrides=overrides,
            report=not no_report,
            progress=progress,
        )
    return output.print_outcome(outcome, as_json=as_json)
