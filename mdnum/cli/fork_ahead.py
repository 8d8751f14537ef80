"""`mdnum fork SYSTEM --certify` and `--forecast`: what is certain of decisions, what would flip them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mdnum.cli import output
from mdnum.cli.progress import ProgressBar
from mdnum.errors import InputError


def certify(
    system: str,
    steps: int | None,
    overrides: Mapping[str, str],
    *,
    out: Path | None,
    report: bool,
    as_json: bool,
) -> int:
    """When runs under each precision policy leave the history in exact arithmetic."""
    from mdnum.workflow import fork_certify

    with ProgressBar() as progress:
        result = fork_certify(
            system, steps=steps, out=out, overrides=overrides, report=report, progress=progress
        )
    assert result.folder is not None, "of molecular dynamics"
    return output.answer(result.folder, result.summary, _print_certified, as_json=as_json)


def _print_certified(summary: Mapping[str, Any]) -> None:
    out = output.console()
    for sentence in summary["says"]:
        out.print(f"  {sentence}", markup=False)
    table = []
    for row in summary["policies"]:
        doubt = summary["ambiguous"].get(row["name"], {"total": None, "horizon": None})
        table.append(
            (
                row["name"],
                f"beyond step {summary['steps']:,}" if row["horizon"] is None else f"step {row['horizon']:,}",
                None if row["pair"] is None else f"{row['pair'][0]}–{row['pair'][1]}",
                None if row["growth_rate"] is None else f"{row['growth_rate']:.3g}",
                doubt["total"],
                None if doubt["horizon"] is None else f"step {doubt['horizon']:,}",
                row["failed"] or "",
            )
        )
    columns = ("precision", "leaves the exact history", "pair", "growth a step", "ambiguous", "from", "")
    output.print_table("", columns, table)


def foretell(
    system: str,
    size: float,
    steps: int | None,
    overrides: Mapping[str, str],
    *,
    out: Path | None,
    report: bool,
    as_json: bool,
) -> int:
    """Which decisions a perturbation of the start would flip first, from one tangent run."""
    if not 0 < size < float("inf"):
        raise InputError(f"--forecast {size:g}; expected a length above 0")
    from mdnum.workflow import fork_forecast

    with ProgressBar() as progress:
        result = fork_forecast(
            system, size, steps=steps, out=out, overrides=overrides, report=report, progress=progress
        )
    return output.answer(result.folder, result.summary, _print_foretold, as_json=as_json)


def _print_foretold(summary: Mapping[str, Any]) -> None:
    out = output.console()
    out.print(f"  {summary['says']}", markup=False)
    for title, flips in (("flips first", summary["first"]), ("nearest to flipping", summary["nearest"])):
        table = [
            (
                f"{flip['step']:,}",
                f"{flip['i']}–{flip['j']}",
                f"{flip['amplitude']:+.3e}",
                f"{flip['ulps']:.3g}",
                f"{flip['margin']:+.3e}",
            )
            for flip in flips
        ]
        if table:
            output.print_table(title, ("step", "pair", "displacement", "ulps of the start", "margin"), table)
