"""Plain values as text, with as many digits as tell them apart, and as JSON."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mdnum.report.words import MINUS, count, power

#: Members of a list that are told; of longer ones, the first and the last.
_LISTED = 16
#: Digits up to which a number is told as it is, because it was chosen or is exact.
_CHOSEN = 10


def is_number(value: Any) -> bool:
    """Whether a value is written as a number, or is missing among numbers."""
    value = _host(value)
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def value_text(value: Any, digits: int = 10) -> str:
    """A value as people read it: numbers to so many significant digits, lists in brackets, yes and no."""
    value = _host(value)
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return count(value) if abs(value) >= 10_000 else str(value).replace("-", MINUS)
    if isinstance(value, float):
        return _float_text(value, digits)
    if isinstance(value, complex):
        sign = MINUS if value.imag < 0 else "+"
        return f"{_float_text(value.real, digits)} {sign} {_float_text(abs(value.imag), digits)} i"
    if isinstance(value, Mapping):
        return ", ".join(
            f"{str(key).replace('_', ' ')} {value_text(item, digits)}" for key, item in value.items()
        )
    if isinstance(value, list | tuple):
        return _list_text(value, digits)
    return str(value)


def cells(column: Sequence[Any]) -> list[str]:
    """The texts of a table's column: the fewest digits, five at least, that keep its numbers apart."""
    host = [_host(value) for value in column]
    floats = {value for value in host if isinstance(value, float) and math.isfinite(value)}
    digits = 5
    while digits < 17 and len({f"{value:.{digits - 1}e}" for value in floats}) < len(floats):
        digits += 1
    whole = [value for value in host if isinstance(value, int) and not isinstance(value, bool)]
    if any(abs(value) >= 10_000 for value in whole):
        # thousands are set apart in all of a column or in none
        host = [
            count(value) if isinstance(value, int) and not isinstance(value, bool) else value
            for value in host
        ]
    return [value_text(value, digits) for value in host]


def json_value(value: Any) -> Any:
    """Plain values for JSON: arrays as lists, complex numbers as [re, im], NaN and infinity as null."""
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [json_value(item) for item in value]
    value = _host(value)
    if isinstance(value, list):
        return [json_value(item) for item in value]
    if isinstance(value, complex):
        return [json_value(value.real), json_value(value.imag)]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def _host(value: Any) -> Any:
    """Numbers of numpy, JAX and narrow formats as Python's, arrays as lists."""
    if isinstance(value, bool | int | float | complex | str | None | Mapping | list | tuple):
        return value
    if hasattr(value, "__array__"):
        array = np.asarray(value)
        if array.dtype.kind not in "biufcOSU":
            # bfloat16 and its like are unknown to numpy
            array = array.astype(np.float64)
        return array.item() if array.ndim == 0 else array.tolist()
    return value


def _float_text(value: float, digits: int) -> str:
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return f"{MINUS if value < 0 else ''}∞"
    if value == 0:
        return "0"
    shortest = repr(abs(value))
    mantissa, exponent = f"{abs(value):.{digits - 1}e}".split("e")
    scale = int(exponent)
    sign = MINUS if value < 0 else ""
    if -5 < scale < 7:
        text = f"{abs(value):.{max(0, digits - 1 - scale)}f}" if scale < digits else f"{abs(value):.0f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
        # a number that was chosen is told as it was written
        plain = re.fullmatch(r"\d+(\.\d+)?", shortest) and len(shortest.lstrip("0.")) <= _CHOSEN
        return sign + (shortest.removesuffix(".0") if plain else text)
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    if mantissa == "1":
        return sign + power(scale)
    return f"{sign}{mantissa}\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}{power(scale)}"


def _list_text(values: Sequence[Any], digits: int) -> str:
    # a list of lists is a table, a line each
    if values and all(isinstance(_host(item), list | tuple) for item in values) and len(values) <= 8:
        return " / ".join(_list_text(_host(item), digits) for item in values)
    digits = min(digits, 5) if len(values) > 3 else digits
    texts = [value_text(item, digits) for item in values]
    if len(texts) > _LISTED:
        texts = [*texts[:6], "…", texts[-1]]
        return f"[{', '.join(texts)}] ({len(values)} values)"
    return f"[{', '.join(texts)}]"
