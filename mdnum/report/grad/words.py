"""Derivatives in words: numbers with their units, and differences with what they mean."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mdnum.report.fork.question import Question
from mdnum.report.words import MINUS, number, percent, power

#: Which derivative a closed form gives.
EXACT = "the derivative of the exact motion"
#: Digits that are told where nobody knows how many hold.
_UNKNOWN = 2


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


def digits_of(summary: Mapping[str, Any], name: str) -> int | None:
    """Digits of a derivative that half the time step leaves; None where that was not looked at."""
    return ((summary.get("trust") or {}).get("digits") or {}).get(name)


def unknown_digits(summary: Mapping[str, Any], name: str) -> bool:
    """Whether a derivative belongs to a question about trust, and nobody knows how many digits of it hold."""
    return bool(summary.get("trust")) and digits_of(summary, name) is None


def held(summary: Mapping[str, Any], name: str, most: int) -> int | None:
    """Digits that a derivative is told with, `most` at most; None where no question was about its trust."""
    if unknown_digits(summary, name):
        return min(_UNKNOWN, most)
    known = digits_of(summary, name)
    return None if known is None else max(min(known, most), 1)


def digits_note(summary: Mapping[str, Any], name: str) -> str:
    """What must be known beside the digits of a derivative; "" where they hold, or nobody asked."""
    if unknown_digits(summary, name):
        return "digits not known"
    return "no digit holds" if digits_of(summary, name) == 0 else ""


def half(summary: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The reference's derivatives at half the time step, as those of a method."""
    found = (summary.get("trust") or {}).get("half")
    if not found:
        return None
    says = "the same time in twice as many steps: the digits that agree are those that are told"
    return {"method": f"{summary['reference']} at half the time step", "says": says, "gradient": found}


def resolved(value: float | None, digits: int) -> str:
    """A number with so many digits, one at least; in powers of ten where zeros would look like more."""
    digits = max(digits, 1)
    if value is None or not math.isfinite(value) or value == 0:
        return number(value, digits)
    mantissa, exponent = f"{abs(value):.{digits - 1}e}".split("e")
    if int(exponent) < digits:
        return number(value, digits)
    return (
        f"{MINUS if value < 0 else ''}{mantissa}\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}{power(int(exponent))}"
    )


def one_slope(summary: Mapping[str, Any], name: str, value: float | None, digits: int) -> str:
    """One number of a derivative by a parameter as text, `digits` at most."""
    kept = held(summary, name, digits)
    return number(value, digits) if kept is None else resolved(value, kept)


def slope(summary: Mapping[str, Any], found: Mapping[str, Any] | None, name: str, digits: int = 6) -> str:
    """A derivative as text, with the digits that half the time step leaves."""
    if found is None or name not in found["gradient"]:
        return "–"
    value = found["gradient"][name]

    def told(entry: float | None) -> str:
        return one_slope(summary, name, entry, digits)

    if isinstance(value, Mapping):
        return f"norm {told(value['norm'])}"
    if isinstance(value, list):
        return ", ".join(told(entry) for entry in value)
    error = (found.get("error") or {}).get(name)
    return told(value) + (f" ± {number(error, 2)}" if isinstance(error, float) else "")


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
        return "not finite" if row["size"] else "where the other is 0"
    if relative == 0:
        return "the same"
    return percent(relative) + " off" if relative >= 1e-3 else f"{number(relative, 2)} off"
