"""`mdnum fork SYSTEM --processes`: one system in several programs, and which of them agree."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mdnum.cli import output
from mdnum.cli.progress import ProgressBar


def processes(
    system: str,
    steps: int | None,
    overrides: Mapping[str, str],
    *,
    out: Path | None,
    report: bool,
    as_json: bool,
) -> int:
    """Write and print which programs of a system agree."""
    from mdnum.workflow import fork_processes

    with ProgressBar() as progress:
        result = fork_processes(
            system, steps=steps, out=out, overrides=overrides, report=report, progress=progress
        )
    return output.answer(result.folder, result.summary, _print, as_json=as_json)


def _print(summary: Mapping[str, Any]) -> None:
    out = output.console()
    for sentence in summary["causes"]:
        out.print(f"  {sentence}", markup=False)
    rows = sorted(summary["variants"], key=lambda row: (row["cluster"] is None, row["cluster"] or 0))
    table = [
        (
            "-" if row["cluster"] is None else row["cluster"] + 1,
            row["variant"],
            row["failed"] or _leaves(row, summary["reference"]),
            "" if row["failed"] else row["steps"],
            None if row["failed"] or not row["separation"] else f"{row['separation']:.3g}",
            f"{row['seconds']:.1f} s",
        )
        for row in rows
    ]
    columns = (
        "cluster",
        "program",
        f"first bit unlike {summary['reference']}",
        "steps",
        "apart at the end",
        "",
    )
    output.print_table("", columns, table)


def _leaves(row: Mapping[str, Any], reference: str) -> str:
    if row["variant"] == reference:
        return "(the reference)"
    return "none" if row["seed"] is None else f"step {row['seed']:,}"
