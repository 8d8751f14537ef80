"""Design of a sweep: the varied choices, their values, and the points to run.

A choice is a key of the system file, or a name for several keys (such as `precision`). Values of a choice
are written as in a system file.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np

from mdnum.errors import InputError
from mdnum.systems.toml import scalar

#: Largest number of points of a sweep, and of values of one range.
MOST_POINTS, _MOST_VALUES = 100_000, 10_000
#: Words for groups of keys, with their default values.
PRECISIONS = ("float64", "float32")
_ROLES = {"md": ("state", "force"), "ball": ("state", "arithmetic", "decision")}
_RANGE = re.compile(r"\s*([^:\s]+)\s*:\s*([^:\s]+)\s*:\s*([^:\s]+)\s*")
_REMEDY = "Write KEY=LOW:HIGH:STEP or KEY=VALUE,VALUE,…, such as cutoff.radius=2.0:3.5:0.25"
Design = Literal["one-at-a-time", "factorial", "space-filling"]


@dataclass(frozen=True)
class Axis:
    """A choice that is varied in a sweep, and its values."""

    key: str
    values: tuple[Any, ...]

    @property
    def ordered(self) -> bool:
        """True if all values of this choice are numbers."""
        return all(isinstance(one, int | float) and not isinstance(one, bool) for one in self.values)

    def settings(self, value: Any, world: str = "md") -> dict[str, Any]:
        """Return the system-file keys and values that belong to a value of this choice."""
        if self.key == "precision" and isinstance(value, str):
            return {f"precision.{role}": value for role in _ROLES[world]}
        return {self.key: value}


@dataclass(frozen=True)
class Point:
    """One setting (a value of each choice) and a random seed."""

    choices: Mapping[str, Any]  # a value for each axis
    seed: int | None  # None: the system's own


def parse(text: str) -> Axis:
    """Parse the description of a varied choice, such as KEY=LOW:HIGH:STEP or KEY=VALUE,VALUE,….

    Raises:
        InputError: the text has a different form, or contains repeated values.
    """
    key, equals, rest = (part.strip() for part in text.partition("="))
    if key == "precision" and not equals:
        return Axis(key, PRECISIONS)
    if not key or not rest:
        raise InputError(f"--over {text!r} has no values", remedy=_REMEDY)
    if found := _RANGE.fullmatch(rest):
        return Axis(key, _range(text, *map(scalar, found.groups())))
    if re.fullmatch(r"[-+.\deE]+(:[-+.\deE]*)+", rest):
        raise InputError(f"--over {text!r} is not a range LOW:HIGH:STEP", remedy=_REMEDY)
    # lists of a file ([4, 4, 4]) have commas of their own
    parts = re.split(r",(?![^\[]*\])", rest)
    return checked(Axis(key, tuple(scalar(part.strip()) for part in parts)))


def checked(axis: Axis) -> Axis:
    """Return an axis unchanged. Raise an error if the values of the axis are invalid.

    Raises:
        InputError: there are no values, a value is not finite, or values are repeated.
    """
    seen = [json.dumps(one) for one in axis.values]
    if not seen or "" in axis.values:
        raise InputError(f"{axis.key} has no values", remedy=_REMEDY)
    if bad := [one for one in axis.values if isinstance(one, float) and not math.isfinite(one)]:
        raise InputError(f"{axis.key} = {bad[0]} is not finite", remedy=_REMEDY)
    if len({*seen}) < len(seen):
        again = next(one for one in seen if seen.count(one) > 1)
        raise InputError(f"the value {again} is given twice for {axis.key}", remedy="Give each value once")
    return axis


def _range(text: str, low: Any, high: Any, step: Any) -> tuple[Any, ...]:
    numbers = [low, high, step]
    if not all(isinstance(one, int | float) and not isinstance(one, bool) for one in numbers):
        raise InputError(f"--over {text!r} is not a range of numbers", remedy=_REMEDY)
    if not all(map(math.isfinite, numbers)) or step <= 0 or high < low:
        raise InputError(f"--over {text!r} is not an ascending range of finite numbers", remedy=_REMEDY)
    count = math.floor((high - low) / step + 1e-9) + 1
    if count > _MOST_VALUES:
        raise InputError(f"--over {text!r} has {count:,} values", remedy=f"Give at most {_MOST_VALUES:,}")
    if all(isinstance(one, int) for one in numbers):
        return tuple(range(low, high + 1, step))
    # the decimals that were written, not what adding steps makes of them
    digits = max(len(repr(float(one)).partition(".")[2].partition("e")[0]) for one in (low, step))
    small = [-int(exponent) for one in (low, step) if (exponent := repr(float(one)).partition("e")[2])]
    return tuple(round(low + k * step, digits + max([0, *small])) for k in range(count))


def with_base(axis: Axis, base: Any) -> Axis:
    """Return the axis, with the value of the unchanged system added. Numbers are sorted."""
    same = [one for one in axis.values if one == base and type(one) is not bool]
    values = axis.values if same else (base, *axis.values)
    made = Axis(axis.key, values)
    return Axis(axis.key, tuple(sorted(values))) if made.ordered else made


def points(
    axes: Sequence[Axis],
    base: Mapping[str, Any],
    seeds: Sequence[int | None],
    design: Design = "one-at-a-time",
    samples: int = 0,
) -> list[Point]:
    """Return all points of a sweep, ordered by seed.

    Args:
        base: the value of each axis that is kept while another axis is varied.
        samples: number of points of a space-filling design, a power of two.

    Raises:
        InputError: too many points, or a space-filling design over values without an order.
    """
    keys = [axis.key for axis in axes]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise InputError(f"{twice[0]} is given twice", remedy="Give each setting once, with all its values")
    if design == "factorial":
        count = math.prod(len(axis.values) for axis in axes)
        if count * len(seeds) > MOST_POINTS:
            raise InputError(
                f"{count * len(seeds):,} runs are too many", remedy="Give fewer values, or use another design"
            )
        chosen = [dict(zip(keys, values, strict=True)) for values in product(*(axis.values for axis in axes))]
    elif design == "space-filling":
        chosen = _filling(axes, samples)
    else:
        chosen = [dict(base)]
        for axis in axes:
            chosen += [{**base, axis.key: value} for value in axis.values if value != base[axis.key]]
    if len(chosen) * len(seeds) > MOST_POINTS:
        raise InputError(f"the sweep has {len(chosen) * len(seeds):,} runs; the limit is {MOST_POINTS:,}")
    return [Point(choices, seed) for seed in seeds for choices in chosen]


def _filling(axes: Sequence[Axis], samples: int) -> list[dict[str, Any]]:
    """Return settings from a scrambled Sobol sequence."""
    from scipy.stats import qmc

    if samples < 2 or samples & (samples - 1):
        raise InputError(f"samples = {samples} is not a power of two", remedy="Give for example 16")
    unit = qmc.Sobol(len(axes), rng=np.random.default_rng(0)).random(samples)
    rows = []
    for row in unit:
        made = {}
        for axis, share in zip(axes, row, strict=True):
            if axis.ordered:
                low, high = min(axis.values), max(axis.values)
                value = low + share * (high - low)
                whole = all(isinstance(one, int) for one in axis.values)
                made[axis.key] = int(np.rint(value)) if whole else float(f"{value:.12g}")
            else:
                made[axis.key] = axis.values[min(int(share * len(axis.values)), len(axis.values) - 1)]
        rows.append(made)
    return rows


def label(value: Any) -> str:
    """Format a value of a varied choice as text for tables."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
