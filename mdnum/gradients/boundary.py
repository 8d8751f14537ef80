"""The boundary term of averages: what a cutoff's radius does by letting pairs in.

An average of a quantity that jumps when a pair enters changes with the radius, because more pairs are
inside; differentiating the quantity at fixed decisions never sees that, and gives exactly 0 for a hard
cutoff. What is missing is the jump times the density of pairs at the radius.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mdnum.gradients.base import Gradient, Problem, Progress, check
from mdnum.gradients.frames import Frames, frames, known, standard_error
from mdnum.gradients.symmetric import in_phase, pairs_only
from mdnum.gradients.tape import Tape
from mdnum.md.cell import displacement
from mdnum.md.verlet import BUILDERS, RebuildRule, VerletList
from mdnum.systems.build import Simulation

#: Widths of the kernel, each half of the one before.
WIDTHS = 5


@dataclass(frozen=True)
class Density:
    """How many pairs there are per length at the cutoff, weighted frame by frame.

    Attributes:
        frames: each frame's share of the estimate that was chosen, shape (frames, types).
        width: the largest of the three kernels that it is extrapolated from, length.
        error: standard error and what is left of the bias, for the sum over frames, shape (types,).
        table: (width, estimate, standard error) of each kernel, summed over frames and types.
    """

    frames: Float[np.ndarray, "frames types"]
    width: float
    error: Float[np.ndarray, "types"]
    table: tuple[tuple[float, float, float], ...]


def distances(
    simulation: Simulation, x: Float[np.ndarray, "3 atoms"], reach: float
) -> list[Float[np.ndarray, "pairs"]]:
    """Distances of the pairs within `reach` of their cutoff, less the cutoff, by pair type.

    Args:
        simulation: the system as objects.
        x: wrapped positions.
        reach: length.
    """
    search = VerletList(BUILDERS["host"], RebuildRule(reach), simulation.r_cut)
    table = search.build(np.ascontiguousarray(x.T), simulation.cell)
    slots, columns = np.nonzero(table.index < x.shape[1])
    i, j = table.order[columns], table.order[table.index[slots, columns]]
    once = i < j
    i, j = i[once], j[once]
    r = np.sqrt(sum(c * c for c in displacement(simulation.cell, x.T[i], x.T[j])))
    kinds = simulation.type_of(i, j)
    beyond = [r[kinds == kind] - radius for kind, radius in enumerate(simulation.decider.r_cut)]
    return [one[np.abs(one) < reach] for one in beyond]


def density(
    simulation: Simulation,
    seen: Frames,
    weights: Float[np.ndarray, "frames types"],
    reach: float,
    told: Callable[[int, int], None] | None = None,
) -> Density:
    """Sum over frames of a weight times the density of pairs at the cutoff, delta(r_cut - r_ij).

    The delta function is a parabola of finite width. Its bias is even in the width, and three widths, each
    half of the one before, extrapolate to none up to the fourth order. Of these triples the widest is taken
    that differs from no narrower one by more than twice the standard error of the difference.

    Args:
        simulation: the system as objects.
        seen: the frames.
        weights: of each frame and pair type.
        reach: the largest width, length.
        told: called with the frames done and their number.

    Source: O. V. Lepski, Theory Probab. Appl. 35, 454 (1990), for the choice.
    """
    widths = reach / 2.0 ** np.arange(WIDTHS)
    found = np.zeros((WIDTHS, len(seen), simulation.pair_types))
    for k in range(len(seen)):
        for kind, beyond in enumerate(distances(simulation, seen.x[k], reach)):
            near = np.clip(1 - (beyond / widths[:, None]) ** 2, 0, None)
            found[:, k, kind] = 0.75 / widths * near.sum(axis=1)
        if told is not None:
            told(k + 1, len(seen))
    found *= weights
    rows = len(seen)
    table = tuple(
        (float(w), float(one.sum()), rows * standard_error(one.sum(axis=1)))
        for w, one in zip(widths, found, strict=True)
    )
    flat = (4 * found[1:] - found[:-1]) / 3
    flat = (16 * flat[1:] - flat[:-1]) / 15
    by_frame = flat.sum(axis=2)
    best = len(flat) - 1
    for k in range(best):
        # the noise that frames share does not tell one width from another
        apart = by_frame[k + 1 :] - by_frame[k]
        if all(abs(one.sum()) <= 2 * rows * standard_error(one) for one in apart):
            best = k
            break
    bias = np.abs((flat[min(best + 1, len(flat) - 1)] - flat[best]).sum(axis=0))
    noise = np.array([rows * standard_error(column) for column in flat[best].T])
    return Density(flat[best], float(widths[best]), np.hypot(noise, bias), table)


@dataclass(frozen=True)
class Boundary:
    """The derivative of an average over given states: of what is inside, and of which pairs are.

    Attributes:
        reach: half the width of the widest kernel as a share of the cutoff; less where the box is narrow.
        budget: bytes of the recorded run that are kept in memory.
    """

    reach: float = 0.1
    budget: int = 2**29

    @property
    def name(self) -> str:
        """Its word."""
        return "boundary"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return "the derivative of an average over the states that were visited, pairs at the cutoff included"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Averages over frames, by parameters of the energy."""
        why = pairs_only(problem.simulation)
        if why is not None:
            return why
        if not problem.loss.of_single_frames:
            return f"{problem.loss.name} compares frames in time, and is no average over states"
        strange = [name for name in names if not known(name)]
        if strange:
            return f"at given states nothing depends on {', '.join(strange)}"
        if self._reach(problem.simulation) < 0.01 * problem.simulation.r_cut:
            return "the cutoff is half the width of the box, and pairs beyond it cannot be counted"
        return None

    def _reach(self, simulation: Simulation) -> float:
        room = float(np.min(simulation.cell.widths)) / 2 - simulation.r_cut
        return min(self.reach * min(simulation.decider.r_cut), 0.999 * room)

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters; its standard errors are in the details."""
        names = check(self, problem, names)
        simulation = problem.simulation
        tape = Tape(
            simulation, problem.loss, problem.steps, budget=self.budget, progress=in_phase(progress, "run")
        )
        seen = frames(tape, names, in_phase(progress, "frames"))
        gradient, details = {}, {"frames": len(seen)}
        terms, told = self.terms(simulation, seen, names, in_phase(progress, "pairs at the cutoff"))
        for name in names:
            gradient[name] = np.asarray(terms[name].sum(axis=0))
        return Gradient(self.name, self.says, tape.value, gradient, {}, details | told)

    def terms(self, simulation: Simulation, seen: Frames, names: Sequence[str], told=None):
        """Each frame's share of the derivative, by name, and what there is to say about it."""
        energy, force = simulation.jumps()
        radii = np.asarray(simulation.decider.r_cut)
        # what a pair that enters adds to the loss of each frame
        jump = seen.by_potential[:, None] * energy + seen.by_virial[:, None] * (radii * force)
        details: dict = {"error": {}, "interior": {}, "boundary": {}}
        moving = [name for name in names if name in ("cutoff.radius", "box.scale")]
        found = None
        if np.any(jump) and moving:
            found = density(simulation, seen, jump, self._reach(simulation), told)
            details |= {"kernel width": found.width, "kernels": [list(row) for row in found.table]}
        terms = {}
        for name in names:
            interior = seen.explicit[name]
            at_edge, bias = np.zeros_like(interior), 0.0
            if found is not None and name in moving:
                # a radius that grows lets pairs in one for one; a box that grows takes them out
                rate = np.ones(len(radii)) if name == "cutoff.radius" else -radii
                edge = found.frames * rate
                at_edge = edge if interior.ndim == 2 else edge.sum(axis=1)
                bias = float(np.linalg.norm(found.error * rate))
            terms[name] = interior + at_edge
            whole = terms[name].reshape(len(seen), -1)
            noise = len(seen) * np.array([standard_error(column) for column in whole.T])
            details["interior"][name] = interior.sum(axis=0).tolist()
            details["boundary"][name] = at_edge.sum(axis=0).tolist()
            details["error"][name] = float(max(np.linalg.norm(noise), bias))
        return terms, details
