"""`mdnum grad`: the derivative of a loss through a whole rollout, by several methods."""

from __future__ import annotations

from typing import Any

import typer

import mdnum
from mdnum.cli import output


@output.question(output.changed)
def grad(
    system: str = output.SYSTEM_ARGUMENT,
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
    how: Any = None,
) -> Any:
    """Differentiate a loss through a rollout, compare the ways of doing it, and say how far to trust it."""
    return mdnum.grad(
        system, of, wrt or (), steps=steps, methods=methods or None, replicas=replicas, also=also or (),
        half_step=not no_half_step, **how,
    )  # fmt: skip
