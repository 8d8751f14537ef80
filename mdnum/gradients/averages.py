"""Compute derivatives of averages from the frames of one run. The dynamics of the run is not differentiated.

The derivative of an average has up to three contributions. First, at fixed positions, the value of the
observable in each frame changes. Second, an observable may jump when a pair enters the cutoff. The
contribution of jumps is their height times the density of pairs at the cutoff. Derivatives at fixed decisions
omit the contribution of jumps. Third, with a thermostat, the statistical weight exp(-U/kT) of each frame
changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import MODEL, SCALE, pull_back
from mdnum.gradients.parameters import Cotangents
from mdnum.gradients.problem import Gradient, Method, Problem, Progress, in_phase, one_term
from mdnum.gradients.recorded import tape_of
from mdnum.gradients.tape import KEPT, RunTape, frame_of, listed
from mdnum.md.cell import displacement
from mdnum.md.cutoffs import Hard
from mdnum.md.neighbors import BUILDERS, RebuildRule, VerletList
from mdnum.md.pairforce import PairForce
from mdnum.systems.simulation import Simulation

#: Widths of the kernel, each half of the previous width.
WIDTHS = 5


@dataclass(frozen=True)
class Frames:
    """Frames of a run, with the loss, energy and derivatives of each."""

    step: Int[np.ndarray, "frames"]  # of each
    x: Float[np.ndarray, "frames 3 atoms"]  # wrapped positions, user's order, length
    term: Float[np.ndarray, "frames"]  # what each adds to the loss, which is linearized in its sums
    # by_potential, by_virial: derivatives of the loss by the potential energy and the virial of each
    by_potential: Float[np.ndarray, "frames"]
    by_virial: Float[np.ndarray, "frames"]
    energy: Float[np.ndarray, "frames"]  # potential energy from which the forces of each derive
    kinetic: Float[np.ndarray, "frames"]  # kinetic energy of each
    # derivatives of the loss at fixed positions (in units of the box) and decisions, by name
    explicit: dict[str, Float[np.ndarray, "frames *types"]]
    force_energy: dict[str, Float[np.ndarray, "frames *types"]]  # derivatives of `energy` likewise

    def __len__(self) -> int:
        return len(self.step)


def known(name: str) -> bool:
    """Return whether the energy can depend on a parameter at fixed positions."""
    return name.startswith(("potential.", "cutoff.")) or name == "box.scale"


def frames(tape: RunTape, names: Sequence[str], progress: Callable[[int, int], None] | None = None) -> Frames:
    """Evaluate the loss and its derivatives in each frame of a run.

    Args:
        tape: the run, of a pair potential.
        names: full names of parameters; a parameter that no single frame depends on is skipped.

    Error: one rounding error per pair.
    """
    simulation = tape.simulation
    assert isinstance(simulation.force, PairForce)
    onto_total = jax.grad(lambda total: tape.loss.value(total, tape.frames))(tape.total)
    # a hard cutoff has the forces of a shifted one, since its energy jump exerts none: a run samples the
    # ensemble of the shifted energy, whatever energy is reported
    smooth = (simulation.with_cutoff("shifted") if isinstance(simulation.cutoff, Hard) else simulation).force
    assert isinstance(smooth, PairForce)
    found: list[Any] = []
    steps, where = [], []
    looking = (tape.loss, tape.origin, tape.around, onto_total)
    for stretch in tape.forward():
        seen = np.flatnonzero(tape.seen(stretch))
        if len(seen):
            order = stretch.table.order
            made = _look(
                (simulation.force, smooth), simulation.tables(stretch.table), stretch.columns, stretch.bits,
                tape.seen(stretch), looking, jnp.asarray(simulation.masses[order]),
            )  # fmt: skip
            found.append(jax.tree.map(lambda a, seen=seen: np.asarray(a)[seen], made))
            x = np.empty((len(seen), 3, simulation.atoms))
            x[:, :, order] = stretch.x[seen]
            where.append(x)
            steps.append(stretch.steps[seen])
        if progress is not None:
            progress(stretch.first + stretch.rows - 1, tape.steps)
    numbers, explicit, energetic = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    by = [name for name in names if known(name)]
    named = [{name: _by_name(simulation, parts, name) for name in by} for parts in (explicit, energetic)]
    columns: list[Any] = [np.concatenate(steps), np.concatenate(where), *numbers, *named]
    return Frames(*columns)


def _by_name(simulation: Simulation, by_all, name: str) -> Float[np.ndarray, "frames *types"]:
    model, scale = by_all
    still, none = np.zeros((3, 0)), np.zeros(simulation.pair_types)
    rows = []
    for k in range(len(scale)):
        own = jax.tree.map(lambda leaf, k=k: leaf[k], model)
        parts = Cotangents(own, simulation.integrator, still, still, float(scale[k]), none)
        rows.append(parameters.gradient(simulation, parts, name))
    return np.stack(rows)


@eqx.filter_jit
def _look(forces: tuple[PairForce, PairForce], tables, rows, bits, seen, looking, masses):
    loss, origin, around, onto_total = looking
    force, smooth = forces
    order = tables.order
    dtype = rows[1].dtype
    zero, one = jnp.zeros((), jnp.float64), jnp.ones((), jnp.float64)
    wanted = frozenset({MODEL, SCALE})

    def look(row, told):
        def term(potential, virial, length):
            here = around._replace(matrix=around.matrix * length, volume=around.volume * length**3)
            frame = frame_of((*row[:4], potential, virial), order, around.matrix)
            scaled = frame._replace(x=frame.x * length.astype(dtype), v=frame.v * length.astype(dtype))
            start = origin._replace(x=origin.x * length.astype(dtype), v=origin.v * length.astype(dtype))
            made = loss.observe(scaled, start, here)
            parts = jax.tree.map(lambda a, b: jnp.real(jnp.sum(a * b)), onto_total, made)
            return sum(jax.tree.leaves(parts), start=zero)

        value, (by_potential, by_virial, by_length) = jax.value_and_grad(term, argnums=(0, 1, 2))(
            row[4], row[5], one
        )
        still = jnp.zeros_like(row[1])
        own = pull_back(force, row[1], tables, told, still, by_potential, by_virial, wanted)
        other = pull_back(smooth, row[1], tables, told, still, one, zero, wanted)
        energy = jnp.sum(smooth(row[1], tables, decisions=False, given=told).energy, dtype=jnp.float64)
        kinetic = 0.5 * jnp.sum(masses * jnp.sum(jnp.square(row[2].astype(jnp.float64)), axis=0))
        both = ((own.model, own.strain), (other.model, other.strain))
        (own_model, own_scale), theirs = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), both)
        return (value, by_potential, by_virial, energy, kinetic), (own_model, own_scale + by_length), theirs

    def step(_, given):
        row, told, see = given
        shapes = jax.eval_shape(look, row, told)
        nothing = jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)
        return None, lax.cond(see, look, lambda *_: nothing, row, told)

    return lax.scan(step, None, (rows, bits, seen))[1]


def standard_error(series: Float[np.ndarray, "frames"]) -> float:
    """Return the standard error of a correlated series: the largest with 8, 16 or 32 blocks.

    Source: H. Flyvbjerg, H. G. Petersen, J. Chem. Phys. 91, 461 (1989).
    """
    errors = []
    for blocks in (8, 16, 32):
        if len(series) >= 2 * blocks:
            means = np.array([part.mean() for part in np.array_split(series, blocks)])
            errors.append(means.std(ddof=1) / np.sqrt(blocks))
    if not errors and len(series) > 1:
        errors.append(np.std(series, ddof=1) / np.sqrt(len(series)))
    return float(max(errors, default=np.inf))


@dataclass(frozen=True)
class Density:
    """Number of pairs per unit of distance at the cutoff, and its error."""

    # each frame's share of the estimate that was chosen, shape (frames, types)
    frames: Float[np.ndarray, "frames types"]
    width: float  # the largest of the three kernels that it is extrapolated from, length
    # standard error and what is left of the bias, for the sum over frames, shape (types,)
    error: Float[np.ndarray, "types"]
    # (width, estimate, standard error) of each kernel, summed over frames and types
    table: tuple[tuple[float, float, float], ...]


def distances(
    simulation: Simulation, x: Float[np.ndarray, "3 atoms"], reach: float
) -> list[Float[np.ndarray, "pairs"]]:
    """Return r - r_cut of pairs near the cutoff, in one array per pair type.

    Args:
        x: wrapped positions.
        reach: length.
    """
    search = VerletList(BUILDERS["host"], RebuildRule(reach), simulation.r_cut)
    table = search.build(np.ascontiguousarray(x.T), simulation.cell)
    first, second, kinds = listed(simulation, table)
    i, j = table.order[first], table.order[second]
    r = np.sqrt(sum(c * c for c in displacement(simulation.cell, x.T[i], x.T[j])))
    beyond = [r[kinds == kind] - radius for kind, radius in enumerate(simulation.decider.r_cut)]
    return [one[np.abs(one) < reach] for one in beyond]


def density(
    simulation: Simulation,
    seen: Frames,
    weights: Float[np.ndarray, "frames types"],
    reach: float,
    progress: Callable[[int, int], None] | None = None,
) -> Density:
    """Estimate the weighted pair density at the cutoff, summed over frames.

    The delta function is replaced by a parabolic kernel of finite width. The bias contains only even powers
    of the kernel width. Extrapolation from three widths (w, w/2, w/4) removes the second and fourth powers.
    The result uses the widest kernels that agree with all narrower kernels. Two extrapolations agree if they
    differ by at most two standard errors.

    Args:
        weights: one per frame and pair type. reach: the largest width, length.

    Source: O. V. Lepski, Theory Probab. Appl. 35, 454 (1990), for the choice of the width.
    """
    widths = reach / 2.0 ** np.arange(WIDTHS)
    found = np.zeros((WIDTHS, len(seen), simulation.pair_types))
    for k in range(len(seen)):
        for kind, beyond in enumerate(distances(simulation, seen.x[k], reach)):
            near = np.clip(1 - (beyond / widths[:, None]) ** 2, 0, None)
            found[:, k, kind] = 0.75 / widths * near.sum(axis=1)
        if progress is not None:
            progress(k + 1, len(seen))
    found *= weights
    rows = len(seen)
    table = tuple(
        (float(w), float(one.sum()), rows * standard_error(one.sum(axis=1)))
        for w, one in zip(widths, found, strict=True)
    )
    flat = (4 * found[1:] - found[:-1]) / 3
    flat = (16 * flat[1:] - flat[:-1]) / 15
    by_frame = flat.sum(axis=2)

    def alike(k: int) -> bool:
        # the noise that frames share does not tell one width from another
        differences = by_frame[k + 1 :] - by_frame[k]
        return all(abs(one.sum()) <= 2 * rows * standard_error(one) for one in differences)

    best = next(k for k in range(len(flat)) if alike(k))
    bias = np.abs((flat[min(best + 1, len(flat) - 1)] - flat[best]).sum(axis=0))
    noise = np.array([rows * standard_error(column) for column in flat[best].T])
    return Density(flat[best], float(widths[best]), np.hypot(noise, bias), table)


@dataclass(frozen=True)
class BoundaryTerm(Method):
    """Gradient method: derivative of an average, including pairs that cross the cutoff."""

    # half the width of the widest kernel as a share of the cutoff; less where the box is narrow
    reach: float = 0.1
    budget: int = KEPT  # bytes of the recorded run that are kept in memory

    name = "boundary"
    kind = "average"
    description = (
        "the derivative of an average over the states that were visited, pairs at the cutoff included"
    )

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        if (why := one_term(problem.simulation)) is not None:
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

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        simulation, tape = problem.simulation, tape_of(problem, False, self.budget, progress)
        seen = frames(tape, names, in_phase(progress, "frames"))
        terms, details = self.terms(simulation, seen, names, in_phase(progress, "pairs at the cutoff"))
        gradient = {name: np.asarray(terms[name].sum(axis=0)) for name in names}
        return self.result(tape.value, gradient, details={"frames": len(seen), **details})

    def terms(self, simulation: Simulation, seen: Frames, names: Sequence[str], progress=None):
        """Return the contribution of each frame to each derivative, and the derivatives' errors."""
        energy, force = simulation.jumps()
        radii = np.asarray(simulation.decider.r_cut)
        # what a pair that enters adds to the loss of each frame
        jump = seen.by_potential[:, None] * energy + seen.by_virial[:, None] * (radii * force)
        details: dict = {"error": {}, "interior": {}, "boundary": {}}
        moving = [name for name in names if name in ("cutoff.radius", "box.scale")]
        found = None
        if np.any(jump) and moving:
            found = density(simulation, seen, jump, self._reach(simulation), progress)
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


@dataclass(frozen=True)
class Reweighting(Method):
    """Gradient method: differentiable trajectory reweighting, for averages over a canonical ensemble.

    The derivative is the explicit derivative of the loss minus cov(loss, dU/dp) / kT, for energy U and
    parameter p. The covariance describes how the weights of the frames change.

    Error: the error is statistical; `details` contains a standard error from block averages. The standard
    error covers only fluctuations within one run. Source: Thaler and Zavadlav, Nature Communications 12, 6884
    (2021).
    """

    at_states: BoundaryTerm = field(default_factory=BoundaryTerm)  # the explicit part
    budget: int = KEPT  # bytes of the recorded run that are kept in memory

    name = "reweighting"
    kind = "average"
    description = "the derivative of the canonical average, by how the weights of the visited states change"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        if (why := one_term(problem.simulation)) is not None:
            return why
        integrator = problem.simulation.integrator
        if integrator.random is None or "temperature" not in integrator.numbers():
            return "without a thermostat states are not met with the weights of a temperature"
        if not problem.loss.of_single_frames:
            return f"{problem.loss.name} compares frames in time, and is no average over an ensemble"
        strange = [name for name in names if not known(name) and name != "dynamics.temperature"]
        if strange:
            return f"the canonical ensemble does not depend on {', '.join(strange)}"
        others = [name for name in names if known(name)]
        return self.at_states.reason_unavailable(problem, others) if others else None

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        simulation, tape = problem.simulation, tape_of(problem, False, self.budget, progress)
        seen = frames(tape, names, in_phase(progress, "frames"))
        inside = [name for name in names if known(name)]
        edge = in_phase(progress, "pairs at the cutoff")
        explicit, details = self.at_states.terms(simulation, seen, inside, edge)
        gradient: dict[str, np.ndarray] = {}
        details |= {
            "frames": len(seen), "standard error of the value": len(seen) * standard_error(seen.term),
            "explicit": {}, "response": {}, "relative change for half the size": {},
        }  # fmt: skip
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
        return self.result(tape.value, gradient, details=details)


def _score(simulation: Simulation, seen: Frames, name: str) -> Float[np.ndarray, "frames *types"]:
    """Return d ln(weight)/d(parameter) for each frame, in a canonical ensemble."""
    bath = simulation.integrator
    kT = float(getattr(bath, bath.keys()["temperature"].name))
    if name == "dynamics.temperature":
        return (seen.energy + seen.kinetic) / kT * simulation.units.k_B / kT
    return -seen.force_energy[name] / kT
