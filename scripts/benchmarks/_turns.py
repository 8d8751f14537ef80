"""Contenders that take turns, so that a busy machine is busy for all of them; and how results are shown."""

from __future__ import annotations

import json
import operator
import os
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import say, table
from _processes import children_seconds, machine

#: What was measured, its value, the limit, and whether it holds.
Claim = tuple[str, str, str, bool]
_SENSES = {"<=": operator.le, "<": operator.lt, ">=": operator.ge, ">": operator.gt}


def on_cores(count: int) -> list[int]:
    """Keep this process to its first cores, before a library starts a thread for each; the cores it had.

    Args:
        count: of cores; 0 for all.
    """
    if not hasattr(os, "sched_setaffinity"):
        return [0]
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, set(cores[: count or None]))
    return cores


def seconds(work: Callable[[], object]) -> np.ndarray:
    """Clock and CPU seconds of a call, of processes that it starts and waits for as well, shape (2,)."""
    begin = _now()
    work()
    return _now() - begin


def _now() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time() + children_seconds()])


def in_turn(contenders: Mapping[str, Callable[[], object]], turns: int, where: str) -> dict[str, np.ndarray]:
    """Clock and CPU seconds of every turn by contender, shape (1 + turns, 2); the first turn compiles."""
    taken: dict[str, list[np.ndarray]] = {name: [] for name in contenders}
    for turn in range(turns + 1):
        for name, work in contenders.items():
            say(f"{where}: {f'turn {turn} of {turns}' if turn else 'compiling'}, {name}")
            taken[name].append(seconds(work))
    return {name: np.array(rows) for name, rows in taken.items()}


def ratios(taken: Mapping[str, np.ndarray], name: str, over: str) -> np.ndarray:
    """Of one contender to another in each turn after the first, by clock and CPU time, shape (turns, 2)."""
    return taken[name][1:] / taken[over][1:]


def claim(what: str, measured: float, sense: str, limit: float, unit: str = "") -> Claim:
    """A row of the last table of a benchmark.

    Args:
        sense: <=, <, >= or >.
    """
    unit = f" {unit}" if unit else ""
    return what, f"{measured:.3g}{unit}", f"{sense} {limit:g}{unit}", bool(_SENSES[sense](measured, limit))


def finish(
    chosen: Namespace,
    result: dict[str, Any],
    show: Callable[[dict[str, Any]], None],
    claims: Callable[[dict[str, Any]], Iterable[Claim]],
) -> None:
    """Print what was measured, as tables or as one JSON document (--json)."""
    result["machine"] = machine()
    if chosen.json:
        result["claims"] = [
            dict(zip(("what", "measured", "required", "holds"), one, strict=True)) for one in claims(result)
        ]
        print(json.dumps(result, indent=2))
        return
    print("on " + result["machine"])
    show(result)
    table("\nrequired", ("what", "measured", "required", "holds"), claims(result))
