"""The gradient for every horizon at once: the loss of each shorter run, from one run and one tangent pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mdnum.errors import InputError
from mdnum.events import Ledger
from mdnum.gradients import parameters
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.directions import Column, columns_of
from mdnum.gradients.losses import Loss
from mdnum.gradients.symmetric import GUARD, in_phase, radial_speed
from mdnum.gradients.tangents import Tangents, tangents
from mdnum.gradients.tape import Stretch, Tape

#: The parameter by which derivatives at half the time step are twice as large.
TIMESTEP = "dynamics.timestep"


class Shorter(Loss):
    """One loss for several runs that are the first steps of one run: its sums have an axis of horizons.

    Attributes:
        inner: the loss.
        table: whether the loss of a run of each horizon looks at each step, shape (steps + 1, horizons).
    """

    name = "shorter"
    inner: Loss = eqx.field(kw_only=True)
    table: Bool[Array, "rows horizons"] = eqx.field(kw_only=True)

    def looks_at(self, steps, last):
        """Where any of the horizons does."""
        return np.asarray(self.table).max(axis=1)[np.minimum(steps, len(self.table) - 1)]

    def observe(self, frame, origin, around):
        seen = self.inner.observe(frame, origin, around)
        wanted = jnp.asarray(self.table)[frame.step]

        def spread(leaf):
            leaf = jnp.asarray(leaf)
            where = wanted.reshape(-1, *(1,) * leaf.ndim)
            return jnp.where(where, leaf[None], jnp.zeros((), leaf.dtype))

        return jax.tree.map(spread, seen)

    def value(self, total, frames):
        """That of the longest."""
        return self.of(total, len(self.counts) - 1)

    @property
    def counts(self) -> list[int]:
        """Frames of each horizon."""
        return np.asarray(self.table).sum(axis=0).tolist()

    def of(self, total: Any, k: int) -> Float[Array, ""]:
        """The loss of one horizon."""
        return self.inner.value(jax.tree.map(lambda leaf: leaf[k], total), self.counts[k])


class Halved(Loss):
    """A loss of a run at half the time step: it looks at the same times, every other step."""

    name = "halved"
    inner: Loss = eqx.field(kw_only=True)

    def looks_at(self, steps, last):
        """Where the loss does, in steps of twice the length."""
        return (steps % 2 == 0) & self.inner.looks_at(steps // 2, last // 2)

    def observe(self, frame, origin, around):
        return self.inner.observe(
            frame._replace(step=frame.step // 2), origin, around._replace(timestep=2 * around.timestep)
        )

    def value(self, total, frames):
        """That of the loss."""
        return self.inner.value(total, frames)

    def why_not(self, around):
        """Where the loss has none."""
        return self.inner.why_not(around)


def halved(problem: Problem) -> Problem:
    """The same loss over the same time, in twice as many steps of half the length."""
    timestep = parameters.value(problem.simulation, TIMESTEP) / 2
    simulation = parameters.with_values(problem.simulation, {TIMESTEP: timestep})
    return Problem(simulation, Halved(inner=problem.loss), 2 * problem.steps)


@dataclass(frozen=True)
class Horizons:
    """Losses and gradients of runs of several lengths.

    Attributes:
        at: horizons, steps, shape (points,).
        columns: the numbers that are differentiated by.
        value: the loss, shape (points,). gradient: shape (points, columns).
        ledger: flips of the run, in the order of their steps.
    """

    at: Int[np.ndarray, "points"]
    columns: tuple[Column, ...]
    value: Float[np.ndarray, "points"]
    gradient: Float[np.ndarray, "points columns"]
    ledgers: tuple[Ledger, ...]

    def by_name(self) -> dict[str, Float[np.ndarray, "points entries"]]:
        """The gradient by parameter."""
        out: dict[str, list[int]] = {}
        for k, column in enumerate(self.columns):
            out.setdefault(column.name, []).append(k)
        return {name: self.gradient[:, places] for name, places in out.items()}


def spread(problem: Problem, points: int) -> Int[np.ndarray, "points"]:
    """Horizons at which the loss of a run so long looks at something, evenly spread, T the last."""
    steps = np.unique(np.round(np.linspace(0, problem.steps, points + 1)).astype(np.int64))[1:]

    def looks(h: int) -> bool:
        try:
            return bool(problem.loss.looks_at(np.arange(h + 1), h).any())
        except InputError:
            # a slope or an integral that needs a longer run
            return False

    return np.array([h for h in steps if looks(int(h))], np.int64)


def horizons(
    problem: Problem,
    names: Sequence[str],
    at: Int[np.ndarray, "points"],
    *,
    saltation: bool = True,
    guard: float = GUARD,
    budget: int = 2**29,
    each: Callable[[Stretch], None] | None = None,
    watch: Callable[[Tangents], None] | None = None,
    progress: Progress | None = None,
) -> Horizons:
    """The gradient of the loss of every shorter run from the same start.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: full names of the parameters; each of their entries is a tangent.
        at: horizons, rising; the last one is how far it is run.
        saltation: whether flips count.
        guard: as a share of the rms radial speed of a pair.
        budget: bytes of the recorded run that are kept.
        each: called with every stretch when it has been made.
        watch: called with the tangents of every stretch, those of each step among them.
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no pair potential. NumericalError: the run blew up.

    Error: that of tangents: a rounding error times their growth.
    """
    simulation, last = problem.simulation, int(at[-1])
    rows = np.arange(last + 1)
    table = np.stack([problem.loss.looks_at(rows, int(h)) & (rows <= h) for h in at], axis=1)
    loss = Shorter(inner=problem.loss, table=jnp.asarray(table))
    tape = Tape(
        simulation, loss, last, flips=True, budget=budget, each=each, progress=in_phase(progress, "run")
    )
    speed = guard * radial_speed(simulation)
    total: Any = None
    ledgers = []
    for part in tangents(
        tape,
        names,
        saltation=saltation,
        guard=speed,
        states=watch is not None,
        progress=in_phase(progress, "tangents"),
    ):
        total = part.total
        if watch is not None:
            watch(part)
        assert part.stretch.ledger is not None
        ledgers.append(part.stretch.ledger)
    values, slopes = [], []
    for k in range(len(at)):
        value, push = jax.linearize(lambda total, k=k: loss.of(total, k), tape.total)
        values.append(float(value))
        slopes.append(np.asarray(jax.vmap(push)(total), np.float64))
    return Horizons(
        at,
        columns_of(simulation, names),
        np.array(values),
        np.stack(slopes),
        tuple(ledgers),
    )


def first_difference(a: Horizons, b: Horizons) -> int | None:
    """The first step at which two runs flip differently; None where they do not."""

    def rows(one: Horizons) -> np.ndarray:
        parts = [np.column_stack([led.step, led.subject, led.entered]) for led in one.ledgers]
        return np.concatenate(parts).astype(np.int64) if parts else np.zeros((0, 4), np.int64)

    first, second = rows(a), rows(b)
    common = min(len(first), len(second))
    differ = np.flatnonzero((first[:common] != second[:common]).any(axis=1))
    if len(differ):
        return int(min(first[differ[0], 0], second[differ[0], 0]))
    if len(first) == len(second):
        return None
    return int((first if len(first) > common else second)[common, 0])
