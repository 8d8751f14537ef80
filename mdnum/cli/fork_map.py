"""`mdnum fork SYSTEM --along KEY=LOW:HIGH`: where the history of decisions changes along a number."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mdnum.cli import output
from mdnum.cli.progress import ProgressBar
from mdnum.errors import InputError

_INTERVAL = re.compile(r"^\s*([^=\s]+)\s*=\s*([^:\s]+)\s*:\s*([^:\s]+)\s*$")


def interval(text: str) -> tuple[str, float, float]:
    """The words of `--along KEY=LOW:HIGH`.

    Raises:
        InputError: not of that form.
    """
    found = _INTERVAL.match(text)
    try:
        if found is None:
            raise ValueError
        return found[1], float(found[2]), float(found[3])
    except ValueError:
        raise InputError(
            f"--along {text!r} is not of the form KEY=LOW:HIGH",
            remedy="Write for example --along potential.sigma=3.40:3.41",
        ) from None


def along(
    system: str,
    text: str,
    steps: int | None,
    most: int | None,
    overrides: Mapping[str, str],
    *,
    out: Path | None,
    report: bool,
    as_json: bool,
) -> int:
    """Write and print the map of a system along a number."""
    key, low, high = interval(text)
    from mdnum.workflow import fork_map

    with ProgressBar() as progress:
        result = fork_map(
            system,
            key,
            low,
            high,
            steps=steps,
            most=most,
            out=out,
            overrides=overrides,
            report=report,
            progress=progress,
        )
    return output.answer(result.folder, result.summary, _print, as_json=as_json)


def _print(summary: Mapping[str, Any]) -> None:
    unit = f" ({summary['loss_unit']})" if summary["loss_unit"] else ""
    table = [
        (
            f"{row['below']!r}\n{row['above']!r}",
            f"{row['step']:,}",
            f"{row['who']}\n{row['way']}",
            "\n".join(_signed(row[f"margin_{side}"], 2) for side in ("below", "above")),
            _signed(row["jump"], 3),
            *(() if row["apart"] is None else (f"{row['apart']:.2e}",)),
            row["confirmed"],
        )
        for row in summary["boundaries"]
    ]
    if table:
        columns = [
            "below, above",
            "step",
            "decision",
            "margins",
            f"jump of the loss{unit}",
            "apart",
            "confirmed",
        ]
        if summary["apart_largest"] is None:
            columns.remove("apart")
        output.print_table("", columns, table)
    counts = [
        ("histories", f"{summary['histories']:,}"),
        ("runs", f"{summary['evaluations']:,} of {summary['steps']:,} steps"),
        ("not searched", f"{len(summary['unresolved']):,}"),
        ("may be missed", f"pairs of boundaries closer than {summary['resolution']:.2g}"),
    ]
    if not summary["unresolved"]:
        del counts[2]
    if summary["complete"]:
        counts[-1] = ("may be missed", "nothing: every float was run")
    output.print_table("", ("", ""), counts)


def _signed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:+.{digits}e}"
