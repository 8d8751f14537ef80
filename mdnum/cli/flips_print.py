"""A folder of flips in the terminal: what was read, counts by rule, lifetimes, and what cannot be told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mdnum.cli import output


def print_rows(summary: Mapping[str, Any]) -> None:
    """What a folder of flips says below its headline."""
    out = output.console()
    out.print(f"  {_file(summary)}", markup=False)
    out.print(f"  {summary['resolution']['words']}", markup=False)
    columns = (
        "rule",
        "pairs",
        "flips",
        "per frame",
        "undecidable",
        "median life",
        "mean life by rate",
        "chatter",
    )
    rows = [
        (
            one["rule"], f"{one['pairs_first']:,} to {one['pairs_last']:,}", f"{one['flips']:,}",
            one["flips_per_frame"], f"{one['ambiguous']:,}", _length(one["lifetime"]["median"], summary),
            _length(one["lifetime"]["mean_by_rate"], summary), f"{100 * one['chatter']['share']:.1f} %",
        )
        for one in summary["rules"]
    ]  # fmt: skip
    output.print_table("", columns, rows)


def print_comparison(summary: Mapping[str, Any]) -> None:
    """What a comparison of two trajectories says below its headline."""
    from mdnum.report.words import many

    out = output.console()
    out.print(f"  {summary['system']} and {summary['other']}, {many(summary['atoms'], 'atom')}", markup=False)
    for line in summary["concluded"]:
        out.print(f"  {line}", markup=False)
    for one in summary["rules"]:
        _print_pairs(summary, one, len(summary["rules"]) > 1)


def _print_pairs(summary: Mapping[str, Any], found: Mapping[str, Any], several: bool) -> None:
    """The pairs of one rule that differ first."""
    rows = [
        (f"{one['i']}-{one['j']}", f"{one['inside']} only", *(f"{one[name]:.10g}" for name in ("distance_a",
         "distance_b")), one["margin_a"], one["margin_b"])
        for one in found["first_pairs"]
    ]  # fmt: skip
    if not rows:
        return
    unit = f" ({summary['length']})" if summary["length"] else ""
    columns = ("pair", "inside in", f"r in A{unit}", "r in B", "margin in A", "margin in B")
    certain = found["certain_frame"] or "no frame"
    shown = f"{len(rows)} of {found['first']['pairs']:,} pairs" if len(rows) < found["first"]["pairs"] else ""
    title = f"first to differ, {found['first_frame']}; beyond the files' resolution, {certain}"
    title = "; ".join(one for one in (found["rule"] if several else "", title, shown) if one)
    output.print_table(title, columns, rows)


def _file(summary: Mapping[str, Any]) -> str:
    from mdnum.report.words import many

    size = f"{many(summary['atoms'], 'atom')}, {many(summary['frames'], 'frame')}"
    if summary["timed"] and summary["frames"] > 1:
        size += f" {_time(format(summary['interval'], '.6g'), summary)} apart"
    return f"{summary['system']} ({summary['format']}, read by {summary['reader']}), {size}"


def _length(frames: float | None, summary: Mapping[str, Any]) -> str:
    """A stretch of frames as time, where the file has times."""
    if frames is None:
        return "longer than seen"
    if summary["timed"] and summary["interval"] is not None:
        return _time(f"{frames * summary['interval']:.4g}", summary)
    return f"{frames:.4g} frame{'' if frames == 1 else 's'}"


def _time(number: str, summary: Mapping[str, Any]) -> str:
    """With its unit, of which steps have a plural."""
    return f"{number} {summary['time']}{'s' if summary['time'] == 'step' and number != '1' else ''}"
