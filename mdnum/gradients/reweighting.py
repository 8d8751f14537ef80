"""The derivative of an ensemble average from one run: how often a state is met changes, too.

Trajectories forget where they came from, and their gradients grow without bound; averages do not. Under a
thermostat a state is met with the weight exp(-U/kT), so an average changes with a parameter through what
each state shows and through these weights. No trajectory is differentiated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.gradients.base import Gradient, Problem, Progress, check
from mdnum.gradients.boundary import Boundary
from mdnum.gradients.frames import Frames, energy_of_forces, frames, known, standard_error
from mdnum.gradients.symmetric import in_phase, pairs_only
from mdnum.gradients.tape import Tape
from mdnum.md.integrators import Langevin
from mdnum.systems.build import Simulation
from mdnum.systems.evaluate import Evaluator


@dataclass(frozen=True)
class Reweighting:
    """Differentiable trajectory reweighting: explicit derivative and response of the weights.

    The explicit part is that of `Boundary`; the response is minus the covariance of the loss's terms with
    the derivative of the energy, over kT.

    Attributes:
        at_states: the explicit part.
        budget: bytes of the recorded run that are kept in memory.

    Error: statistical; a standard error from blocks is in the details. With a few correlated frames it is
        large, and one over the steps of the run at best.
    Source: S. Thaler, J. Zavadlav, Nature Communications 12, 6884 (2021).
    """

    at_states: Boundary = field(default_factory=Boundary)
    budget: int = 2**29

    @property
    def name(self) -> str:
        """Its word."""
        return "reweighting"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return "the derivative of the canonical average, by how the weights of the visited states change"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Averages over the canonical ensemble, by parameters that its energy knows of."""
        why = pairs_only(problem.simulation)
        if why is not None:
            return why
        if not isinstance(problem.simulation.integrator, Langevin):
            return "without a thermostat states are not met with the weights of a temperature"
        if not problem.loss.of_single_frames:
            return f"{problem.loss.name} compares frames in time, and is no average over an ensemble"
        strange = [name for name in names if not known(name) and name != "dynamics.temperature"]
        if strange:
            return f"the canonical ensemble does not depend on {', '.join(strange)}"
        others = [name for name in names if known(name)]
        return self.at_states.why_not(problem, others) if others else None

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters; standard errors and effective sizes are in the details."""
        names = check(self, problem, names)
        simulation = problem.simulation
        tape = Tape(
            simulation, problem.loss, problem.steps, budget=self.budget, progress=in_phase(progress, "run")
        )
        seen = frames(tape, names, in_phase(progress, "frames"))
        inside = [name for name in names if known(name)]
        explicit, details = self.at_states.terms(
            simulation, seen, inside, in_phase(progress, "pairs at the cutoff")
        )
        gradient: dict[str, np.ndarray] = {}
        details |= {
            "frames": len(seen),
            "standard error of the value": len(seen) * standard_error(seen.term),
            "explicit": {},
            "response": {},
            "relative change for half the size": {},
        }
        for name in names:
            score = _score(simulation, seen, name)
            centered = (seen.term - seen.term.mean()).reshape(-1, *[1] * (score.ndim - 1))
            terms = centered * (score - score.mean(axis=0))
            at_states = explicit.get(name, np.zeros_like(terms))
            whole = terms + at_states
            gradient[name] = np.asarray(whole.sum(axis=0))
            columns = whole.reshape(len(seen), -1).T
            noise = np.linalg.norm([len(seen) * standard_error(column) for column in columns])
            details["error"][name] = float(max(noise, details["error"].get(name, 0.0)))
            details["explicit"][name] = at_states.sum(axis=0).tolist()
            details["response"][name] = terms.sum(axis=0).tolist()
            # to lowest order the effective share of samples is 1 / (1 + variance of the logarithm of weights)
            spread = np.sqrt(np.sum(np.var(score, axis=0)))
            details["relative change for half the size"][name] = float(1 / spread) if spread > 0 else None
        return Gradient(self.name, self.says, tape.value, gradient, {}, details)


def _score(simulation: Simulation, seen: Frames, name: str) -> Float[np.ndarray, "frames *types"]:
    """Derivative of the logarithm of each frame's weight."""
    bath = simulation.integrator
    assert isinstance(bath, Langevin)
    kT = float(bath.kT)
    if name == "dynamics.temperature":
        return (seen.energy + seen.kinetic) / kT * simulation.units.k_B / kT
    return -seen.force_energy[name] / kT


@dataclass(frozen=True)
class Weighed:
    """An average under other parameters, from frames of a run that had not got them.

    Attributes:
        weights: of the frames, adding up to 1, shape (frames,).
        effective: the number of frames that is as good as these with these weights.
    """

    weights: Float[np.ndarray, "frames"]
    effective: float


def weighed(simulation: Simulation, seen: Frames, changed: Simulation) -> Weighed:
    """Weights of the frames of one simulation in the canonical ensemble of another one.

    Args:
        simulation: the one that ran, under a Langevin thermostat.
        seen: its frames.
        changed: the other one; the same atoms in the same box at the same temperature.

    Raises:
        InputError: one of these differs.

    Source: of the effective size, Thaler & Zavadlav (2021), equation 5: the exponential of the entropy.
    """
    bath = simulation.integrator
    if not isinstance(bath, Langevin):
        raise InputError("weights are those of a temperature", remedy="Use a system with Langevin dynamics")
    same_box = np.array_equal(np.asarray(simulation.cell.matrix), np.asarray(changed.cell.matrix))
    other = changed.integrator
    if not same_box or not isinstance(other, Langevin) or float(other.kT) != float(bath.kT):
        raise InputError("the two systems differ in box or temperature", remedy="Run the other one")
    evaluate = Evaluator(energy_of_forces(changed), skin=0.0)
    energy = np.array([evaluate(x.T).energy for x in seen.x])
    exponent = -(energy - seen.energy) / float(bath.kT)
    weights = np.exp(exponent - exponent.max())
    weights /= weights.sum()
    positive = weights[weights > 0]
    return Weighed(weights, float(np.exp(-np.sum(positive * np.log(positive)))))
