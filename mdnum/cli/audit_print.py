"""An audit folder in the terminal: what each check says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mdnum.cli import output


def print_rows(summary: Mapping[str, Any]) -> None:
    """What an audit folder says below its headline."""
    out = output.console()
    out.print(f"  {summary['calculator']}, {summary['formula']}, {summary['atoms']:,} atoms", markup=False)
    rows = [(part["title"], part["says"]) for part in summary["parts"]]
    output.print_table("", ("", ""), rows)
    left = [one for one in summary["left_out"] if one["why"]]
    if left:
        rows = [(one["what"], one["why"]) for one in left]
        output.print_table("not looked at", ("", ""), rows[:6])
        if len(rows) > 6:
            out.print(f"  and {len(rows) - 6} more, which summary.json tells", markup=False)
