"""Formatting of numbers and words for readers."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MINUS = "\N{MINUS SIGN}"


def power(exponent: int) -> str:
    """Return the text 10ⁿ for a given exponent n."""
    return "10" + str(exponent).translate(_RAISED)


def number(value: float | None, digits: int = 3, signed: bool = False, whole: bool = True) -> str:
    """Format a number with significant digits. Numbers far from 1 are shown with powers of ten. None is "–".

    Args:
        whole: True to write numbers up to a million in full, even with digits beyond the significant ones.
    """
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return f"{MINUS if value < 0 else ''}∞"
    if value == 0:
        return "0"
    sign = MINUS if value < 0 else "+" if signed else ""
    mantissa, exponent = f"{abs(value):.{digits - 1}e}".split("e")
    scale = int(exponent)
    if -4 < scale < (6 if whole else min(6, digits)):
        # whole numbers are told in full: 123,456 rather than 123,000
        rounded = float(f"{mantissa}e{exponent}") if scale < digits else abs(value)
        return sign + f"{rounded:,.{max(0, digits - 1 - scale)}f}"
    return sign + _scientific(mantissa, scale)


def _scientific(mantissa: str, exponent: int) -> str:
    # no-break spaces: a number is one word
    return f"{mantissa}\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}{power(exponent)}"


def count(value: float | None) -> str:
    """Format an integer with thousands separators; "–" for None."""
    return "–" if value is None else f"{int(value):,}".replace("-", MINUS)


def plain(value: float | None, digits: int = 4) -> str:
    """Format a number that was chosen (not measured), without trailing zeros."""
    text = number(value, digits)
    return text.rstrip("0").rstrip(".") if "." in text and "×" not in text else text


def pair_name(pair: Mapping[str, Any]) -> str:
    """Return the atom labels of a pair, and its potential term if terms have their own cutoffs."""
    return f"{pair['i']}–{pair['j']}" + (f" ({pair['terms']})" if pair.get("terms") else "")


def many(value: float | None, noun: str, plural: str | None = None) -> str:
    """Return a number with its noun, for example 1 pair, 2 pairs, no pairs."""
    plural = plural or noun + "s"
    if not value:
        return f"no {plural}"
    return f"{count(value)} {noun if value == 1 else plural}"


def percent(share: float | None) -> str:
    """Format a fraction as a percentage that is never rounded to 0 % or 100 %. None means infinity."""
    if share is None or 0 < share < 0.001:
        return "under 0.1 %" if share else "an unbounded share"
    if 0.999 < share < 1:
        return "over 99.9 %"
    return f"{100 * share:.1f} %" if 0 < share < 0.1 else f"{100 * share:.0f} %"


def typeset(text: str) -> str:
    """Typeset numbers: -1.5e-16 becomes −1.5 × 10⁻¹⁶, and 2^15 becomes 2¹⁵."""
    text = re.sub(r"(?<![\w.])(\d+(?:\.\d+)?)[eE]([+-]?\d+)(?![\w.]*\w)", _as_power, text)
    text = re.sub(r"(?<=\w)(?:\^|\*\*)(-?\d+)", lambda found: found[1].translate(_RAISED), text)
    text = re.sub(r"\bsqrt\((\w+)\)", r"√\1", text)
    return re.sub(r"(?<![\w.)\]–-])-(?=[\d.∞])", MINUS, text)


def _as_power(found: re.Match[str]) -> str:
    return power(int(found[2])) if found[1] == "1" else _scientific(found[1], int(found[2]))


def heading(text: str) -> str:
    """Capitalize a heading, unless it begins with the name of a program or a quantity."""
    first = text.split(" ", 1)[0]
    plain = first == "a" or (len(first) > 1 and first.isalpha() and first.islower())
    return text[:1].upper() + text[1:] if plain else text


def listed(items: Sequence[str]) -> str:
    """Join words in the form "a, b and c"."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"
