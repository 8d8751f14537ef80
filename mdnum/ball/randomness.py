"""Randomness: noise that belongs to a step and a ball, and what a seed and an order of summation share.

A stochastic rollout is a program too, given its key. Two things follow. A difference of two rollouts with the
same noise says more about a parameter than one of two with fresh noise. And near a threshold another key and
another order of summation are alike: either can flip the same decision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mdnum.ball.gradients.base import moved_loss, origin, start_of
from mdnum.ball.problem import START, Problem
from mdnum.ball.rollout import BallRun
from mdnum.errors import InputError


def noise(key: Any, steps: int, balls: int) -> Float[Array, "steps balls"]:
    """Independent standard normal numbers, each keyed by its step and its ball.

    A ball keeps its noise when others are added or when the batch is longer, and a step when the rollout is.

    Args:
        key: from `jax.random.key`.
        steps, balls: how many.
    """

    def of_step(step):
        here = jax.random.fold_in(key, step)
        return jax.vmap(lambda ball: jax.random.normal(jax.random.fold_in(here, ball), (), jnp.float64))(
            jnp.arange(balls)
        )

    return jax.vmap(of_step)(jnp.arange(steps))


def shaken(problem: Problem, seed: int, strength: float) -> Problem:
    """The problem with a random acceleration added to its control.

    Args:
        seed: of the key.
        strength: standard deviation of the velocity that noise adds in one second, m/s^(3/2); a step of h
            seconds gets strength / sqrt(h) of acceleration.

    Raises:
        InputError: strength is negative or not finite.
    """
    if not (np.isfinite(strength) and strength >= 0):
        raise InputError(
            f"strength is {strength}", remedy="Give a number that is 0 or more.", where="strength"
        )
    made = _controls(problem, jax.random.key(seed)[None], strength)[0]
    return replace(problem, world=replace(problem.world, control=made))


def _controls(problem: Problem, keys: Any, strength: float) -> Float[Array, "keys steps balls"]:
    """The problem's control with the noise of each key."""
    world = problem.world
    dtype = world.policy.dtype("arithmetic")
    balls = start_of(problem)[0].shape[0]
    scale = strength / np.sqrt(float(world.integrator.h))
    made = scale * jax.vmap(lambda key: noise(key, problem.steps, balls))(keys)
    if world.control is not None:
        base = jnp.asarray(world.control).astype(jnp.float64)
        # a control that ends before the run does stays at its last value
        base = base[jnp.minimum(jnp.arange(problem.steps), base.shape[0] - 1)]
        made = made + (base[:, None] if base.ndim == 1 else base)
    return made.astype(dtype)


@dataclass(frozen=True)
class Estimate:
    """A mean over samples.

    Attributes:
        mean: the estimate.
        error: its standard error.
        deviation: standard deviation of one sample.
    """

    mean: float
    error: float
    deviation: float

    @classmethod
    def of(cls, samples: Float[np.ndarray, "samples"]) -> Estimate:
        """From independent samples."""
        deviation = float(np.std(samples, ddof=1))
        return cls(float(np.mean(samples)), deviation / float(np.sqrt(len(samples))), deviation)


@dataclass(frozen=True)
class NoisyGradient:
    """The derivative of a mean loss, estimated in three ways.

    Attributes:
        common: central differences, both sides with the same noise.
        fresh: central differences, each side with its own.
        pathwise: reverse mode with the noise held; blind to contacts that move.
        ratio: variance of a fresh sample over that of a common one; infinite where noise drops out.
        width: half the distance of the two sides.
    """

    common: Estimate
    fresh: Estimate
    pathwise: Estimate
    ratio: float
    width: float


def noisy_gradient(
    problem: Problem, name: str, strength: float, *, width: float = 1e-2, samples: int = 256, seed: int = 0
) -> NoisyGradient:
    """The derivative of the expected loss by one parameter, with common and with fresh random numbers.

    Args:
        name: the parameter; y0 and v0 move the whole batch.
        strength: as in `shaken`.
        width: half the distance of the two sides, in the unit of the parameter.
        samples: pairs of rollouts for each estimate.

    Raises:
        InputError: width or samples out of range.

    Error: the standard errors, and a bias of order width² where the expected loss is smooth.

    Source: Glasserman and Yao (1992) on common random numbers.
    """
    if not width > 0 or samples < 2:
        raise InputError(
            f"width is {width} and samples {samples}",
            remedy="Choose a width above 0 and at least 2 samples.",
        )
    keys = jax.random.split(jax.random.key(seed), 2 * samples)
    controls = _controls(problem, keys, strength)
    at, start = origin(problem, [name]), start_of(problem)

    def losses(shift: float, controls: Array) -> tuple[np.ndarray, np.ndarray]:
        values = {name: at[name] + jnp.asarray(shift, at[name].dtype)}
        value, slope = _many(values, problem.world, *start, controls, problem.steps, problem.loss)
        return np.asarray(value, np.float64), np.asarray(slope[name], np.float64)

    up, _ = losses(width, controls)
    down, _ = losses(-width, controls)
    _, slopes = losses(0.0, controls[:samples])
    common = (up[:samples] - down[:samples]) / (2 * width)
    fresh = (up[:samples] - down[samples:]) / (2 * width)
    least = float(np.var(common, ddof=1))
    ratio = float(np.var(fresh, ddof=1)) / least if least > 0 else float("inf")
    return NoisyGradient(Estimate.of(common), Estimate.of(fresh), Estimate.of(slopes), ratio, width)


@eqx.filter_jit
def _many(values, world, y0, v0, controls, steps, loss):
    def one(control):
        given = replace(world, control=control)
        return jax.value_and_grad(lambda at: moved_loss(at, given, y0, v0, None, steps, loss))(values)

    return jax.vmap(one)(controls)


def reordered(problem: Problem, seed: int | None) -> tuple[Problem, Int[np.ndarray, "balls"]]:
    """The same balls in another order, so that sums over the batch are made in another order.

    Args:
        seed: of the permutation; None for the order as it is.

    Returns:
        the problem, and which ball stands at each place.
    """
    y, v = (np.asarray(part) for part in start_of(problem))
    balls = y.shape[0]
    order = np.arange(balls) if seed is None else np.random.default_rng(seed).permutation(balls)
    control = problem.world.control
    if control is not None and control.ndim == 2:
        control = control[:, order]
    world = replace(problem.world, control=control)
    moved = {START[0]: y[order], START[1]: v[order] if v.ndim else v}
    return replace(problem, world=world, **moved), order


@dataclass(frozen=True)
class Flip:
    """The first decision that differs from those of another rollout.

    Attributes:
        step: from 1; None where none differs.
        channel: "contact", "stop", or "" for none.
        counts: iterations there in the two rollouts, over all balls.
    """

    step: int | None
    channel: str
    counts: tuple[int, int]


def decisions(problem: Problem, order: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Contact decisions and iteration counts of a rollout of the reordered problem, in the original order.

    Args:
        order: seed of the permutation, or None.
    """
    moved, places = reordered(problem, order)
    run: BallRun = moved.run(keep=False)
    back = np.argsort(places)
    counts = run.iterations[:, back] if run.iterations.ndim == 2 else run.iterations
    return run.contact[:, back], counts


def first_flip(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> Flip:
    """The first decision in which two results of `decisions` differ."""
    contact = np.any(a[0] != b[0], axis=1)
    stop = np.any((a[1] != b[1]).reshape(len(a[1]), -1), axis=1)
    rows = np.flatnonzero(np.logical_or(contact, stop))
    if not len(rows):
        return Flip(None, "", (0, 0))
    row = int(rows[0])
    counts = int(np.sum(a[1][row])), int(np.sum(b[1][row]))
    return Flip(row + 1, "contact" if contact[row] else "stop", counts)


def two_by_two(
    problem: Problem, strength: float, *, keys: tuple[int, int] = (0, 1), order: int = 1
) -> dict[tuple[str, str], Flip]:
    """First flips of rollouts with the same or another key and the same or another order of summation.

    Args:
        strength: as in `shaken`.
        keys: of the first and of the other noise.
        order: seed of the other order.

    Returns:
        by ("same key" or "other key", "same order" or "other order"); all against the first of each.
    """
    table = first_flips(problem, strength, keys, (None, order))
    names = ("same key", "other key"), ("same order", "other order")
    return {
        (key, summed): table[row][column]
        for row, key in enumerate(names[0])
        for column, summed in enumerate(names[1])
    }


def first_flips(
    problem: Problem, strength: float, keys: Sequence[int], orders: Sequence[int | None]
) -> list[list[Flip]]:
    """First flips against the first key in the first order, for every key (rows) and order (columns)."""
    posed = [shaken(problem, key, strength) for key in keys]
    made = [[decisions(one, order) for order in orders] for one in posed]
    return [[first_flip(made[0][0], cell) for cell in row] for row in made]


def shares(steps: Float[np.ndarray, "keys orders"]) -> dict[str, float]:
    """How much of the variance of a table is between keys, between orders, and neither alone.

    Args:
        steps: a number for each key and order, such as the step of the first flip.

    Returns:
        shares of the sum of squares by "key", "order" and "both"; all 0 for a constant table.

    Source: two-way analysis of variance without replication.
    """
    middle = steps.mean()
    rows, columns = steps.mean(axis=1) - middle, steps.mean(axis=0) - middle
    total = float(np.sum((steps - middle) ** 2))
    if total == 0:
        return {"key": 0.0, "order": 0.0, "both": 0.0}
    key = float(steps.shape[1] * np.sum(rows**2)) / total
    order = float(steps.shape[0] * np.sum(columns**2)) / total
    return {"key": key, "order": order, "both": 1.0 - key - order}
