"""What a run folder says, to people: findings, figures, one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mdnum.store import RunFolder

__all__ = ["judge", "write"]


def write(folder: RunFolder | str | Path) -> Path:
    """Writes report.html of a run folder, whichever world it is of, with findings and verdict.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no run in the folder, or it cannot be written.
    """
    world = _world(folder)
    if world == "ball":
        from mdnum.report.ball.html import write_report
    elif world == "fork":
        from mdnum.report.fork.html import write_report
    else:
        from mdnum.report.html import write_report

    return write_report(folder)


def judge(folder: RunFolder | str | Path) -> None:
    """Puts findings and verdict of a run folder into its summary.json, without a report.

    Raises:
        FolderError: no run in the folder, or it cannot be written.
    """
    world = _world(folder)
    if world == "ball":
        from mdnum.report.ball.findings import record
    elif world == "fork":
        from mdnum.report.fork.findings import record
    else:
        from mdnum.report.findings import record

    record(folder)


def _world(folder: RunFolder | str | Path) -> str:
    """ "ball", "fork" or "md"; folders from before there were two worlds do not say."""
    from mdnum.store import RunFolder

    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    return str(folder.summary.get("world") or "md")
