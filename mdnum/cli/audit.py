"""`mdnum audit`: is this potential safe to run and to differentiate?"""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output
from mdnum.cli.progress import watched


def _names() -> str:
    from mdnum.audit.checks import CHECKS

    return ", ".join(CHECKS)


def audit(
    calculator: str | None = typer.Argument(
        None,
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
    checks: list[str] | None = typer.Option(None, metavar="NAME,NAME", help=f"Only these: {_names()}."),
    temperature: float | None = typer.Option(
        None, min=0.0, metavar="KELVIN", help="For kT and for the run; 300 K by default."
    ),
    timestep: float | None = typer.Option(
        None, min=0.0, metavar="FS", help="Of the run; from the fastest vibration by default."
    ),
    steps: int | None = typer.Option(None, min=16, help="Of the run; 200 by default."),
    time: float | None = typer.Option(
        None, metavar="MINUTES", help="Ask nothing more after that; what was not asked is listed."
    ),
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The audit folder; runs/audit-NAME-N by default."
    ),
    resume: Path | None = typer.Option(
        None, metavar="DIR", help="Ask what the audit in this folder has not asked, of the same calculator."
    ),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Ask any ASE calculator: is it smooth, invariant, conservative, free of memory, does it keep energy?

    Runs the Python that makes the calculator, with --resume what the folder names. No other verb but
    `conform` runs Python that it is given.
    """
    from mdnum.verbs.audit import AuditStopped
    from mdnum.verbs.audit import audit as ask

    stopped = False
    folder = resume or out

    def remedy() -> str | None:
        begun = folder is not None and (folder / "answers.json").exists()
        return f"Continue with `mdnum audit --resume {folder}`" if begun else None

    notes = output.noted(resume)
    with watched(remedy) as progress:
        try:
            outcome = ask(
                calculator, structure, checks=checks or None, temperature=temperature, timestep=timestep,
                steps=steps, time=time, out=out, resume=resume, report=not no_report, progress=progress,
            )  # fmt: skip
        except AuditStopped as stop:
            outcome, stopped = stop.outcome, True
    output.print_lines(notes)
    code = output.print_outcome(outcome, as_json=as_json)
    return output.EXIT_STOPPED if stopped else code
