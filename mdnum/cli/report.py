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
    from mdnum.verbs import frame

    written = frame.finish(folder).folder / "report.html"
    output.print_notes(folder)
    if as_json:
        output.print_json({"folder": folder, "report": written})
    else:
        output.say(f"wrote {written}")
    return output.EXIT_FINE
