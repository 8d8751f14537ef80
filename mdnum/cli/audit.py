"""`mdnum audit`: is this potential safe to run and to differentiate?"""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output
from mdnum.cli.audit_print import by_cause, print_rows
from mdnum.cli.progress import watched


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
    checks: list[str] | None = typer.Option(
        None,
        metavar="WORD,WORD",
        help="Only these: invariance, smoothness, forces, curl, state, dynamics.",
    ),
    temperature: float | None = typer.Option(
        None, min=0.0, metavar="KELVIN", help="For kT and for the run; 300 K by default."
    ),
    timestep: float | None = typer.Option(
        None, min=0.0, metavar="FS", help="Of the run; from the fastest vibration by default."
    ),
    steps: int | None = typer.Option(None, min=16, help="Of the run; 200 by default."),
    time: float | None = typer.Option(
        None, metavar="MINUTES", help="Ask nothing more after that; what was not asked is told."
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
    """Ask any ASE calculator: is it smooth, invariant, conservative, forgetful, and does it keep energy?

    Runs the Python that makes the calculator, with --resume what the folder names. No other verb but
    `conform` runs Python that it is given.
    """
    from mdnum.workflow.audit import AuditStopped
    from mdnum.workflow.audit import audit as ask

    stopped = False
    folder = resume or out

    def go_on() -> str | None:
        begun = folder is not None and (folder / "checkpoint.npz").exists()
        return f"Continue with `mdnum audit --resume {folder}`" if begun else None

    notes = output.noted(resume)
    with watched(go_on) as progress:
        try:
            result = ask(
                calculator,
                structure,
                checks=checks or None,
                temperature=temperature,
                timestep=timestep,
                steps=steps,
                time=time,
                out=out,
                resume=resume,
                report=not no_report,
                progress=progress,
            )
        except AuditStopped as stop:
            result, stopped = stop.result, True
    output.print_lines(notes)
    summary = result.summary if as_json else by_cause(result.summary)
    code = output.answer(result.folder, summary, print_rows, as_json=as_json)
    if result.summary["status"] != "complete" and not as_json:
        typer.echo(f"ask the rest, and anew what was cut short: mdnum audit --resume {result.folder}")
    return output.EXIT_STOPPED if stopped else code
