"""When a ball's runs in each precision leave the history that exact arithmetic makes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from mdnum.ball.limits import DTYPES
from mdnum.ball.rollout import simulate
from mdnum.errors import InputError
from mdnum.forks.bounce.choices.base import program, varied
from mdnum.forks.exact.ball import ball_history, ball_horizon
from mdnum.systems.ball_system import BallSystem

#: What is ranked: every role in one format, or one role alone in float32.
POLICIES: Mapping[str, Mapping[str, str]] = {
    **{
        name: dict.fromkeys(("state", "arithmetic", "decision", "accumulate"), name)
        for name in sorted(DTYPES, key=lambda name: -DTYPES[name].itemsize)
    },
    **{f"{role} in float32": {role: "float32"} for role in ("state", "arithmetic", "decision", "accumulate")},
}


@dataclass(frozen=True)
class BallPolicy:
    """How long a run in one precision keeps to the exact history.

    Attributes:
        name: of the precision; roles that it does not name are float64.
        horizon: first step with another decision; None where there is none.
        channel: "contact" or "stop"; "" without a difference.
        ball: the first that it concerns; -1 without one.
        height: that ball's exact height at the decision, m; None without one.
        separation_end: |height - exact height| at the end, the largest of the balls, m.
        why_not: why it cannot run in this precision; None where it did.
    """

    name: str
    horizon: int | None = None
    channel: str = ""
    ball: int = -1
    height: float | None = None
    separation_end: float | None = None
    why_not: str | None = None


@dataclass(frozen=True)
class BallCertificate:
    """The precisions by their horizons, the longest first.

    Attributes:
        steps: of the exact history.
        bits: of its longest number in the end.
        ranking: of precisions; those that cannot run come last.
        says: in words.
    """

    steps: int
    bits: int
    ranking: tuple[BallPolicy, ...]
    says: tuple[str, ...]


def certify(
    system: BallSystem,
    steps: int | None = None,
    policies: Mapping[str, Mapping[str, str]] | None = None,
    progress: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> BallCertificate:
    """Date when a system's runs leave the exact history of the program in double precision.

    The numbers of the file are those that float64 has; a narrower run rounds them too, which is part of
    what it does differently.

    Args:
        system: as loaded; its own precision is not used.
        steps: to make; default the system's own.
        policies: formats by role, by the name of the precision; default all that ship.
        progress: called with runs done, how many, and the phase.

    Raises:
        InputError: a program whose steps are not sums and products.
    """
    policies = POLICIES if policies is None else policies
    system = system if steps is None else system.for_steps(steps)
    wide = {f"precision.{role}": "float64" for role in ("state", "arithmetic", "decision", "accumulate")}
    exact = program(varied(system, {**wide, "precision.rounding": "nearest"}, "float64"))
    note = progress or (lambda done, count, info: None)
    note(0, 0, {"phase": "the exact history"})
    history = ball_history(exact.world, exact.world.start(exact.y0, exact.v0), exact.steps)
    rows = []
    for done, (name, roles) in enumerate(policies.items()):
        note(done, len(policies), {"phase": name})
        values = {**wide, **{f"precision.{role}": dtype for role, dtype in roles.items()}}
        try:
            made = program(varied(system, {**values, "precision.rounding": "nearest"}, name))
        except InputError as error:
            rows.append(BallPolicy(name, why_not=error.message.removeprefix(f"variant {name!r}: ")))
            continue
        run = simulate(made.world, made.world.start(made.y0, made.v0), made.steps)
        found = ball_horizon(history, run)
        height = None if found.horizon is None else found.height
        end = float(found.separation[-1])
        rows.append(BallPolicy(name, found.horizon, found.channel, found.ball, height, end))
    late = float("inf")
    rows.sort(key=lambda row: (row.why_not is not None, -(late if row.horizon is None else row.horizon)))
    return BallCertificate(history.steps, history.bits, tuple(rows), tuple(_says(rows, history.steps)))


def _says(rows: list[BallPolicy], steps: int) -> list[str]:
    ran = [row for row in rows if row.why_not is None]
    kept = [row.name for row in ran if row.horizon is None]
    left = [f"{row.name} at step {row.horizon:,}" for row in ran if row.horizon is not None]
    said = []
    if kept:
        said.append(f"Decide as exact arithmetic does in all {steps:,} steps: {', '.join(kept)}.")
    if left:
        said.append(f"Leave the exact history: {', '.join(left)}.")
    by_name = {row.name: row for row in ran}
    whole, decision = by_name.get("float32"), by_name.get("decision in float32")
    if whole is not None and decision is not None and whole.horizon is not None and decision.horizon is None:
        said.append("Decisions alone in float32 cost nothing: what they compare was in float64.")
    return said
