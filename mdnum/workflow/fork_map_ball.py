"""The parameter map of a ball: contacts and solver iterations along a stiffness, a tolerance, a start."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError

if TYPE_CHECKING:
    from mdnum.ball.boundaries import Boundary, BoundaryMap
    from mdnum.ball.problem import Problem
    from mdnum.systems.ball_system import BallSystem

#: Boundaries that are searched for, unless more are asked for.
MOST = 64

#: Words of system files for what the world calls otherwise.
_SHORT = {"timestep": "h", "dt": "h", "height": "y0", "velocity": "v0", "tolerance": "tol"}
#: Units of what is not a pure number.
_UNITS = {"y0": "m", "v0": "m/s", "h": "s", "tol": "m", "gravity": "m/s²", "k": "1/s²", "damping": "1/s"}


def named(problem: Problem, key: str) -> str:
    """The parameter that a key means: a key of the system file, its last word, or the world's own name.

    Raises:
        InputError: there is none of that name.
    """
    from mdnum.ball.problem import START

    word = key.rpartition(".")[2]
    word = _SHORT.get(word, word)
    if word in START or problem.world.has(word):
        return word
    known = ", ".join([*problem.world.parameters, *START])
    raise InputError(f"{key!r} is no number that can be turned", remedy=f"Use one of: {known}")


def search(
    system: BallSystem, key: str, low: float, high: float, *, cells: int, most: int, confirm: bool,
    tell: Callable[[str], None],
) -> tuple[dict[str, Any], dict[str, list[dict[str, Any]]]]:  # fmt: skip
    """The entries of summary.json that are the map, and rows for its tables.

    Args:
        tell: called with what is being done.

    Raises:
        InputError: no such number, an empty interval, or more boundaries than `most`.
    """
    from mdnum.ball.boundaries import boundaries
    from mdnum.forks.confirm import at_value, ball_digest, digests_elsewhere
    from mdnum.systems.build_ball import build_ball

    problem = build_ball(system).problem
    name = named(problem, key)
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise InputError(f"there is nothing between {low!r} and {high!r}", remedy="Give LOW < HIGH")
    if name not in ("y0", "v0", "gravity") and low < 0:
        raise InputError(f"{name} = {low!r}; expected a value of at least 0")
    tell("running a grid and bisecting")
    try:
        found = boundaries(problem, name, low, high, points=cells + 1, most=most)
    except InputError as error:
        more = "Look at a shorter interval, or allow more (--most)"
        raise InputError(
            error.message, where=error.where, remedy=more if "more than" in error.message else error.remedy
        ) from None
    edges = [_edge(edge) for edge in found.boundaries]
    if confirm and edges:
        tell("confirming in a fresh process")
        sides = [edge[side] for edge in edges for side in ("below", "above")]
        own = [ball_digest(at_value(problem, name, side)) for side in sides]
        theirs = digests_elsewhere(system, name, problem.steps, sides)
        for k, edge in enumerate(edges):
            both = slice(2 * k, 2 * k + 2)
            edge["confirmed"] = "yes" if own[both] == theirs[both] else "no"
    pieces = list(_pieces(problem, found))
    summary = {
        "key": name,
        "key_unit": "" if name == "k" and _is_gain(problem) else _UNITS.get(name, ""),
        "value": _own(problem, name),
        "loss": str(system.spec.loss.kind).replace("-", " "),
        "loss_unit": "m²" if system.spec.loss.kind == "residual-penetration" else "m",
        "low": float(found.at[0]),
        "high": float(found.at[-1]),
        "histories": len({piece["digest"] for piece in pieces}),
        "complete": False,
        "resolution": float(np.diff(found.at).max()),
        "evaluations": found.evaluations + len(found.at),
        "failed_runs": 0,
        "confirm": confirm,
        "confirmed": sum(edge["confirmed"] == "yes" for edge in edges) if confirm else None,
        "jump_largest": max((abs(edge["jump"]) for edge in edges), default=None),
        "apart_largest": None,
        "boundaries": edges,
        "intervals": [{key: piece[key] for key in piece if key not in ("digest", "gap")} for piece in pieces],
        "unresolved": [],
        "compiles": False,
    }
    return summary, {"boundaries": edges, "intervals": pieces, "points": list(_points(found, pieces))}


def _is_gain(problem: Problem) -> bool:
    """Whether k is the gain of a projection rather than the stiffness of a spring."""
    from mdnum.ball.contacts import Projection

    return isinstance(problem.world.contact, Projection)


def _own(problem: Problem, name: str) -> float | None:
    """What the system says; None where a batch has many start values."""
    values = np.unique(np.asarray(problem.values([name])[name], np.float64))
    return float(values[0]) if len(values) == 1 else None


def _edge(edge: Boundary) -> dict[str, Any]:
    below, above = edge.below, edge.above
    who = "solver" if edge.ball < 0 else f"ball {edge.ball}"
    if edge.channel == "contact":
        says = f"{who} {'touches' if above.contact else 'misses'} the floor"
        way = f"touches {'above' if above.contact else 'below'}"
    else:
        solver = "the solver" if edge.ball < 0 else f"the solver of ball {edge.ball}"
        says = f"{solver} makes {above.iterations} iterations instead of {below.iterations}"
        way = f"{below.iterations} → {above.iterations}"
    return {
        "below": below.at,
        "above": above.at,
        "step": edge.step,
        "i": edge.ball,
        "j": -1,
        "who": who,
        "says": says,
        "way": way,
        "channel": edge.channel,
        "inside": above.contact if edge.channel == "contact" else above.iterations < below.iterations,
        "also": 0,
        "margin_below": below.margin,
        "margin_above": above.margin,
        "bound": float("nan"),
        "loss_below": below.loss,
        "loss_above": above.loss,
        "jump": edge.jump,
        "gradient_below": below.gradient,
        "gradient_above": above.gradient,
        "energy_below": float("nan"),
        "energy_above": float("nan"),
        "apart": float("nan"),
        "confirmed": "not asked",
    }


def _pieces(problem: Problem, found: BoundaryMap) -> Iterator[dict[str, Any]]:
    """The stretches between boundaries, each with the history of its lower end."""
    from mdnum.forks.confirm import at_value, ball_digest

    edges = found.boundaries
    lows = [(float(found.at[0]), float(found.loss[0])), *((e.above.at, e.above.loss) for e in edges)]
    highs = [*((e.below.at, e.below.loss) for e in edges), (float(found.at[-1]), float(found.loss[-1]))]
    numbers: dict[str, int] = {}
    for (low, loss_low), (high, loss_high) in zip(lows, highs, strict=True):
        digest = ball_digest(at_value(problem, found.name, low))
        inside = found.at[(found.at >= low) & (found.at <= high)]
        runs = np.unique(np.concatenate([inside, [low, high]]))
        yield {
            "low": low,
            "high": high,
            "history": numbers.setdefault(digest, len(numbers)),
            "digest": digest,
            "loss_low": loss_low,
            "loss_high": loss_high,
            "runs": len(runs),
            "gap": float(np.diff(runs).max()) if len(runs) > 1 else float(np.spacing(low)),
        }


def _points(found: BoundaryMap, pieces: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The grid and the sides of every boundary, in order."""
    known = dict(zip(found.at.tolist(), found.loss.tolist(), strict=True))
    for edge in found.boundaries:
        known |= {edge.below.at: edge.below.loss, edge.above.at: edge.above.loss}
    for at in sorted(known):
        piece = next(piece for piece in pieces if piece["low"] <= at <= piece["high"])
        yield {"at": at, "history": piece["history"], "loss": known[at], "energy": float("nan")}
