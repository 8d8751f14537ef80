"""Reverse mode by symmetric Jacobians, at the recorded run: plain, and with what the flips add."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import reverse
from mdnum.gradients.base import Gradient, Problem, Progress, check, independent
from mdnum.gradients.crossings import Crossings
from mdnum.gradients.pairs import FORCE, MODEL, SCALE
from mdnum.gradients.tape import Tape
from mdnum.md.manyforce import ManyBodyForce
from mdnum.md.pairforce import PairForce
from mdnum.systems.build import Simulation

#: Default guard of event-aware gradients, as a share of the rms radial speed of a pair.
GUARD = 1e-3
#: Said of a loss that jumps where a slope cannot tell.
_SINGLE_FRAMES = (
    "the loss looks at energy or virial in single frames, and these jump with a flip: that has a slope in an "
    "average over frames at equal times alone"
)
#: Crossings of the largest weight that are named in the details.
_NAMED = 10


@dataclass(frozen=True)
class Symmetric:
    """The derivative of the steps that ran, by one reverse pass without a tape of operations.

    Attributes:
        budget: bytes of the recorded run that are kept in memory; what does not fit is run again, stretch by
            stretch, with the same bits.
    """

    budget: int = 2**29

    @property
    def name(self) -> str:
        """Its word."""
        return "symmetric"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return "the derivative of the steps that ran, their decisions held fixed"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Not for forces that are rounded after every operation."""
        if isinstance(problem.simulation.force, ManyBodyForce):
            return None
        return pairs_only(problem.simulation)

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters."""
        names = check(self, problem, names)
        tape = Tape(
            problem.simulation,
            problem.loss,
            problem.steps,
            budget=self.budget,
            progress=in_phase(progress, "run"),
        )
        parts, _ = reverse(tape, wanted=wanted(names), progress=in_phase(progress, "reverse pass"))
        gradient = {name: parameters.gradient(problem.simulation, parts, name) for name in names}
        notes = independent(problem, gradient, saltation=False)
        details = {"stretches": len(tape), "made again": tape.replayed, "bytes kept": tape.held}
        return Gradient(self.name, self.says, tape.value, gradient, notes, details)


@dataclass(frozen=True)
class EventAware:
    """The derivative of the flow: that of the steps, and what the time of every flip adds.

    Attributes:
        guard: radial speed below which a crossing grazes and is left out, as a share of the rms radial speed
            of a pair. Left in, single crossings would dominate: their terms go with one over that speed.
        budget: as for `Symmetric`.
    """

    guard: float = GUARD
    budget: int = 2**29

    @property
    def name(self) -> str:
        """Its word."""
        return "event-aware"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return "the derivative of the steps plus what moving the time of every flip does"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Pair potentials only."""
        return pairs_only(problem.simulation)

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters."""
        names = check(self, problem, names)
        simulation = problem.simulation
        tape = Tape(
            simulation,
            problem.loss,
            problem.steps,
            flips=True,
            budget=self.budget,
            progress=in_phase(progress, "run"),
        )
        guard = self.guard * radial_speed(simulation)
        parts, found = reverse(
            tape,
            wanted=wanted(names),
            saltation=True,
            guard=guard,
            progress=in_phase(progress, "reverse pass"),
        )
        gradient = {name: parameters.gradient(simulation, parts, name) for name in names}
        notes, details = aware(problem, tape, gradient, guard, found)
        return Gradient(self.name, self.says, tape.value, gradient, notes, details)


def aware(
    problem: Problem, tape: Tape, gradient: Mapping[str, Any], guard: float, found: Sequence[Crossings]
) -> tuple[dict[str, str], dict[str, Any]]:
    """Notes and details of an event-aware gradient."""
    notes = independent(problem, gradient, saltation=True)
    unseen = bool(np.any(problem.simulation.jumps())) and tape.jumps_unseen
    if unseen:
        notes |= dict.fromkeys(gradient, _SINGLE_FRAMES)
    return notes, {"guard": guard, "loss jumps": unseen, **weights(found)}


def weights(found: Sequence[Crossings]) -> dict[str, Any]:
    """Counts of the crossings, and those that weigh most."""
    total = sum(len(one) for one in found)
    grazing = sum(int(one.grazing.sum()) for one in found)
    left_out = sum(float(np.sum(np.abs(one.weight[one.grazing & np.isfinite(one.weight)]))) for one in found)
    applied = sum(float(np.sum(np.abs(one.weight[~one.grazing]))) for one in found)
    rows = [
        {
            "step": int(one.ledger.step[k]),
            "i": int(one.ledger.subject[k, 0]),
            "j": int(one.ledger.subject[k, 1]),
            "entered": bool(one.ledger.entered[k]),
            "radial_speed": float(one.speed[k]),
            "weight": float(one.weight[k]),
            "grazing": bool(one.grazing[k]),
        }
        for one in found
        for k in np.argsort(-np.abs(one.weight))[:_NAMED]
    ]
    rows.sort(key=lambda row: -abs(row["weight"]))
    return {
        "crossings": total,
        "grazing": grazing,
        "weight applied": applied,
        "weight left out": left_out,
        "heaviest": rows[:_NAMED],
    }


def radial_speed(simulation: Simulation) -> float:
    """Root mean square speed along the line between two atoms, length per internal time."""
    speed2 = float(np.mean(np.sum(simulation.velocities**2, axis=1)))
    return float(np.sqrt(2 * speed2 / 3))


def wanted(names: Sequence[str]) -> frozenset[str]:
    """What the reverse pass has to work out for these parameters."""
    found: set[str] = set()
    for name in names:
        if name.startswith(("potential.", "cutoff.")):
            found.add(MODEL)
        elif name.startswith("dynamics."):
            found.add(FORCE)
        elif name == "box.scale":
            found |= {SCALE, FORCE}
    return frozenset(found)


def pairs_only(simulation: Simulation) -> str | None:
    """Why the reverse pass does not apply; None where it does."""
    if not isinstance(simulation.force, PairForce):
        return "it is for pair potentials"
    if simulation.policy.dtype("force").itemsize < 4:
        rounded = f"forces in {simulation.policy.force} are rounded after every operation"
        return f"{rounded}, which has no derivative"
    return None


def in_phase(progress: Progress | None, phase: str) -> Callable[[int, int], None] | None:
    """A callback of steps alone, that tells the phase too."""
    if progress is None:
        return None
    return lambda step, steps: progress(step, steps, phase)
