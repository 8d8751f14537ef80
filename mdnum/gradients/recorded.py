"""Gradient methods that linearize a recorded run.

First, an ordinary run is made and recorded. The steps are then linearized at the recorded states and
decisions. A reversible run in fixed-point numbers is recomputed instead of stored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.adjoint import FORCE, MODEL, SCALE, WEIGHT, AdjointCarry, reverse
from mdnum.gradients.crossings import Crossings
from mdnum.gradients.parameters import Cotangents, columns_of, gathered
from mdnum.gradients.problem import (
    Gradient,
    Method,
    Problem,
    Progress,
    in_phase,
    independent,
    one_term,
    pairs_only,
)
from mdnum.gradients.tangents import by_column, tangents
from mdnum.gradients.tape import KEPT, ReversibleTape, RunTape, TapeStretch
from mdnum.md.fixed_point import forgotten_bits
from mdnum.md.integrators import without_kick
from mdnum.systems.admission import second_derivative
from mdnum.systems.schema import ONSET_FRACTION
from mdnum.systems.simulation import Simulation

#: Default guard of event-aware gradients, as a share of the rms radial speed of a pair.
GUARD = 1e-3
#: Largest number of simultaneous tangents; a step of each costs one force evaluation, a step of a reverse
#: pass about three.
MOST = 64
_SINGLE_FRAMES = (
    "the loss looks at energy or virial in single frames, and these jump with a flip: that has a slope in an "
    "average over frames at equal times alone"
)
#: Number of crossings with the largest weights that are listed in the details.
_NAMED = 10
#: Function that is called with every stretch of the reverse pass, last first, and the gradients with respect
#: to its states.
Watch = Callable[[TapeStretch, AdjointCarry], None]


@dataclass(frozen=True)
class ReversePass:
    """Recorded run, gradient and cutoff crossings of a reverse pass."""

    tape: RunTape  # the run
    parts: Cotangents  # derivatives by all that it is made of
    gradient: dict[str, Float[np.ndarray, "..."]]  # by full name
    # of every stretch with their weights, last stretch first; empty without saltation
    crossings: list[Crossings]
    guard: float  # radial speed below which a crossing was left out, length per internal time


def passed(
    problem: Problem,
    names: Sequence[str],
    *,
    saltation: bool = True,
    guard: float = GUARD,
    budget: int = KEPT,
    watches: Sequence[Watch] = (),
    tape: RunTape | None = None,
    progress: Progress | None = None,
) -> ReversePass:
    """Run a simulation and its reverse pass. `watches` receive the cotangents.

    Args:
        names: full names of the parameters. saltation: whether to include the contribution of flips.
        guard: as a share of the rms radial speed of a pair. budget: bytes of the recorded run that are kept.
        tape: the run, if already made; with flips, if saltation is requested. Without saltation all its flips
            count as grazing: the program is then that of event-aware, which need not be compiled twice.

    Raises:
        InputError: saltation without a pair potential. NumericalError: the run blew up, or second
            derivatives of an energy function are not finite.
    """

    def watch(stretch: TapeStretch, trace: AdjointCarry) -> None:
        for one in watches:
            one(stretch, trace)

    if tape is None:
        tape = tape_of(problem, saltation, budget, progress)
    speed = guard * radial_speed(problem.simulation)
    parts, crossings = reverse(
        tape, wanted=wanted(names), saltation=tape.flips, guard=speed if saltation else np.inf,
        progress=in_phase(progress, "reverse pass"), watch=watch,
    )  # fmt: skip
    gradient = {name: parameters.gradient(problem.simulation, parts, name) for name in names}
    lost = not all(np.isfinite(one).all() for one in gradient.values())
    if lost and not problem.simulation.pairwise and (operation := second_derivative(problem.simulation)):
        raise NumericalError(
            f"the operation {operation} of the energy function has a second derivative that is not finite",
            where=problem.simulation.model.name,
            remedy="Mask the argument of the operation with jnp.where, not only its result",
        )
    return ReversePass(tape, parts, gradient, crossings if saltation else [], speed)


def tape_of(problem: Problem, flips: bool, budget: int = KEPT, progress: Progress | None = None) -> RunTape:
    """Run the simulation of a problem, and return the recorded run."""
    return RunTape(
        problem.simulation, problem.loss, problem.steps, flips=flips, budget=budget,
        progress=in_phase(progress, "run"),
    )  # fmt: skip


@dataclass(frozen=True)
class Symmetric(Method):
    """Gradient method: derivative at fixed decisions, with little memory."""

    # bytes of the recorded run that are kept in memory; what does not fit is run again, stretch by stretch,
    # with the same bits
    budget: int = KEPT

    name = "symmetric"
    description = "the derivative of the steps that ran, their decisions held fixed"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        simulation = problem.simulation
        return pairs_only(simulation, any_step=True) if simulation.pairwise else None

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        made = passed(problem, names, saltation=False, budget=self.budget, progress=progress)
        return self.of(problem, made)

    def of(self, problem: Problem, made: ReversePass) -> Gradient:
        """Create a `Gradient` from the result of a reverse pass."""
        tape = made.tape
        details = {"stretches": len(tape), "run again": tape.replayed, "bytes kept": tape.held}
        notes = independent(problem, made.gradient, saltation=False)
        return self.result(tape.value, made.gradient, notes, details)


@dataclass(frozen=True)
class EventAware(Method):
    """Gradient method: derivative at fixed decisions, plus the effect of flip times."""

    # radial speed below which a crossing grazes and is left out, as a share of the rms radial speed of a
    # pair. Left in, single crossings would dominate: their terms go with one over that speed
    guard: float = GUARD
    budget: int = KEPT  # as for `Symmetric`

    name = "event-aware"
    kind = "flow"
    description = "the derivative of the steps plus what moving the time of every flip does"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        simulation = problem.simulation
        if simulation.pairwise:
            return pairs_only(simulation, any_step=True)
        if not simulation.imposable:
            return "it is for pair potentials, and for energies that take a listed pair wherever it is"
        return None

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        made = passed(problem, names, guard=self.guard, budget=self.budget, progress=progress)
        return self.of(problem, made)

    def of(self, problem: Problem, made: ReversePass) -> Gradient:
        """Create a `Gradient` from the result of a reverse pass."""
        notes = independent(problem, made.gradient, saltation=True)
        unseen = any(made.tape.jumps_unseen)
        if unseen:
            notes |= dict.fromkeys(made.gradient, _SINGLE_FRAMES)
        details = {"guard": made.guard, "loss jumps": unseen, **weights(made.crossings)}
        return self.result(made.tape.value, made.gradient, notes, details)


@dataclass(frozen=True)
class Forward(Method):
    """Gradient method: derivative of the loss at fixed decisions, in forward mode (tangents)."""

    # whether every flip adds what moving its time does, as the method event-aware has it
    saltation: bool = False
    guard: float = GUARD  # as for `EventAware`
    budget: int = KEPT  # as for `Symmetric`
    most: int = MOST  # numbers that it differentiates by, at most

    name = "forward"
    description = "the derivative of the steps that ran, their decisions held fixed, by tangents"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        simulation = problem.simulation
        if simulation.fixed_point is not None:
            return "a fixed-point integer state has no tangent; the method reversible is for it"
        if self.saltation or simulation.pairwise:
            why = pairs_only(simulation)
        else:
            why = without_kick(simulation.integrator)
        if why is not None:
            return why
        many = len(columns_of(simulation, names))
        if many > self.most:
            return f"{many} numbers would need a tangent each, and at most {self.most} are carried"
        return None

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        simulation = problem.simulation
        tape = tape_of(problem, self.saltation, self.budget, progress)
        guard, saltation = self.guard * radial_speed(simulation), self.saltation
        phase = in_phase(progress, "tangents")
        total, met = None, []
        for part in tangents(tape, names, saltation=saltation, guard=guard, progress=phase):
            total = part.total
            met.append(part.crossings)
        gradient = gathered(simulation, names, by_column(tape, total))
        details: dict[str, Any] = {"tangents": len(columns_of(simulation, names))}
        if saltation:
            grazing = sum(int(one.grazing.sum()) for one in met)
            details |= {"guard": guard, "crossings": sum(map(len, met)), "grazing": grazing}
        notes = independent(problem, gradient, saltation=saltation)
        found = self.result(tape.value, gradient, notes, details)
        if saltation:
            return replace(found, kind="flow", description=f"{EventAware.description}, by tangents")
        return found


@dataclass(frozen=True)
class Reversible(Method):
    """Gradient method: derivative at fixed decisions, with a run reversed in time.

    The forward pass stores only the last state. Rounding to integers is differentiated as the identity.

    Raises:
        NumericalError: the states of the reversed run differ from those of the forward run.
    """

    name = "reversible"
    description = (
        "the derivative of the steps that ran with a fixed-point integer state, reversed bit for bit; their "
        "decisions held fixed"
    )

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        if problem.simulation.fixed_point is None:
            return 'only steps of a fixed-point integer state can be reversed (precision.state = "lattice")'
        return pairs_only(problem.simulation)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        simulation = problem.simulation
        tape = ReversibleTape(simulation, problem.loss, problem.steps, progress=in_phase(progress, "run"))
        made = passed(problem, names, saltation=False, tape=tape, progress=progress)
        assert simulation.fixed_point is not None
        details = {
            "stretches": tape.stretches, "returned to the start": True,
            "fixed_point": simulation.fixed_point.to_dict(float(simulation.integrator.timestep)),
            "bytes that grow with the run": tape.nbytes,
            "bits forgotten by friction a step": forgotten_bits(simulation.integrator),
        }  # fmt: skip
        notes = independent(problem, made.gradient, saltation=False)
        return self.result(tape.value, made.gradient, notes, details)


@dataclass(frozen=True)
class Surrogate(Method):
    """Gradient method: derivative with a switching function at the cutoff."""

    cutoff: str = "quintic"  # of the twin; one with an onset
    onset: float = ONSET_FRACTION  # where its switching begins, as a share of the cutoff
    method: Method = field(default_factory=Symmetric)  # how the twin is differentiated

    name = "surrogate"
    kind = "other program"
    description = "the derivative of another program, whose cutoff switches smoothly"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        if (why := one_term(problem.simulation)) is not None:
            return why
        if problem.simulation.cutoff.switches:
            return f"the cutoff is {problem.simulation.cutoff.name}, which has no force jump to smooth"
        return self.method.reason_unavailable(self.twin(problem), names)

    def twin(self, problem: Problem) -> Problem:
        """Return the problem with a switching function at the cutoff."""
        made = problem.simulation.with_cutoff(self.cutoff)
        onset = parameters.value(made, "cutoff.radius") * self.onset
        return replace(problem, simulation=made).at({"cutoff.onset": onset})

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        found = self.method(self.twin(problem), names, progress)
        details = {"cutoff": self.cutoff, "onset": self.onset, **found.details}
        notes = dict.fromkeys(names, "derivative for the switched cutoff, not for the given system")
        return self.result(found.value, found.gradient, notes | found.notes, details)


def weights(crossings: Sequence[Crossings]) -> dict[str, Any]:
    """Return the numbers of crossings and of grazing ones, and the crossings with the largest weights."""
    speed, weight, grazing = (joined(crossings, name) for name in ("speed", "weight", "grazing"))
    flips = {name: joined(crossings, name, ledger=True) for name in ("step", "i", "j", "entered")}
    key, heavy = -np.abs(weight), np.arange(len(weight))
    if len(weight) > _NAMED:
        # of half a million few are named: only those are sorted, and what weighs as much as the last
        heavy = np.flatnonzero(~(key > np.partition(key, _NAMED)[_NAMED]))
    rows = [
        {
            **{name: column[k].item() for name, column in flips.items()},
            "radial_speed": float(speed[k]), "weight": float(weight[k]), "grazing": bool(grazing[k]),
        }
        for k in heavy[np.argsort(key[heavy], kind="stable")[:_NAMED]]
    ]  # fmt: skip
    return {
        "crossings": len(weight), "grazing": int(grazing.sum()),
        "weight applied": float(np.sum(np.abs(weight[~grazing]))),
        "weight left out": float(np.nansum(np.abs(weight[grazing]))), "heaviest": rows,
    }  # fmt: skip


def joined(crossings: Sequence[Crossings], name: str, *, ledger: bool = False) -> np.ndarray:
    """Concatenate one column of the crossings from several stretches."""
    return np.concatenate([getattr(one.ledger if ledger else one, name) for one in crossings])


def radial_speed(simulation: Simulation) -> float:
    """Return the rms relative speed of two atoms along their connecting line, internal units."""
    speed2 = float(np.mean(np.sum(simulation.velocities**2, axis=1)))
    return float(np.sqrt(2 * speed2 / 3))


def wanted(names: Sequence[str]) -> frozenset[str]:
    """Return which derivatives a reverse pass must compute."""
    parts = {name: {MODEL} for name in ("potential", "cutoff", "terms")}
    parts |= {"dynamics": {FORCE}, "box": {SCALE}}
    return frozenset(
        part for name in names
        for part in ((WEIGHT,) if parameters.is_weight(name) else parts.get(name.partition(".")[0], ()))
    )  # fmt: skip
