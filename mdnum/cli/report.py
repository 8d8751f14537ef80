"""`mdnum report`: write the report of a run folder again."""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output


def report(
    folder: Path = typer.Argument(metavar="DIR", help="A run folder."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Write the report of a run folder again."""
    from mdnum.store import RunFolder

    run = RunFolder.open(folder)
    if run.world == "ball":
        from mdnum.report.ball.html import write_report
    elif run.world == "fork":
        from mdnum.report.fork.html import write_report
    else:
        from mdnum.report.html import write_report
    written = write_report(run)
    if as_json:
        output.print_json({"folder": folder, "report": written})
    else:
        typer.echo(f"wrote {written}")
    return output.EXIT_FINE
