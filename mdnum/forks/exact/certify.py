"""Find when runs in each precision leave the exact history (decisions in exact arithmetic)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError, expect_at_least
from mdnum.forks.worlds import ROLES, program_of, varied
from mdnum.numerics.verdicts import Growth, growth
from mdnum.plain import result
from mdnum.program import Decision, Program, Progress
from mdnum.systems import BallSystem, opened

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

Roles = Mapping[str, str]

_NARROW: Roles = dict.fromkeys(ROLES["md"], "float32")

#: Ranked precisions of molecular dynamics, from no role to all roles in double precision; roles that are not
#: named are float64.
MD_POLICIES: Mapping[str, Roles] = {
    "float32": _NARROW,
    **{
        f"float32, {' and '.join(wide)} float64": {**_NARROW, **dict.fromkeys(wide, "float64")}
        for wide in (("decision",), ("accumulate",), ("decision", "accumulate"), ("state",))
    },
    "float64, force float32": {"force": "float32"},
    "float64, force bfloat16": {"force": "bfloat16"},
    "float64": {},
}
#: Ranked precisions of a ball: every role in one format, or one role in float32.
BALL_POLICIES: Mapping[str, Roles] = {
    **{name: dict.fromkeys(ROLES["ball"], name) for name in ("float64", "float32", "float16", "bfloat16")},
    **{f"{role} in float32": {role: "float32"} for role in ROLES["ball"]},
}
#: Largest separation from the exact run to which its growth is fitted, as a share of the scale of the
#: program.
_SATURATED = 0.04
#: Smallest quality of a fit for which growth counts as exponential.
_EXPONENTIAL = 0.95


@dataclass(frozen=True)
class PolicyHorizon:
    """Number of steps for which a run in one precision follows the exact history."""

    # name, roles: of the precision, and its dtype by role
    name: str
    roles: Roles
    # the first that is not the exact one, exact (A) and the run's (B), with the exact margin in the
    # quantity's space; None where there is none
    decision: Decision | None = None
    # separation, growth: largest distance from the exact places at each step, length, and its growth
    separation: Float[np.ndarray, "rows"] | None = None
    growth: Growth | None = None
    failed: str = ""  # how the run ended, where badly
    # share of the steps that double precision gains over single which this policy gains; an upper bound where
    # double precision never left; NaN where unknown
    gain: float = float("nan")
    # bits by which its positions are closer to the exact ones than those of single precision throughout,
    # while both decide exactly; NaN where unknown
    closer: float = float("nan")
    reason_unavailable: str | None = None  # why it cannot run in this precision; None where it did

    @property
    def horizon(self) -> int | None:
        """First step with a decision that differs from the exact one. None if all decisions agree."""
        return None if self.decision is None else self.decision.step

    @property
    def margin(self) -> float:
        """Margin of the first wrong decision, in the exact run. NaN if no decision is wrong."""
        return float("nan") if self.decision is None else self.decision.margins["A"]

    def is_all(self, dtype: str) -> bool:
        """Return True if all roles (state, force and others) have the given dtype."""
        return set(self.roles.values()) == {dtype}


@result
class Certificate:
    """The exact history of a system, and how long finite-precision runs follow it."""

    steps: int  # last step
    timestep: float  # in the user's units of time
    exact: Any  # the history, a `program.ExactHistory`, or a `BallRun`
    ranking: tuple[PolicyHorizon, ...]  # precisions, longest horizon first; those that cannot run come last
    # by how many steps one more bit puts a horizon off: ln 2 over the growth rate of the separation from the
    # exact run; NaN where no growth was seen
    steps_per_bit: float


def certify(
    system: Simulation | BallSystem,
    steps: int | None = None,
    policies: Mapping[str, Roles] | None = None,
    progress: Progress | None = None,
) -> Certificate:
    """Compute the exact history, and the step at which a run in each precision leaves this history.

    The numbers of the system file are rounded to float64. A run in lower precision rounds the numbers of the
    file again. The deviation of the run includes this rounding.

    Args:
        system: a Lennard-Jones system of at most 108 atoms at constant energy (NVE), or a ball whose time
            steps consist of sums and products. The precision set in the system is ignored.
        steps: last step; default the system's own.
        policies: for each named precision, the dtype of each role; default `MD_POLICIES` or `BALL_POLICIES`.
            Roles that are not named are float64.
        progress: called with the number of items done, their total, and a dictionary of current values.

    Raises:
        InputError: the system cannot be certified, or steps is below 1.
    """
    system = opened(system)
    is_ball = isinstance(system, BallSystem)
    own = system.spec.integrator.steps if isinstance(system, BallSystem) else system.steps
    last = own if steps is None else steps
    expect_at_least(1, steps=last)
    if policies is None:
        policies = BALL_POLICIES if is_ball else MD_POLICIES
    wide = dict.fromkeys(ROLES["ball" if is_ball else "md"], "float64")
    every = {name: {**wide, **roles} for name, roles in policies.items()}
    note = progress or (lambda done, total, info: None)
    certifier: Any = _certify_ball if is_ball else _certify_md
    program, exact, rows = certifier(system, last, every, note)
    rows = _with_gains(rows, last)
    # one that never left comes before all that did
    horizons = {row.name: last + 1 if row.horizon is None else row.horizon for row in rows}
    rows.sort(key=lambda row: (row.reason_unavailable is not None, -horizons[row.name]))
    return Certificate(last, program.timestep, exact, tuple(rows), _steps_per_bit(rows))


def _row(
    program: Program, name: str, roles: Roles, decision: Decision | None, separation: np.ndarray, failed: str
) -> PolicyHorizon:
    fit = growth(separation, _SATURATED * program.scale)
    return PolicyHorizon(name, roles, decision, separation, fit, failed)


def _certify_md(system: Simulation, last: int, policies: Mapping[str, Roles], note: Progress):
    from mdnum.forks.exact.program import ExactProgram
    from mdnum.forks.tape import first_difference, taped
    from mdnum.md.cell import HostCell
    from mdnum.numerics import PrecisionPolicy
    from mdnum.rollout.compared import ReferenceFrame
    from mdnum.rollout.engine import FAILURES, Segment
    from mdnum.rollout.tracks import rows_of

    program: Any = program_of(system)
    simulation = program.simulation
    info = {"phase": "in exact arithmetic", "unit": "steps"}
    exact = ExactProgram(simulation).run(last, progress=lambda done, total: note(done, total, info))
    frame = ReferenceFrame.same(simulation.atoms)
    cell = HostCell(simulation.cell)
    matrix = np.where(np.array(simulation.pbc)[:, None], np.asarray(simulation.cell.matrix), 0.0)

    def reduced(x: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Wrap positions into the box, so that nearest images are at most one lattice vector away."""
        return x - np.floor(x @ np.asarray(simulation.cell.inverse)) @ matrix

    rows = []
    for done, (name, roles) in enumerate(policies.items()):
        note(done, len(policies), {"phase": name, "unit": "policies"})
        parts: list[np.ndarray] = []
        failed = ""

        def watch(segment: Segment, parts: list[np.ndarray] = parts) -> None:
            nonlocal failed
            failed = segment.closes if segment.closes in FAILURES else ""
            parts.append(rows_of(simulation, segment, frame, failed).x)

        other = replace(program, simulation=simulation.with_policy(PrecisionPolicy(**roles)))
        decision = first_difference(exact.tape, taped(other, last, watch))
        x = np.concatenate(parts)
        common = min(len(exact.x), len(x))
        d = cell.displacement(reduced(exact.x[:common]), np.moveaxis(x[:common], 1, 2))
        separation = np.sqrt(np.max(d[0] ** 2 + d[1] ** 2 + d[2] ** 2, axis=1))
        if decision is not None:
            place = reduced(exact.x[decision.step])
            i, j = decision.subject
            dx, dy, dz = cell.displacement(place[[i]], place[[j]])
            kind = int(simulation.type_of(np.array([i]), np.array([j]))[0])
            margin = simulation.decider.r_cut[kind] ** 2 - float((dx * dx + dy * dy + dz * dz)[0])
            decision = replace(decision, margins={"A": margin})
        rows.append(_row(program, name, roles, decision, separation, failed))
    return program, exact, rows


def _certify_ball(system: BallSystem, last: int, policies: Mapping[str, Roles], note: Progress):
    from mdnum.ball.rollout import cross_decisions
    from mdnum.forks.exact.ball import ball_history

    system = system.for_steps(last)

    def program_in(name: str, roles: Roles) -> Any:
        values = {f"precision.{role}": dtype for role, dtype in roles.items()}
        return program_of(varied(system, {**values, "precision.rounding": "nearest"}, name))

    exact = program_in("float64", dict.fromkeys(ROLES["ball"], "float64"))
    problem = exact.problem
    note(0, 0, {"phase": "the exact history"})
    history = ball_history(problem.world, problem.world.start(problem.y0, problem.v0), last)
    rows = []
    for done, (name, roles) in enumerate(policies.items()):
        note(done, len(policies), {"phase": name, "unit": "policies"})
        try:
            program = program_in(name, roles)
        except InputError as error:
            reason = error.message.removeprefix(f"variant {name!r}: ")
            rows.append(PolicyHorizon(name, roles, reason_unavailable=reason))
            continue
        run = program.run(last)
        separation = np.abs(run.y.astype(np.float64) - history.y).max(axis=1)
        flips = cross_decisions(history, run)
        first = [flip for flip in flips if flip.step == flips[0].step]
        decision = exact.decision(program, first, float(separation[first[0].step - 1])) if first else None
        rows.append(_row(exact, name, roles, decision, separation, ""))
    return exact, history, rows


def _steps_per_bit(rows: list[PolicyHorizon]) -> float:
    """Return the number of steps in which the deviation doubles, according to the longest fit."""
    # separations that grow by a power of time, as those of a lone pair, are no exponentials
    fits = [row.growth for row in rows if row.growth is not None]
    fits = [fit for fit in fits if fit.rate > 0 and fit.r_squared > _EXPONENTIAL]
    if not fits:
        return float("nan")
    return float(np.log(2) / max(fits, key=lambda fit: fit.last - fit.first).rate)


def _with_gains(rows: list[PolicyHorizon], last: int) -> list[PolicyHorizon]:
    """Add the gain of each precision policy. Single precision has gain 0, double precision 1."""
    low = next((row for row in rows if row.is_all("float32")), None)
    high = next((row for row in rows if row.is_all("float64")), None)
    if low is None or low.horizon is None:
        return rows
    # a double precision that never left gains at least the steps up to the last: shares are upper bounds then
    reach = None if high is None else last if high.horizon is None else high.horizon
    done = []
    for row in rows:
        gain = float("nan")
        if reach is not None and reach > low.horizon and row.horizon is not None:
            gain = (row.horizon - low.horizon) / (reach - low.horizon)
        done.append(replace(row, gain=gain, closer=_closer(low, row)))
    return done


def _closer(base: PolicyHorizon, row: PolicyHorizon) -> float:
    """Return how many more bits of the exact positions one run has than another.

    The number is the median over the second half of the steps before the first wrong decision. The median
    does not depend on which pair approaches its cutoff.
    """
    if base.separation is None or row.separation is None:
        return float("nan")
    end = min(horizon for horizon in (base.horizon, row.horizon) if horizon is not None)
    a, b = (separation[end // 2 : end] for separation in (base.separation, row.separation))
    if not len(a) or not len(b) or not np.all(b[: len(a)] > 0):
        return float("nan")
    with np.errstate(divide="ignore"):
        return float(np.median(np.log2(a[: len(b)] / b)))
