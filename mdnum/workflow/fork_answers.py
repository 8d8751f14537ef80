"""Further answers about a pair of runs that was followed: its Lyapunov exponent, its minimal cause."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError

if TYPE_CHECKING:
    from mdnum.forks import Fork
    from mdnum.forks.replays import Pinned

Progress = Callable[[int, int, dict[str, Any]], None]

#: A tangent is carried for a share of the steps that were followed, but not for fewer nor for more than this:
#: its step costs as much as six of a run, so it takes a tenth as long as the runs that are compared.
_SHARE, _FEWEST, _MOST = 0.25, 400, 2_000


def exponent(fork: Fork) -> dict[str, Any]:
    """The largest Lyapunov exponent of run A beside the growth that was seen, as summary.json holds it.

    Returns:
        "lyapunov", a table or None, and "lyapunov_reason", in words where it is None or means little.
    """
    from mdnum.forks.tangent import lyapunov

    a, seen = fork.twin.a.simulation, fork.growth["B"]
    if fork.dates.seed is None:
        return _none("no bit differs: nothing grows")
    if not a.pairwise:
        return _none("tangents are carried through pair potentials only")
    steps = min(fork.steps, max(_FEWEST, min(_MOST, round(_SHARE * fork.steps))))
    try:
        found = lyapunov(a, steps)
    except InputError as error:
        return _none(error.message)
    if not np.isfinite(found.rate):
        return _none(f"the tangent is not finite within {steps} steps")
    # where A's largest coordinate lies: no smaller displacement of it can be written down
    ulp = float(np.spacing(np.abs(a.positions).max().astype(a.policy.dtype("state"))))
    split = found.steps_to(ulp, fork.tolerance)
    table = {
        "rate": found.rate,
        "error": found.error,
        "rate_time": found.rate_time,
        "error_time": found.error_time,
        "steps": found.steps,
        "chaotic": found.chaotic,
        "ratio": _plain(found.ratio(seen)),
        "ulp": ulp,
        "ulp_split": None if split is None else round(split),
    }
    # log(end / first) over the steps between them, as Lyapunov.chaotic has it
    linear = float(np.log(steps / found.transient)) / (steps - found.transient)
    reason = None
    if not found.chaotic and found.rate + found.error < 0.5 * linear:
        reason = "slower than growth in proportion to time: the motion itself does not part runs"
    elif not found.chaotic:
        reason = f"{steps} steps do not tell it from growth in proportion to time, {linear:.2g} a step"
    return {"lyapunov": table, "lyapunov_reason": reason}


def take_back(fork: Fork, pin: str) -> tuple[dict[str, Any], Pinned | None]:
    """B run again with some decisions taken back, as summary.json holds it; a reason where it cannot be.

    Args:
        pin: "fork", or a pair over a window, as `mdnum.forks.take_back.parse_pin` reads it.

    Raises:
        InputError: a pair that there is not.
    """
    from mdnum.forks.replays import check_pins, parse_pin, pinned

    wanted = parse_pin(pin, fork.twin.a.size)
    try:
        check_pins(fork)
    except InputError as error:
        return {"pin": pin, "pairs": None, "reason": error.message}, None
    if not wanted and fork.decision is None:
        return {"pin": pin, "pairs": None, "reason": "the runs do not fork"}, None
    found = pinned(fork, **wanted)
    seen = found.separation[np.isfinite(found.separation)]
    return {
        "pin": pin,
        "pairs": [list(pair) for pair in found.pairs],
        "first": found.first,
        "last": found.last,
        "split": found.split,
        "free": found.free,
        "until": len(seen) - 1,
        "largest": float(seen.max()),
        "reason": None,
    }, found


def _none(reason: str) -> dict[str, Any]:
    return {"lyapunov": None, "lyapunov_reason": reason}


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def minimal(fork: Fork, progress: Progress | None) -> dict[str, Any]:
    """The fewest decisions that have to be taken back, as summary.json holds it; a reason where none can be.

    Args:
        progress: called with tests made and allowed.
    """
    from mdnum.forks.replays import disagreements, minimal_cause

    def note(made: int, allowed: int) -> None:
        if progress is not None:
            progress(made, allowed, {"phase": "minimal cause", "unit": "runs"})

    try:
        found = minimal_cause(fork, progress=note)
    except InputError as error:
        return {"pairs": None, "proven": False, "fork_alone": None, "candidates": None, "tests": 0,
                "horizon": None, "reason": str(error.message)}  # fmt: skip
    pairs = None
    if found.pairs is not None:
        pairs = [
            {"i": i, "j": j, "differs": [list(spell) for spell in disagreements(fork, i, j)]}
            for i, j in found.pairs
        ]
    return {
        "pairs": pairs,
        "proven": found.proven,
        "fork_alone": found.fork_alone,
        "candidates": found.candidates,
        "tests": found.tests,
        "horizon": found.horizon,
        "reason": found.reason,
    }
