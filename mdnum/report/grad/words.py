"""Derivatives in words: numbers with their units, and differences with what they mean."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mdnum.report.fork.question import Question
from mdnum.report.words import number, percent

#: Which derivative a closed form gives.
EXACT = "the derivative of the exact motion"


def by(run: Question, method: str) -> Mapping[str, Any] | None:
    """What a method found; the closed form counts as one."""
    if run.summary.get("exact") and method == run.summary["reference"]:
        return {"method": method, "says": EXACT, "gradient": run.summary["exact"], "details": {}}
    return next((one for one in run.summary["methods"] if one["method"] == method), None)


def size(value: Any) -> float | None:
    """A derivative as one number: itself, or the norm of several."""
    if isinstance(value, Mapping):
        return value["norm"]
    if isinstance(value, list):
        return sum(entry * entry for entry in value) ** 0.5 if None not in value else None
    return value


def slope(found: Mapping[str, Any] | None, name: str, digits: int = 6) -> str:
    """A derivative as text."""
    if found is None or name not in found["gradient"]:
        return "–"
    value = found["gradient"][name]
    if isinstance(value, Mapping):
        return f"norm {number(value['norm'], digits)}"
    if isinstance(value, list):
        return ", ".join(number(entry, digits) for entry in value)
    error = (found.get("error") or {}).get(name)
    return number(value, digits) + (f" ± {number(error, 2)}" if isinstance(error, float) else "")


def slope_unit(summary: Mapping[str, Any], parameter: Mapping[str, Any]) -> str:
    """The unit of a derivative."""
    above, below = summary["loss"]["unit"], parameter["unit"]
    if above == below:
        return ""
    if not below:
        return above
    above = f"({above})" if "/" in above else above or "1"
    joined = "/" in below and not below.startswith("√")
    return f"{above}/({below})" if joined else f"{above}/{below}"


def value_text(parameter: Mapping[str, Any]) -> str:
    """Where a parameter stands."""
    value = parameter["value"]
    if value is None:
        return ""
    if isinstance(value, Mapping):
        return " × ".join(f"{side:,}" for side in value["shape"]) + " numbers"
    text = ", ".join(map(repr, value)) if isinstance(value, list) else repr(value)
    unit = "" if parameter["unit"].startswith("[") else parameter["unit"]
    return f"{text} {unit}".rstrip()


def difference(run: Question, method: str, name: str) -> tuple[str, str, str]:
    """How far a method is from the reference, what that means, and the same in a sentence."""
    row = comparison(run, method, name)
    return ("", "", "") if row is None else (apart(row), row["means"], row["says"])


def comparison(run: Question, method: str, name: str) -> Mapping[str, Any] | None:
    """The comparison of a method with the reference."""
    rows = run.summary["comparisons"]
    return next((row for row in rows if row["method"] == method and row["name"] == name), None)


def apart(row: Mapping[str, Any]) -> str:
    """A relative difference as people say it."""
    relative = row["relative"]
    if relative is None:
        return "not finite"
    if relative == 0:
        return "the same"
    return percent(relative) + " off" if relative >= 1e-3 else f"{number(relative, 2)} off"
