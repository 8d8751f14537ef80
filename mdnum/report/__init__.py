"""What a run folder says, to people: findings, figures, one HTML file."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.store import RunFolder

__all__ = ["judge", "write"]

# which module judges a folder (`record`) and which writes its page (`write_report`); folders that answer
# another question than what a run does or where two part go by that question
_MODULES = {
    "ball": ("mdnum.report.ball.findings", "mdnum.report.ball.html"),
    "audit": ("mdnum.report.audit.html", "mdnum.report.audit.html"),
    "grad": ("mdnum.report.grad.html", "mdnum.report.grad.html"),
    "conform": ("mdnum.report.conform.html", "mdnum.report.conform.html"),
    "flips": ("mdnum.report.flips.html", "mdnum.report.flips.html"),
    "flips-compare": ("mdnum.report.flips.compare", "mdnum.report.flips.compare"),
}


def write(folder: RunFolder | str | Path) -> Path:
    """Writes report.html of a run folder, whichever world it is of, with findings and verdict.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no run in the folder, or it cannot be written.
    """
    opened, _, writes = _modules(folder)
    with opened.explained():
        return writes.write_report(opened)


def judge(folder: RunFolder | str | Path) -> None:
    """Puts findings and verdict of a run folder into its summary.json, without a report.

    Raises:
        FolderError: no run in the folder, or it cannot be written.
    """
    opened, judges, _ = _modules(folder)
    with opened.explained():
        judges.record(opened)


def _modules(folder: RunFolder | str | Path) -> tuple[RunFolder, Any, Any]:
    """A folder, what judges it, and what writes its page."""
    from mdnum.errors import FolderError
    from mdnum.store import RunFolder

    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    summary = folder.summary
    if not summary and folder.world != "md":
        raise FolderError(
            f"holds no answer: `mdnum {folder.verb}` was stopped before it had one",
            remedy=folder.again,
            where=str(folder.path),
        )
    # a folder from before there were two worlds does not say; one that was killed has its tables alone
    kinds = (summary.get("question"), summary.get("world"), folder.world)
    kind = next(kind for kind in kinds if isinstance(kind, str) and kind in _MODULES)
    judges, writes = (importlib.import_module(name) for name in _MODULES[kind])
    return folder, judges, writes
