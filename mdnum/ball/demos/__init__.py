"""Demonstrations: each classic effect in seconds, with the number that shows it."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable

from mdnum.ball.demos.base import Check, Demo, Plot, Region, Series, Table
from mdnum.errors import InputError

__all__ = ["NAMES", "Check", "Demo", "Plot", "Region", "Series", "Table", "find", "run"]

#: The demonstrations, in the order in which they are best read.
NAMES = (
    "sum-order",
    "stopping-precision",
    "fork",
    "stiffness",
    "iteration-boundary",
    "hysteresis",
    "per-instance",
    "implicit",
    "tf32-in-solver",
    "quantized-state",
    "coalesce",
    "saltation",
    "euler-choice",
    "zeno",
    "smoothing-width",
    "determinism",
)


def find(name: str) -> Callable[[], Demo]:
    """The function that runs the demonstration of this name.

    Raises:
        InputError: there is none; lists those there are.
    """
    if name not in NAMES:
        near = difflib.get_close_matches(name, NAMES, n=1)
        hint = f"Did you mean {near[0]}? " if near else ""
        raise InputError(
            f"no demonstration called {name!r}",
            remedy=f"{hint}There are {', '.join(NAMES)}; or all",
            where="--demo",
        )
    return importlib.import_module(f"mdnum.ball.demos.{name.replace('-', '_')}").run


def run(name: str) -> Demo:
    """Run one demonstration.

    Raises:
        InputError: there is none of that name.
    """
    return find(name)()
