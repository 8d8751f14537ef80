"""`mdnum report`: write the report page of an existing output folder again."""

from __future__ import annotations

from pathlib import Path

from mdnum.plain import HEAD, headed
from mdnum.verbs import Reply
from mdnum.verbs.frame import finish


def report(folder: Path) -> Reply:
    """Judge the results in an output folder again, and rewrite its report page."""
    outcome = finish(folder)
    written = outcome.folder / "report.html"
    kept = {name: outcome.summary[name] for name in HEAD} | {"of": outcome.kind}
    return Reply(headed("report", {**kept, "folder": folder, "report": written}), [f"wrote {written}"])
