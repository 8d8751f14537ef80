"""`mdnum audit`: is this potential safe to run and to differentiate?"""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output
from mdnum.cli.audit_print import print_rows
from mdnum.cli.progress import watched


def audit(
    calculator: str = typer.Argument(
        metavar="CALCULATOR",
        help="package.module:Class(argument=value), a Python file that makes a calculator, or a SYSTEM.",
    ),
    structure: Path | None = typer.Option(
        None,
        "-s",
        "--structure",
        metavar="FILE[@N]",
        help="A structure, the N-th of a file's (from 0; the last by default); one is built by default.",
    ),
    checks: list[str] | None = typer.Option(
        None,
        metavar="WORD,WORD",
        help="Only these: smoothness, invariance, forces, curl, state, dynamics.",
    ),
    temperature: float | None = typer.Option(
        None, min=0.0, metavar="KELVIN", help="For kT and for the run; 300 K by default."
    ),
    timestep: float | None = typer.Option(
        None, min=0.0, metavar="FS", help="Of the run; from the fastest vibration by default."
    ),
    steps: int | None = typer.Option(None, min=16, help="Of the run; 400, or what takes half a minute."),
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The audit folder; runs/audit-NAME-N by default."
    ),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Ask any ASE calculator: is it smooth, invariant, conservative, forgetful, and does it keep energy?

    Runs the Python that makes the calculator. No other verb but `conform` runs Python that it is given.
    """
    from mdnum.workflow.audit import AuditStopped
    from mdnum.workflow.audit import audit as ask

    stopped = False
    with watched() as progress:
        try:
            result = ask(
                calculator,
                structure,
                checks=checks or None,
                temperature=temperature,
                timestep=timestep,
                steps=steps,
                out=out,
                report=not no_report,
                progress=progress,
            )
        except AuditStopped as stop:
            result, stopped = stop.result, True
    code = output.answer(result.folder, result.summary, print_rows, as_json=as_json)
    return output.EXIT_STOPPED if stopped else code
