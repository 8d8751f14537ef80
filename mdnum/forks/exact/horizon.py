"""When real runs leave the exact history, and which precision policy keeps them on it longest."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.events.forks import Growth, growth
from mdnum.forks.exact.program import Exact, ExactProgram, why_not, with_policy
from mdnum.forks.exact.tape import Difference, Tape, first_difference
from mdnum.md.cell import HostCell
from mdnum.precision import PrecisionPolicy
from mdnum.precision.policy import WIDE
from mdnum.rollout.engine import FAILURES, Engine, Start, first_state
from mdnum.rollout.flips import PairRecorder, decided_pairs
from mdnum.rollout.frame import Frame
from mdnum.rollout.tracks import rows_of
from mdnum.systems.build import Simulation, build
from mdnum.systems.load import System

_NARROW = PrecisionPolicy("float32", "float32", "float32", "float32")

#: Precision policies that are ranked, from none to all in double precision.
POLICIES: Mapping[str, PrecisionPolicy] = {
    "float32": _NARROW,
    "float32, decision float64": replace(_NARROW, decision="float64"),
    "float32, accumulate float64": replace(_NARROW, accumulate="float64"),
    "float32, decision and accumulate float64": replace(_NARROW, decision="float64", accumulate="float64"),
    "float32, state float64": replace(_NARROW, state="float64"),
    "float64, force float32": PrecisionPolicy("float64", "float32", "float64", "float64"),
    "float64, force bfloat16": PrecisionPolicy("float64", "bfloat16", "float64", "float64"),
    "float64": PrecisionPolicy(),
}

#: A share of what double precision gains that counts as nothing, and bits of error that do.
_NOTHING, _NO_BITS = 0.05, 1.0
#: Quality of a fit from which on a growth counts as exponential.
_EXPONENTIAL = 0.95
#: Separation from the exact run up to which its growth is fitted, as a share of the longest cutoff.
_SATURATED = 0.04


@dataclass(frozen=True)
class Taped:
    """A real run as the tape of its decisions.

    Attributes:
        tape: what it decided.
        x: wrapped positions, length, shape (rows, 3, atoms).
        failed: "blow-up", "runaway", or "".
    """

    tape: Tape
    x: Float[np.ndarray, "rows 3 atoms"]
    failed: str


@dataclass(frozen=True)
class PolicyHorizon:
    """How long a real run keeps to the exact history.

    Attributes:
        name: of the policy.
        policy: dtype by role.
        horizon: first step with a decision other than the exact one; None where there is none.
        difference: that decision (exact first, run second).
        margin: of the decision at fault in the exact run (threshold - r²), length²; NaN without one.
        separation: largest distance of an atom from its exact place at each step, length.
        growth: of that separation.
        failed: how the run ended, where badly.
        gain: share of the steps that double precision gains over single which this policy gains; an upper
            bound where double precision never left; NaN where unknown.
        closer: bits by which its positions are closer to the exact ones than those of single precision
            throughout, while both decide exactly; NaN where unknown.
    """

    name: str
    policy: PrecisionPolicy
    horizon: int | None
    difference: Difference | None
    margin: float
    separation: Float[np.ndarray, "rows"]
    growth: Growth
    failed: str
    gain: float = float("nan")
    closer: float = float("nan")


@dataclass(frozen=True)
class Certificate:
    """The exact history of a system, and the horizons of real runs against it.

    Attributes:
        steps: last step.
        timestep: in the user's units of time.
        exact: the history.
        ranking: policies, longest horizon first.
        same_start: whether all runs begin at single-precision positions and velocities, so that rounding
            the start is no part of the comparison.
        steps_per_bit: by how many steps one more bit puts a horizon off: ln 2 over the growth rate of the
            separation from the exact run; NaN where no growth was seen.
        says: what follows, in sentences.
    """

    steps: int
    timestep: float
    exact: Exact
    ranking: tuple[PolicyHorizon, ...]
    same_start: bool
    steps_per_bit: float
    says: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Plain numbers and words for a summary file; None stands for what is unknown or never happened."""
        exact = self.exact
        return {
            "steps": self.steps,
            "bits": exact.bits,
            "restarts": exact.restarts,
            "flips": exact.tape.flips,
            "smallest_margin": float(exact.margin.min()),
            "smallest_margin_step": int(exact.margin.argmin()),
            "log2_radius_end": _known(exact.radius[-1]),
            "bits_per_step": _known(exact.bits_per_step),
            "ms_per_step": 1000 * exact.seconds / (self.steps + 1),
            "steps_per_bit": _known(self.steps_per_bit),
            "same_start": self.same_start,
            "policies": [_plain(row) for row in self.ranking],
            "says": list(self.says),
        }

    def of(self, name: str) -> PolicyHorizon:
        """The row of a policy.

        Raises:
            KeyError: it was not asked for.
        """
        for row in self.ranking:
            if row.name == name:
                return row
        raise KeyError(name)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _plain(row: PolicyHorizon) -> dict[str, Any]:
    found = row.difference
    return {
        "name": row.name,
        **{role: getattr(row.policy, role) for role in ("state", "force", "decision", "accumulate")},
        "horizon": row.horizon,
        "pair": None if found is None else [found.i, found.j],
        "inside_exact": None if found is None else found.inside[0],
        "margin": _known(row.margin),
        "gain": _known(row.gain),
        "closer_bits": _known(row.closer),
        "growth_rate": _known(row.growth.rate),
        "separation_end": _known(row.separation[-1]),
        "failed": row.failed or None,
    }


def taped(simulation: Simulation, steps: int, start: Start | None = None) -> Taped:
    """Run a simulation and keep every decision and position up to a step."""
    engine, recorder = Engine(simulation, steps, start=start), PairRecorder(simulation)
    frame = Frame.same(simulation.atoms)
    first, failed, last = np.empty(0, np.int64), "", 0
    rows, at, keys, entered = [], [], [], []
    for segment in engine.segments():
        if not rows:
            first = decided_pairs(simulation, segment, 0)
        ledger = recorder.flips(segment)
        at.append(ledger.step)
        keys.append(ledger.subject[:, 0].astype(np.int64) * simulation.atoms + ledger.subject[:, 1])
        entered.append(ledger.entered)
        failed = segment.closes if segment.closes in FAILURES else ""
        rows.append(rows_of(segment, frame, failed).x)
        last = segment.last
    step, key, now = np.concatenate(at).astype(np.int64), np.concatenate(keys), np.concatenate(entered)
    order = np.lexsort((key, step))
    tape = Tape(simulation.atoms, last, first, step[order], key[order], now[order])
    return Taped(tape, np.concatenate(rows), failed)


def rounded_start(simulation: Simulation, policy: PrecisionPolicy, bits: int = 24) -> Start:
    """The system's start with every number rounded to so many bits, in the dtype of the policy's state.

    Args:
        bits: of the significand; at most 24 where the state is single precision.
    """
    begin = first_state(with_policy(simulation, PrecisionPolicy()))
    dtype = policy.dtype("state")

    def cut(a):
        mantissa, exponent = np.frexp(np.asarray(a, np.float64))
        return jnp.asarray(np.ldexp(np.rint(np.ldexp(mantissa, bits)), exponent - bits).astype(dtype))

    x = cut(begin.state.x)
    state = begin.state._replace(x=x, v=cut(begin.state.v), x_before=x)
    return replace(begin, state=state, reference=np.asarray(x, np.float64).T.copy())


def compare(name: str, policy: PrecisionPolicy, simulation: Simulation, exact: Exact, run: Taped):
    """A real run against the exact history."""
    difference = first_difference(exact.tape, run.tape)
    rows = min(len(exact.x), len(run.x))
    found = np.moveaxis(run.x[:rows], 1, 2)
    d = HostCell(simulation.cell).displacement(_reduced(simulation, exact.x[:rows]), found)
    separation = np.sqrt(np.max(d[0] ** 2 + d[1] ** 2 + d[2] ** 2, axis=1))
    margin = float("nan")
    if difference is not None:
        place = _reduced(simulation, exact.x[difference.step])
        dx, dy, dz = HostCell(simulation.cell).displacement(place[[difference.i]], place[[difference.j]])
        kind = int(simulation.type_of(np.array([difference.i]), np.array([difference.j]))[0])
        margin = simulation.decider.r_cut[kind] ** 2 - float((dx * dx + dy * dy + dz * dz)[0])
    return PolicyHorizon(
        name,
        policy,
        None if difference is None else difference.step,
        difference,
        margin,
        separation,
        growth(separation, _SATURATED * simulation.r_cut),
        run.failed,
    )


def _reduced(simulation: Simulation, x: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Positions within a box of the origin: a displacement takes off one lattice vector at most."""
    fraction = np.floor(x @ np.asarray(simulation.cell.inverse))
    return x - fraction @ np.where(np.array(simulation.pbc)[:, None], np.asarray(simulation.cell.matrix), 0.0)


def certify(
    system: Simulation | System | str,
    steps: int | None = None,
    *,
    policies: Mapping[str, PrecisionPolicy] | None = None,
    same_start: bool = False,
    bits: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Certificate:
    """The exact history of a system, and the step at which a run under each precision policy leaves it.

    Args:
        system: Lennard-Jones, NVE, at most 108 atoms.
        steps: last step; default the system's own.
        policies: to compare, by name; default `POLICIES`.
        same_start: let all runs, and the exact one, begin at the start rounded to 24 bits.
        bits: precision of the exact run's first attempt.
        progress: called with the exact run's step and the last one.

    Raises:
        InputError: the system cannot be certified, or steps below 1.
    """
    simulation = system if isinstance(system, Simulation) else build(system)
    refused = why_not(simulation)
    if refused is not None:
        raise refused
    last = simulation.system.spec.dynamics.steps if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1", remedy="Ask for one step or more")
    chosen = POLICIES if policies is None else policies

    def start(policy: PrecisionPolicy) -> Start | None:
        return rounded_start(simulation, policy) if same_start else None

    exact = ExactProgram(simulation, start(PrecisionPolicy())).run(last, bits=bits, progress=progress)
    rows = []
    for name, policy in chosen.items():
        under = with_policy(simulation, policy)
        rows.append(compare(name, policy, simulation, exact, taped(under, last, start(policy))))
    rows = _with_gains(rows, last)
    rows.sort(key=lambda row: -(last + 1 if row.horizon is None else row.horizon))
    timestep = float(simulation.system.spec.dynamics.timestep)
    per_bit = _steps_per_bit(rows)
    return Certificate(last, timestep, exact, tuple(rows), same_start, per_bit, _says(rows, last, per_bit))


def _steps_per_bit(rows: list[PolicyHorizon]) -> float:
    """ln 2 over the growth rate of the run whose growth could be followed longest."""
    # separations that grow by a power of time, as those of a lone pair, are no exponentials
    known = [row.growth for row in rows if row.growth.rate > 0 and row.growth.r_squared > _EXPONENTIAL]
    if not known:
        return float("nan")
    longest = max(known, key=lambda found: found.last - found.first)
    return float(np.log(2) / longest.rate)


def _with_gains(rows: list[PolicyHorizon], last: int) -> list[PolicyHorizon]:
    """What each policy gains over single precision throughout, where that leaves the exact history."""
    by_policy = {row.policy: row for row in rows}
    low, high = by_policy.get(_NARROW), by_policy.get(PrecisionPolicy())
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
    """By how many bits a run is closer to the exact positions, while both decide as the exact program does.

    The median over the second half of the steps before the first decision at fault: unlike the horizon, it
    does not hang on which pair happens to come close to its cutoff.
    """
    end = min(h for h in (base.horizon, row.horizon) if h is not None)
    a, b = (one.separation[end // 2 : end] for one in (base, row))
    if not len(a) or not len(b) or not np.all(b[: len(a)] > 0):
        return float("nan")
    return float(np.median(np.log2(a[: len(b)] / b)))


def _says(rows: list[PolicyHorizon], last: int, per_bit: float) -> tuple[str, ...]:
    """What the ranking means, plainly; rows in any order."""
    base = next((row for row in rows if row.policy == _NARROW), None)
    wide = next((row for row in rows if row.policy == PrecisionPolicy()), None)
    at_most = "" if wide is not None and wide.horizon is not None else "at most "
    sentences = []
    for row in rows:
        kept = (
            f"keeps every decision of the exact history up to step {last}"
            if row.horizon is None
            else f"leaves the exact history at step {row.horizon}"
        )
        sentence = f"{row.name} {kept}"
        if row.failed:
            sentence += f" (its run ended in a {row.failed})"
        other = row.policy not in (_NARROW, PrecisionPolicy())
        if other and row.policy.force not in WIDE and base is not None and base.horizon is not None:
            sentence += ": " + _lost(row, base.horizon)
        elif other and base is not None and base.horizon is not None:
            sentence += ": " + _gained(row, base.horizon, last, at_most)
        sentences.append(sentence + ".")
    if np.isfinite(per_bit):
        sentences.append(f"One more bit in every number is worth about {per_bit:.0f} steps here.")
    return tuple(sentences)


def _lost(row: PolicyHorizon, base: int) -> str:
    """What sixteen bits cost, against single precision throughout."""
    if row.horizon is None or row.horizon >= base:
        return f"{row.policy.force} pair forces cost nothing here that single precision does not"
    lost = f"{row.policy.force} pair forces cost {base - row.horizon} of the {base} steps of single precision"
    return lost if np.isnan(row.closer) else f"{lost}; its positions are {-row.closer:.1f} bits further off"


def _gained(row: PolicyHorizon, base: int, last: int, at_most: str) -> str:
    bits = _bits_closer(row.closer)
    if row.horizon is None:
        return f"the promotion gains {last - base} steps or more, and {bits}"
    if row.horizon <= base:
        nothing = "no step" if row.closer >= _NO_BITS else "nothing"
        earlier = f"{base - row.horizon} steps earlier than" if row.horizon < base else "at the same step as"
        return f"the promotion gains {nothing}: it leaves {earlier} single precision, and {bits}"
    share = f"{row.horizon - base:+d} steps"
    if np.isfinite(row.gain):
        share += f", {at_most}{row.gain:.0%} of what double precision throughout gains"
    # a horizon hangs on one pair; what is not closer to the exact run was lucky, not better
    if row.closer < _NO_BITS:
        if row.gain < _NOTHING:
            return f"the promotion gains nothing ({share}; {bits})"
        return f"one decision came out right, and that is all the promotion gains ({share}; {bits})"
    return f"the promotion gains {share}; {bits}"


def _bits_closer(closer: float) -> str:
    """By how much positions are closer to the exact ones, or further off, in words."""
    if np.isnan(closer):
        return "how close its positions are to the exact ones is not known"
    if abs(closer) < 0.05:
        return "its positions are as far from the exact ones"
    where = "closer to" if closer > 0 else "further from"
    return f"its positions are {abs(closer):.1f} bits {where} the exact ones"
