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
from mdnum.gradients import parameters
from mdnum.gradients.losses import Loss
from mdnum.gradients.parameters import ParameterEntry, columns_of
from mdnum.gradients.problem import Problem, Progress, in_phase
from mdnum.gradients.recorded import GUARD, radial_speed
from mdnum.gradients.tangents import StretchTangents, tangents
from mdnum.gradients.tape import RunTape, TapeStretch
from mdnum.numerics import Ledger

#: The parameter by which derivatives at half the time step are twice as large.
TIMESTEP = "dynamics.timestep"


class Shorter(Loss):
    """One loss for several runs that are the first steps of one run: its sums have an axis of horizons.

    Attributes:
        inner: the loss.
        table: whether the loss of a run of each horizon looks at each step.
    """

    name = "shorter"
    inner: Loss = eqx.field(kw_only=True)
    table: Bool[Array, "rows horizons"] = eqx.field(kw_only=True)

    def looks_at(self, steps, last):
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
        return self.of(total, self.table.shape[1] - 1)

    def of(self, total: Any, k: int) -> Float[Array, ""]:
        """The loss of one horizon."""
        frames = int(np.asarray(self.table)[:, k].sum())
        return self.inner.value(jax.tree.map(lambda leaf: leaf[k], total), frames)


class Halved(Loss):
    """A loss of a run at half the time step: it looks at the same times, every other step."""

    name = "halved"
    inner: Loss = eqx.field(kw_only=True)

    def looks_at(self, steps, last):
        return (steps % 2 == 0) & self.inner.looks_at(steps // 2, last // 2)

    def observe(self, frame, origin, around):
        return self.inner.observe(
            frame._replace(step=frame.step // 2), origin, around._replace(timestep=2 * around.timestep)
        )

    def value(self, total, frames):
        return self.inner.value(total, frames)

    def reason_unavailable(self, around):
        return self.inner.reason_unavailable(around)


def halved(problem: Problem) -> Problem:
    """The same loss over the same time, in twice the steps of half the length."""
    timestep = parameters.value(problem.simulation, TIMESTEP) / 2
    simulation = parameters.with_values(problem.simulation, {TIMESTEP: timestep})
    return Problem(simulation, Halved(inner=problem.loss), 2 * problem.steps)


@dataclass(frozen=True)
class Horizons:
    """Losses and gradients of runs of several lengths.

    Attributes:
        at: horizons, steps.
        columns: the numbers that are differentiated by.
        value: the loss, by horizon. gradient: by horizon and column.
        ledgers: flips of the run, in the order of their steps.
    """

    at: Int[np.ndarray, "points"]
    columns: tuple[ParameterEntry, ...]
    value: Float[np.ndarray, "points"]
    gradient: Float[np.ndarray, "points columns"]
    ledgers: tuple[Ledger, ...]

    def by_name(self) -> dict[str, Float[np.ndarray, "points entries"]]:
        """The gradient by parameter."""
        names = [column.name for column in self.columns]
        return {
            name: self.gradient[:, [k for k, one in enumerate(names) if one == name]]
            for name in dict.fromkeys(names)
        }


def spread(problem: Problem, points: int) -> Int[np.ndarray, "points"]:
    """Horizons at which the loss of a run this long looks at something, evenly spread, T the last."""
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
    each: Callable[[TapeStretch], None] | None = None,
    watch: Callable[[StretchTangents], None] | None = None,
    progress: Progress | None = None,
) -> Horizons:
    """The gradient of the loss of every shorter run from the same start.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: full names of the parameters; each of their entries is a tangent.
        at: horizons, rising; the last one is how far it is run.
        saltation: whether flips count.
        guard: as a share of the rms radial speed of a pair.
        each: called with every stretch when it has been made.
        watch: called with the tangents of every stretch, those of each step among them.
        progress: called with the steps done, all steps, and the name of the phase.

    Raises:
        InputError: no pair potential. NumericalError: the run blew up.

    Error: that of tangents: a rounding error times their growth.
    """
    simulation, last = problem.simulation, int(at[-1])
    rows = np.arange(last + 1)
    table = np.stack([problem.loss.looks_at(rows, int(h)) & (rows <= h) for h in at], axis=1)
    loss = Shorter(inner=problem.loss, table=jnp.asarray(table))
    tape = RunTape(simulation, loss, last, flips=True, each=each, progress=in_phase(progress, "run"))
    total: Any = None
    ledgers = []
    for part in tangents(
        tape, names, saltation=saltation, guard=guard * radial_speed(simulation), states=watch is not None,
        progress=in_phase(progress, "tangents"),
    ):  # fmt: skip
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
    columns = columns_of(simulation, names)
    return Horizons(at, columns, np.array(values), np.stack(slopes), tuple(ledgers))


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
