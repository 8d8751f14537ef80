"""What each frame that a loss looks at says by itself: its term, and its derivatives at fixed positions.

Averages over an ensemble do not care how the frames hang together in time. What they need of a parameter is
how it changes each frame's term, and how it changes the energy that decides how often such a frame is met.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from mdnum.gradients import parameters
from mdnum.gradients.pairs import MODEL, SCALE, pull_back
from mdnum.gradients.parameters import Cotangents
from mdnum.gradients.tape import Tape, frame_of, rows_of
from mdnum.md.pairforce import PairForce
from mdnum.systems.build import Simulation


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frames:
    """The frames that a loss looks at, each by itself.

    Attributes:
        step: of each, shape (frames,).
        x: wrapped positions, user's order, length, shape (frames, 3, atoms).
        term: what each adds to the loss, which is linearized in its sums, shape (frames,).
        by_potential, by_virial: derivatives of the loss by the potential energy and the virial of each.
        energy: potential energy from which the forces of each derive, shape (frames,).
        kinetic: kinetic energy of each.
        explicit: derivatives of the loss at fixed positions (in units of the box) and decisions, by name,
            shape (frames, ...).
        force_energy: derivatives of `energy` likewise.
    """

    step: Int[np.ndarray, "frames"]
    x: Float[np.ndarray, "frames 3 atoms"]
    term: Float[np.ndarray, "frames"]
    by_potential: Float[np.ndarray, "frames"]
    by_virial: Float[np.ndarray, "frames"]
    energy: Float[np.ndarray, "frames"]
    kinetic: Float[np.ndarray, "frames"]
    explicit: dict[str, Float[np.ndarray, "frames *types"]]
    force_energy: dict[str, Float[np.ndarray, "frames *types"]]

    def __len__(self) -> int:
        return len(self.step)

    def every(self, stride: int) -> Frames:
        """Every so many of them; their terms no longer add up to the loss."""
        return jax.tree.map(lambda a: a[::stride], self)


def known(name: str) -> bool:
    """Whether a frame's term or energy depends on it at fixed positions."""
    return name.startswith(("potential.", "cutoff.")) or name == "box.scale"


def energy_of_forces(simulation: Simulation) -> Simulation:
    """The system whose energy has these forces as its gradient everywhere.

    A hard cutoff has the forces of the shifted one, and no force at the sphere where its energy jumps: a run
    samples the ensemble of the shifted energy, whatever energy it reports.
    """
    return simulation.continuous


def frames(tape: Tape, names: Sequence[str], progress: Callable[[int, int], None] | None = None) -> Frames:
    """The frames of a tape's loss.

    Args:
        tape: the run, of a pair potential.
        names: full names of parameters; those that a frame does not know of are left out.
        progress: called with the steps done and the last step.

    Error: a rounding error for each pair.
    """
    simulation = tape.simulation
    assert isinstance(simulation.force, PairForce)
    onto_total = jax.grad(lambda total: tape.loss.value(total, tape.frames))(tape.total)
    smooth = energy_of_forces(simulation).force
    assert isinstance(smooth, PairForce)
    found: list[Any] = []
    steps, where = [], []
    for stretch in tape.forward():
        seen = np.flatnonzero(tape.seen(stretch))
        if len(seen):
            order = stretch.table.order
            made = _look(
                (simulation.force, smooth),
                simulation.tables(stretch.table),
                rows_of(stretch),
                stretch.bits,
                tape.seen(stretch),
                (tape.loss, tape.origin, tape.around, onto_total),
                jnp.asarray(simulation.masses[order]),
            )
            found.append(jax.tree.map(lambda a, seen=seen: np.asarray(a)[seen], made))
            x = np.empty((len(seen), 3, simulation.atoms))
            x[:, :, order] = stretch.x[seen]
            where.append(x)
            steps.append(stretch.steps[seen])
        if progress is not None:
            progress(stretch.first + stretch.rows - 1, tape.steps)
    numbers, explicit, energetic = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    term, by_potential, by_virial, energy, kinetic = numbers
    by = [name for name in names if known(name)]
    return Frames(
        np.concatenate(steps),
        np.concatenate(where),
        term,
        by_potential,
        by_virial,
        energy,
        kinetic,
        {name: _by_name(simulation, explicit, name) for name in by},
        {name: _by_name(simulation, energetic, name) for name in by},
    )


def _by_name(simulation: Simulation, parts, name: str) -> Float[np.ndarray, "frames *types"]:
    model, scale = parts
    nothing = np.zeros((3, 0))
    rows = [
        parameters.gradient(
            simulation,
            Cotangents(
                jax.tree.map(lambda leaf, k=k: leaf[k], model),
                simulation.integrator,
                nothing,
                nothing,
                float(scale[k]),
                np.zeros(simulation.pair_types),
            ),
            name,
        )
        for k in range(len(scale))
    ]
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
            parts = jax.tree.map(lambda a, b: jnp.sum(a * b), onto_total, made)
            return sum(jax.tree.leaves(parts), start=zero)

        value, (by_potential, by_virial, by_length) = jax.value_and_grad(term, argnums=(0, 1, 2))(
            row[4], row[5], one
        )
        still = jnp.zeros_like(row[1])
        own = pull_back(force, row[1], tables, told, still, by_potential, by_virial, wanted)
        other = pull_back(smooth, row[1], tables, told, still, one, zero, wanted)
        energy = jnp.sum(smooth(row[1], tables, decisions=False, given=told).energy, dtype=jnp.float64)
        kinetic = 0.5 * jnp.sum(masses * jnp.sum(jnp.square(row[2].astype(jnp.float64)), axis=0))
        wide = jax.tree.map(
            lambda leaf: leaf.astype(jnp.float64), ((own.model, own.scale), (other.model, other.scale))
        )
        (own_model, own_scale), theirs = wide
        return (value, by_potential, by_virial, energy, kinetic), (own_model, own_scale + by_length), theirs

    def step(_, given):
        row, told, see = given
        shapes = jax.eval_shape(look, row, told)
        nothing = jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)
        return None, lax.cond(see, look, lambda *_: nothing, row, told)

    return lax.scan(step, None, (rows, bits, seen))[1]


def standard_error(series: Float[np.ndarray, "frames"]) -> float:
    """Standard error of the mean of a correlated series: the largest over a few numbers of blocks.

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
