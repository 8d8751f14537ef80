"""A gradient folder in the terminal: derivatives by method, and what was left out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mdnum.cli import output

#: Digits of a derivative, where none is known not to hold.
_MOST = 8


def print_rows(summary: Mapping[str, Any]) -> None:
    """What a gradient folder says below its headline."""
    out = output.console()
    loss = summary["loss"]
    many, noun = (summary["atoms"], "atom") if "atoms" in summary else (summary["balls"], "ball")
    size = f"{many:,} {noun}{'' if many == 1 else 's'}"
    out.print(
        f"  {summary['system']}, {size}, {summary['steps']:,} steps; "
        + f"{loss['word']} = {summary['value']:.10g} {loss['unit']}".rstrip(),
        markup=False,
    )
    _print_methods(summary)
    for part in ("growth", "flips", "trust"):
        if found := summary.get(part):
            out.print(f"  {part}: {found['says']}", markup=False)
    for one in summary["refused"]:
        out.print(f"  {one['method']} gave none: {one['why']}", markup=False)
    left = [one for one in summary["left_out"] if one["how"]]
    if left:
        rows = [(one["what"], one["why"], one["how"]) for one in left]
        output.print_table("left out (--methods all asks for all methods)", ("", "", "to have it"), rows)
    if never := [one["what"] for one in summary["left_out"] if not one["how"]]:
        out.print(f"  do not apply (why is in the report): {', '.join(never)}", markup=False)


def _print_methods(summary: Mapping[str, Any]) -> None:
    """Derivatives by method, each with how far it is from the reference."""
    from mdnum.report.grad.words import digits_note, held

    names = [one["name"] for one in summary["parameters"]]
    apart = {(row["method"], row["name"]): row for row in summary["comparisons"]}
    reference = summary["reference"]
    half = (summary.get("trust") or {}).get("half")
    table = []
    if exact := summary.get("exact"):
        table.append(
            ("closed form", *(part for name in names for part in (output.show(exact.get(name)), "")))
        )
    for one in sorted(summary["methods"], key=lambda one: one["method"] != reference):
        cells = []
        for name in names:
            note = digits_note(summary, name) if one["method"] == reference else ""
            cells += [
                _slope(one, name, held(summary, name, _MOST)) + (f" ({note})" if note else ""),
                _apart(apart.get((one["method"], name))),
            ]
        table.append((one["method"], *cells))
        if half and one["method"] == reference:
            shorter = {"gradient": half, "error": {}}
            cells = [
                cell for name in names for cell in (_slope(shorter, name, held(summary, name, _MOST)), "")
            ]
            table.append(("  at half the time step", *cells))
    heads = [_head(one) for one in summary["parameters"]]
    columns = [part for head in heads for part in (head, f"from {reference}")]
    output.print_table("", ("method", *columns), table)
    # one line for each note, whatever it is about
    notes: dict[tuple[str, str], list[str]] = {}
    for one in summary["methods"]:
        for name, note in one["notes"].items():
            notes.setdefault((one["method"], note), []).append(name)
    for (method, note), about in notes.items():
        output.console().print(f"  {method} by {', '.join(about)}: {note}", markup=False)


def _head(parameter: Mapping[str, Any]) -> str:
    """A parameter as the head of a column, with what its entries belong to."""
    entries = parameter.get("entries")
    return f"d/d {parameter['name']}" + (f" ({', '.join(entries)})" if entries else "")


def _slope(found: Mapping[str, Any], name: str, digits: int | None) -> str:
    """A derivative, with so many digits where they are limited."""
    value = found["gradient"].get(name)
    kept = _MOST if digits is None else digits
    if isinstance(value, Mapping):
        return f"norm {value['norm']:.{kept}g}"
    if isinstance(value, list):
        return ", ".join(f"{entry:.{kept}g}" for entry in value)
    error = found["error"].get(name)
    text = "-" if value is None else f"{value:.{kept}g}"
    return f"{text} ± {error:.2g}" if isinstance(error, float) else text


def _apart(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ""
    means = f", {row['means']}" if row["means"] else ""
    return f"{row['relative']:.2g}{means}" if row["relative"] is not None else "-"
