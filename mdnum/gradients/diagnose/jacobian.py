"""The product of all step Jacobians of a run as a linear map: forward on tangents, backward on cotangents.

A block of vectors goes through the steps at the states and decisions that were recorded. After every stretch
it is made orthonormal again, so that neither does a length overflow nor do all vectors turn into one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.gradients.loops import over_rows
from mdnum.gradients.pairs import pull_back
from mdnum.gradients.tape import Stretch, Tape
from mdnum.md.decide import Tables
from mdnum.md.integrators import Integrator
from mdnum.md.pairforce import PairForce
from mdnum.md.stepper import MdState, PairDynamics


@dataclass(frozen=True)
class Image:
    """Where a block of orthonormal vectors went: basis @ exp(log_scale) mixing.

    Attributes:
        basis: orthonormal, shape (coordinates, vectors).
        mixing: upper triangular, of size one, shape (vectors, vectors). log_scale: log of what was taken out.
        steps: number of steps after which `stretches` was noted, shape (points,).
        stretches: log of the diagonal of the mixing so far, shape (points, vectors).
    """

    basis: Float[np.ndarray, "coordinates vectors"]
    mixing: Float[np.ndarray, "vectors vectors"]
    log_scale: float
    steps: np.ndarray
    stretches: Float[np.ndarray, "points vectors"]


class Jacobian:
    """The derivative of the state at the last step by that at step 0, decisions held fixed.

    A state is positions and velocities times `clock`, flat.

    Args:
        tape: the run, of a pair potential.
        clock: internal time that turns velocities into lengths.

    Raises:
        InputError: a many-body potential.
    """

    def __init__(self, tape: Tape, clock: float):
        if not isinstance(tape.simulation.force, PairForce):
            raise InputError(
                "the Jacobian of a step is one of pair potentials", where=tape.simulation.system.name
            )
        self.tape, self.clock = tape, clock
        self.force: PairForce = tape.simulation.force
        self.coordinates = 6 * tape.simulation.atoms

    def forward(self, block: Float[np.ndarray, "coordinates vectors"]) -> Image:
        """The image of an orthonormal block."""
        return self._image(block, self.tape.forward(), backward=False)

    def backward(self, block: Float[np.ndarray, "coordinates vectors"]) -> Image:
        """The image under the transpose."""
        return self._image(block, self.tape.backward(), backward=True)

    def _image(self, block, stretches, backward: bool) -> Image:
        vectors, steps = block.shape[1], self.tape.steps
        mixing, log_scale = np.eye(vectors), 0.0
        noted, curve, done = [0], [np.zeros(vectors)], 0
        for stretch in stretches:
            # the last row is a state that no step leaves
            used = min(stretch.rows, steps - stretch.first)
            if used <= 0:
                continue
            block, r = _orthonormal(self._through(stretch, used, block, backward))
            mixing = r @ mixing
            size = float(np.abs(mixing).max())
            if not np.isfinite(size) or size == 0:
                raise FloatingPointError("a tangent is not finite")
            mixing, log_scale, done = mixing / size, log_scale + float(np.log(size)), done + used
            noted.append(done)
            with np.errstate(divide="ignore"):
                curve.append(curve[-1] + np.log(np.abs(np.diag(r))))
        return Image(block, mixing, log_scale, np.array(noted), np.array(curve))

    def _through(self, stretch: Stretch, used: int, block, backward: bool):
        simulation, order = self.tape.simulation, stretch.table.order
        x, v = self._parts(block, backward)
        x, v = _carried(
            self.force,
            simulation.integrator,
            jnp.asarray(simulation.masses[order]),
            simulation.tables(stretch.table),
            (stretch.steps, stretch.x, stretch.v, stretch.bits),
            used,
            (jnp.asarray(x[..., order]), jnp.asarray(v[..., order])),
            backward,
        )
        out = np.empty_like(block)
        weight = 1 / self.clock if backward else self.clock
        for part, values in enumerate((np.asarray(x, np.float64), weight * np.asarray(v, np.float64))):
            unsorted = np.empty_like(values)
            unsorted[..., order] = values
            half = slice(part * len(block) // 2, (part + 1) * len(block) // 2)
            out[half] = unsorted.reshape(len(values), -1).T
        return out

    def _parts(self, block, backward: bool):
        """Positions and velocities of each vector, shape (vectors, 3, atoms)."""
        atoms, dtype = self.tape.simulation.atoms, self.tape.simulation.policy.dtype("state")
        x, v = (part.T.reshape(-1, 3, atoms) for part in np.split(block, 2))
        return x.astype(dtype), ((self.clock if backward else 1 / self.clock) * v).astype(dtype)


def _orthonormal(block):
    """Its QR factors, with a diagonal that is not negative."""
    q, r = np.linalg.qr(block)
    signs = np.where(np.diag(r) < 0, -1.0, 1.0)
    return q * signs, signs[:, None] * r


@partial(jax.jit, static_argnames=("backward",))
def _carried(
    force: PairForce,
    integrator: Integrator,
    masses: Float[Array, "atoms"],
    tables: Tables,
    rows,
    used,
    block: tuple[Float[Array, "vectors 3 atoms"], Float[Array, "vectors 3 atoms"]],
    backward: bool,
):
    dynamics = PairDynamics(force, integrator, masses, tables)
    dtype = block[0].dtype
    half = (0.5 * integrator.timestep).astype(dtype)
    nothing = jnp.zeros((), jnp.float64)

    def push(row, dx, dv):
        number, x, v, told = row

        def step(x, v):
            after = dynamics.step(MdState(number, x, v), told)
            return after.x, after.v

        return jax.jvp(step, (x, v), (dx, dv))[1]

    def pull(row, onto_x, onto_v):
        number, x, v, told = row
        _, back = jax.vjp(lambda x, v: integrator.drift(x, v, masses, number, tables.order)[:2], x, v)
        onto_x, onto_v = back((onto_x, onto_v))
        kicks = half + jnp.where(number == 0, jnp.zeros((), dtype), half)
        w = kicks * onto_v / masses.astype(dtype)
        made = pull_back(force, x, tables, told, w, nothing, nothing)
        return onto_x + made.x, onto_v

    def body(carry, row):
        each = jax.vmap(partial(pull if backward else push, row))
        return each(*carry), jnp.zeros(())

    return over_rows(body, block, rows, used, backward=backward)[0]
