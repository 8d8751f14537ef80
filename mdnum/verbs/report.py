"""`mdnum report`: the page of a folder once more."""

from __future__ import annotations

from pathlib import Path

from mdnum.verbs import Reply
from mdnum.verbs.frame import finish


def report(folder: Path) -> Reply:
    """Judges a folder and writes its page, as the verb that made it does."""
    written = finish(folder).folder / "report.html"
    return Reply({"folder": folder, "report": written}, [f"wrote {written}"])
