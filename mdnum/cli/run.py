"""`mdnum run`: simulate a system, record its flips, check it, and write a run folder."""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output
from mdnum.cli.progress import watched
from mdnum.errors import InputError


def run(
    system: str | None = typer.Argument(
        None, metavar="SYSTEM", help="A name from `mdnum systems list`, or the path of a TOML file."
    ),
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The run folder; runs/NAME-N by default."
    ),
    steps: int | None = typer.Option(None, min=1, help="Steps to run, instead of the system's own."),
    save_every: int | None = typer.Option(
        None, min=0, metavar="K", help="Write every K-th frame to trajectory.traj; 0 writes none."
    ),
    settings: list[str] | None = output.SET_OPTION,
    resume: Path | None = typer.Option(None, metavar="DIR", help="Continue the run in this folder."),
    no_check: bool = typer.Option(False, "--no-check", help="Do not compare with ASE."),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Simulate a system and record every flip."""
    overrides = output.parse_overrides(settings)
    if resume is None and system is None:
        raise InputError("no system given", remedy="`mdnum systems list` names those that come with mdnum")
    if resume is not None and out is not None and out != resume:
        raise InputError(
            "--resume continues in its own folder, so --out cannot name another", remedy="Leave out --out"
        )
    if resume is not None and (system is not None or save_every is not None):
        raise InputError(
            "--resume continues a run with its own system and --save-every", remedy="Leave out the others"
        )
    if resume is not None and overrides:
        raise InputError(
            "--set would make the rest of a resumed run another run", remedy="Start a new run instead"
        )
    if resume is None:
        from mdnum.store.files import default_folder

        out = default_folder(str(system)) if out is None else out

    from mdnum.verbs import run as run_system

    folder = resume or out

    def go_on() -> str | None:
        if folder is None or not folder.exists():
            return None
        from mdnum.store.files import resumable

        if resumable(folder):
            return f"Continue with `mdnum run --resume {folder}`"
        return "Nothing of it was kept: give the command again"

    notes = output.noted(resume)
    with watched(go_on) as progress:
        result = run_system(
            system,
            out=out,
            steps=steps,
            save_every=save_every,
            overrides=overrides,
            resume=resume,
            check=not no_check,
            report=not no_report,
            progress=progress,
        )
    output.print_lines(notes)
    return output.print_outcome(result, as_json=as_json)
