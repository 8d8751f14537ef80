"""`mdnum report`: rewriting of a folder's page."""

from __future__ import annotations

from pathlib import Path

from mdnum.plain import HEAD, headed
from mdnum.verbs import Reply
from mdnum.verbs.frame import finish


def report(folder: Path) -> Reply:
    """Judge a folder and write the page of the folder, as the verb that made the folder does."""
    outcome = finish(folder)
    written = outcome.folder / "report.html"
    kept = {name: outcome.summary[name] for name in HEAD} | {"of": outcome.kind}
    return Reply(headed("report", {**kept, "folder": folder, "report": written}), [f"wrote {written}"])
