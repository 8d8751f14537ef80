"""The largest singular values of a run's Jacobian: how much a small change of the start can grow.

By subspace iteration with a random block (Halko, Martinsson and Tropp 2011), forward with tangents and back
with cotangents. Every gradient of a loss of the last state is bounded by the largest of them times the
gradient at the end; the forward run can be bounded all the same.
"""

from __future__ import annotations

import numpy as np

from mdnum.errors import InputError, NumericalError
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.diagnose.growth import CLOCK_STEPS, WORDS, forward_bounded, log_rate
from mdnum.gradients.diagnose.jacobian import Image, Jacobian
from mdnum.gradients.diagnose.results import Spectrum
from mdnum.gradients.symmetric import in_phase
from mdnum.gradients.tape import Tape

#: Beyond so many powers of e between vectors, the product of triangles is read off its diagonal.
_RANGE = 30.0


def spectrum(
    problem: Problem,
    *,
    values: int = 3,
    extra: int = 4,
    rounds: int = 4,
    seed: int = 0,
    budget: int = 2**29,
    tape: Tape | None = None,
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
        budget: bytes of the recorded run that are kept.
        tape: the run, where it has been made.
        progress: called with the rounds done, all rounds, and a phase in words.

    Raises:
        InputError: no pair potential, or fewer coordinates than values. NumericalError: the run blew up.

    Error: within `residual` of each there is a singular value, relatively; where they are well apart it is
        nearer still.
    """
    simulation = problem.simulation
    if tape is None:
        tape = Tape(
            simulation, problem.loss, problem.steps, budget=budget, progress=in_phase(progress, "run")
        )
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
    unit = simulation.units.time
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
        f"A change of the start can grow by a factor of {_power(log_s[0])} in {tape.steps} steps, "
        f"{exponents[0] / per_time:.3g} per {unit} ({word}).",
    )


def _power(log: float) -> str:
    return f"{np.exp(log):.3g}" if log < 600 else f"10^{log / np.log(10):.4g}"


def _defect(start, there: Image, back: Image) -> float:
    """Of Q' (Phi q) = (Phi' Q)' q, relative."""
    forward = there.mixing
    factor = np.exp(np.clip(back.log_scale - there.log_scale, -600, 600))
    backward = factor * (back.basis @ back.mixing).T @ start
    return float(np.abs(forward - backward).max() / np.abs(forward).max())


def _svd(image: Image) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def _speeds(tape: Tape) -> np.ndarray:
    """Rms speed at every step."""
    parts = [
        np.sqrt(np.mean(np.sum(stretch.v[: stretch.rows].astype(np.float64) ** 2, axis=1), axis=1))
        for stretch in tape.forward()
    ]
    return np.concatenate(parts)
