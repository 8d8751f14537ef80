"""An audit folder in the terminal: what each check says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mdnum.cli import output


def by_cause(summary: Mapping[str, Any]) -> dict[str, Any]:
    """A summary whose findings are those that stand by themselves; what goes below one is named there."""
    from mdnum.audit.causes import grouped

    findings = summary["findings"]
    shown = []
    for one, below in grouped(findings, [(each["code"], each["severity"]) for each in findings]):
        names = "; ".join(dict.fromkeys(each["title"] for each in below))
        more = f" What may follow from it was found too: {names}." if below else ""
        shown.append({**one, "text": one["text"] + more})
    return {**summary, "findings": shown}


def print_rows(summary: Mapping[str, Any]) -> None:
    """What an audit folder says below its headline."""
    out = output.console()
    out.print(f"  {summary['calculator']}, {summary['formula']}, {summary['atoms']:,} atoms", markup=False)
    rows = [(part["title"], _ways(part), part["says"]) for part in summary["parts"]]
    if rows:
        output.print_table("", ("", "asked", ""), rows)
    left = [one for one in summary["left_out"] if one["why"]]
    if left:
        rows = [(one["what"], one["why"]) for one in left]
        output.print_table("not looked at", ("", ""), rows[:6])
        if len(rows) > 6:
            out.print(f"  and {len(rows) - 6} more, which summary.json tells", markup=False)


def _ways(part: Mapping[str, Any]) -> str:
    asked, possible = part.get("asked", 0), part.get("possible", 0)
    return f"{asked:,}" if asked == possible else f"{asked:,} of {possible:,}"
