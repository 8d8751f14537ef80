"""The largest singular values of a run's Jacobian: how much a small change of the start can grow.

By subspace iteration with a random block (Halko, Martinsson and Tropp 2011), forward with tangents and back
with cotangents, through the steps at the states and decisions that were recorded. After every stretch the
block is made orthonormal again, so that neither does a length overflow nor do all vectors turn into one.
Every gradient of a loss of the last state is bounded by the largest singular value times the gradient at the
end; the forward run can be bounded all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError, NumericalError
from mdnum.gradients.diagnose.growth import CLOCK_STEPS, WORDS, forward_bounded, log_rate
from mdnum.gradients.forces import pull_back
from mdnum.gradients.problem import Problem, Progress
from mdnum.gradients.recorded import tape_of
from mdnum.gradients.tape import RunTape, TapeStretch, over_rows
from mdnum.md.decide import Tables
from mdnum.md.integrators import Integrator
from mdnum.md.pairforce import MdState, PairDynamics, PairForce

#: Beyond this many e-foldings between vectors, the product of triangles is read off its diagonal.
_RANGE = 30.0


@dataclass(frozen=True)
class Spectrum:
    """How small changes of the start stretch: singular values of the product of all step Jacobians.

    Lengths of changes are those of positions, and of velocities times `clock`.

    Attributes:
        steps: of the run. clock: internal time.
        log_singular: natural logarithm of the largest singular values, largest first.
        residual: |Phi^T u - s v| / s of each with its vectors u and v: how exact it is.
        exponents: finite-time Lyapunov exponents log(s) / T per step; exponents_time: per unit of time of
            the system's file.
        horizon: steps at which the curve below has points.
        curve: log stretch of the k-th direction of an orthonormal frame carried forward: its slopes are
            Lyapunov exponents, largest first.
        transposed: relative defect of <w, Phi v> = <Phi^T w, v>: forward and reverse passes are transposes
            of one another where it is a rounding error.
        word: one of `growth.WORDS`.
    """

    steps: int
    clock: float
    log_singular: Float[np.ndarray, "values"]
    residual: Float[np.ndarray, "values"]
    exponents: Float[np.ndarray, "values"]
    exponents_time: Float[np.ndarray, "values"]
    horizon: Int[np.ndarray, "points"]
    curve: Float[np.ndarray, "points values"]
    transposed: float
    word: str


@dataclass(frozen=True)
class TangentImage:
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

    def __init__(self, tape: RunTape, clock: float):
        if not isinstance(tape.simulation.force, PairForce):
            raise InputError(
                "the Jacobian of a step is one of pair potentials", where=tape.simulation.system.name
            )
        self.tape, self.clock = tape, clock
        self.force: PairForce = tape.simulation.force
        self.coordinates = 6 * tape.simulation.atoms

    def forward(self, block: Float[np.ndarray, "coordinates vectors"]) -> TangentImage:
        """The image of an orthonormal block."""
        return self._image(block, self.tape.forward(), backward=False)

    def backward(self, block: Float[np.ndarray, "coordinates vectors"]) -> TangentImage:
        """The image under the transpose."""
        return self._image(block, self.tape.backward(), backward=True)

    def _image(self, block, stretches, backward: bool) -> TangentImage:
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
        return TangentImage(block, mixing, log_scale, np.array(noted), np.array(curve))

    def _through(self, stretch: TapeStretch, used: int, block, backward: bool):
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


def spectrum(
    problem: Problem,
    *,
    values: int = 3,
    extra: int = 4,
    rounds: int = 4,
    seed: int = 0,
    tape: RunTape | None = None,
    progress: Progress | None = None,
) -> Spectrum:
    """Singular values and finite-time Lyapunov exponents of the product of all step Jacobians.

    Decisions are held fixed: what flips do to a change is not in it.

    Args:
        problem: a rollout of a pair potential; its loss does not matter.
        values: how many singular values.
        extra: vectors that are carried along for faster convergence.
        rounds: forward and backward passes of the block.
        seed: of the random block.
        tape: the run, where it has been made.
        progress: called with the rounds done, all rounds, and a phase in words.

    Raises:
        InputError: no pair potential, or fewer coordinates than values. NumericalError: the run blew up.

    Error: within `residual` of each there is a singular value, relatively; where they are well separated it
        is nearer still.
    """
    simulation = problem.simulation
    if tape is None:
        tape = tape_of(problem, False, progress=progress)
    timestep = float(simulation.integrator.timestep)
    jacobian = Jacobian(tape, CLOCK_STEPS * timestep)
    if not 1 <= values <= jacobian.coordinates or rounds < 1:
        raise InputError(f"{values} singular values of {jacobian.coordinates} coordinates, {rounds} rounds")
    vectors = min(values + extra, jacobian.coordinates)
    rng = np.random.default_rng(seed)
    start, _ = np.linalg.qr(rng.standard_normal((jacobian.coordinates, vectors)))
    defect = float("nan")
    try:
        there = jacobian.forward(start)
        for k in range(rounds):
            back = jacobian.backward(there.basis)
            if k == 0:
                defect = _defect(start, there, back)
            if progress is not None:
                progress(k + 1, rounds, "singular values")
            start = back.basis
            there = jacobian.forward(start)
        log_s, left, right = _svd(there)
        residual = _residual(jacobian, there.basis @ left, start @ right, log_s)
    except FloatingPointError as error:
        raise NumericalError(f"singular values: {error}", remedy="Ask the detective why") from error
    speeds = _speeds(tape)
    per_time = timestep / simulation.units.time_factor
    exponents = log_s[:values] / tape.steps
    steps = np.arange(tape.steps + 1)
    _, _, grows = log_rate(np.interp(steps, there.steps, there.stretches[:, 0]))
    word = WORDS[2] if not forward_bounded(speeds) else WORDS[1] if grows else WORDS[0]
    return Spectrum(
        tape.steps,
        jacobian.clock,
        log_s[:values],
        residual[:values],
        exponents,
        exponents / per_time,
        there.steps,
        there.stretches[:, :values],
        defect,
        word,
    )


def _defect(start, there: TangentImage, back: TangentImage) -> float:
    """Of Q' (Phi q) = (Phi' Q)' q, relative."""
    forward = there.mixing
    factor = np.exp(np.clip(back.log_scale - there.log_scale, -600, 600))
    backward = factor * (back.basis @ back.mixing).T @ start
    return float(np.abs(forward - backward).max() / np.abs(forward).max())


def _svd(image: TangentImage) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log of the singular values of the map on the block, and both sets of vectors in its bases."""
    diagonal = image.stretches[-1]
    if diagonal.max() - diagonal.min() > _RANGE:
        # rounding has eaten the small ones in the product; the block is aligned, so its diagonal has them
        order = np.argsort(-diagonal)
        identity = np.eye(len(diagonal))[:, order]
        return diagonal[order], identity, identity
    left, sizes, right = np.linalg.svd(image.mixing)
    return np.log(sizes) + image.log_scale, left, right.T


def _residual(jacobian: Jacobian, left, right, log_s) -> np.ndarray:
    """|Phi' u - s v| / s of each pair of singular vectors."""
    back = jacobian.backward(left)
    with np.errstate(over="ignore"):
        image = (back.basis @ back.mixing) * np.exp(back.log_scale - log_s)
    return np.linalg.norm(image - right, axis=0)


def _speeds(tape: RunTape) -> np.ndarray:
    """Rms speed at every step."""
    parts = [
        np.sqrt(np.mean(np.sum(stretch.v[: stretch.rows].astype(np.float64) ** 2, axis=1), axis=1))
        for stretch in tape.forward()
    ]
    return np.concatenate(parts)
