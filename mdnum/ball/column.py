"""A column of balls on a floor: many contacts, one linear system, and a solver inside a solver.

Balls of unit mass rest on one another and on a floor through stiff springs that only push. A step is
implicit, the minimum of ½|q - q_free|² + ½ h²k Σ min(0, gap)², found by Newton's method on the active set
(Gauss-Newton: the gaps are linear) with a line search, whose linear system is solved by conjugate
gradients. The matrix products of that inner solve run in a format of their own, as they do on a device that
is left to its defaults; everything else is float32, or float64 for the reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Int8

from mdnum.ball.conjugate import conjugate_gradients
from mdnum.ball.state import Reason
from mdnum.errors import InputError
from mdnum.precision.formats import matmul

Balls = Float[Array, "balls"]

#: Formats of the inner products; the first is that of everything else too.
FORMATS = ("float64", "float32", "tf32", "bfloat16", "float16")
#: A move is too long if the slope at its end is positive and above this share of the slope at its start.
_OVERSHOOT = 0.1
#: Bisections that then find where along the move the slope is zero.
_HALVINGS = 12


class ColumnState(NamedTuple):
    """Heights of the balls above the places they have in a stack that just touches (m), and velocities."""

    q: Balls
    v: Balls


class ColumnRecord(NamedTuple):
    """What a step decided.

    Attributes:
        contact: whether ball i pushes on the one below (ball 0 on the floor) at the end of the step.
        gap: what that decision compared with zero, m.
        outer: Newton iterations.
        inner: conjugate gradient iterations, all together.
        rejected: moves that the line search rejected (and shortened).
        reason: code of `Reason` that ended the outer loop.
        residual: largest |gradient| at its last decision, m.
        recurrence: relative residual that the last inner solve believed it had.
        true: the relative residual that it had, computed in float64.
        inner_reason: code that ended the last inner solve.
    """

    contact: Bool[Array, "balls"]
    gap: Balls
    outer: Int[Array, ""]
    inner: Int[Array, ""]
    rejected: Int[Array, ""]
    reason: Int8[Array, ""]
    residual: Float[Array, ""]
    recurrence: Float[Array, ""]
    true: Float[Array, ""]
    inner_reason: Int8[Array, ""]


class Column(eqx.Module):
    """The column as a program.

    Attributes:
        h: time step, s.
        k: stiffness of a contact per mass, 1/s².
        gravity: m/s².
        tol: the outer loop stops when every component of the gradient is below, m.
        inner_tol: relative residual at which conjugate gradients stop.
        code: place of the format of the inner matrix products in FORMATS; not static, so that all formats
            share one compiled program.
        max_outer, max_inner: caps.
        balls: how many.
    """

    h: Any
    k: Any
    gravity: Any
    tol: Any
    inner_tol: Any
    code: Any
    max_outer: Any
    max_inner: Any
    balls: int = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        balls: int = 64,
        format: str = "float32",
        h: float = 0.01,
        k: float = 1e8,
        gravity: float = 9.81,
        tol: float = 1e-7,
        inner_tol: float = 1e-4,
        max_outer: int = 30,
        max_inner: int = 400,
    ) -> Column:
        """A column with its numbers checked and cast.

        Args:
            balls: how many.
            format: of the inner matrix products, one of FORMATS; with "float64" everything is float64.
            h, k, gravity, tol, inner_tol, max_outer, max_inner: see the class.

        Raises:
            InputError: a number out of range, or no such format.
        """
        if format not in FORMATS:
            raise InputError(f"unknown format {format!r}; known are {', '.join(FORMATS)}")
        if balls < 1:
            raise InputError(f"a column of {balls} balls", remedy="Give 1 or more.")
        numbers = {"h": h, "k": k, "gravity": gravity, "tol": tol, "inner_tol": inner_tol}
        for name, value in numbers.items():
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} = {value}", remedy="Give a positive number.", where="column")
        dtype = np.float64 if format == "float64" else np.float32
        cast = {name: jnp.asarray(value, dtype) for name, value in numbers.items()}
        counts = {"code": FORMATS.index(format), "max_outer": max_outer, "max_inner": max_inner}
        cast |= {name: jnp.asarray(value, jnp.int32) for name, value in counts.items()}
        return cls(**cast, balls=balls)

    @property
    def dtype(self) -> np.dtype:
        """Of everything but the inner products."""
        return np.dtype(self.h.dtype)

    @property
    def format(self) -> str:
        """Name of the format of the inner products."""
        return FORMATS[int(self.code)]

    @property
    def condition(self) -> float:
        """Condition number of the linear system with every contact closed."""
        jacobian = np.eye(self.balls) - np.eye(self.balls, k=-1)
        stiff = float(self.h) ** 2 * float(self.k)
        return float(np.linalg.cond(np.eye(self.balls) + stiff * jacobian.T @ jacobian))

    def start(self, q: Any, v: Any = 0.0) -> ColumnState:
        """The state at step 0: heights above the touching stack, m, and velocities, m/s."""
        q = jnp.broadcast_to(jnp.asarray(q, self.dtype), (self.balls,))
        return ColumnState(q, jnp.broadcast_to(jnp.asarray(v, self.dtype), (self.balls,)))

    def gaps(self, q: Balls) -> Balls:
        """Distance of each ball to the one below, m; negative where they push."""
        return q - jnp.concatenate([jnp.zeros(1, q.dtype), q[:-1]])

    def _product(self, active: Balls, multiply, dtype):
        """v -> (I + h²k Jᵀ A J) v with a way to multiply matrices."""
        jacobian = jnp.eye(self.balls, dtype=dtype) - jnp.eye(self.balls, k=-1, dtype=dtype)
        stiff = (self.h * self.h * self.k).astype(dtype)

        def product(p):
            push = active.astype(dtype) * multiply(jacobian, p[:, None])[:, 0]
            return p + stiff * multiply(jacobian.T, push[:, None])[:, 0]

        return product

    def _multiply(self, a, b):
        """A matrix product in the column's format."""
        if self.dtype == np.float64:
            return a @ b
        return lax.switch(self.code - 1, [partial(matmul, name=name) for name in FORMATS[1:]], a, b)

    def advance(self, state: ColumnState) -> tuple[ColumnState, ColumnRecord]:
        """One step: the next state, and what was decided on the way."""
        stiff = self.h * self.h * self.k
        free = state.q + self.h * state.v - self.h * self.h * self.gravity

        def slope(q):
            gap = self.gaps(q)
            push = jnp.minimum(gap, 0.0)
            above = jnp.concatenate([push[1:], jnp.zeros(1, q.dtype)])
            return (q - free) + stiff * (push - above), (gap < 0).astype(q.dtype)

        def search(q, direction, before):
            """The whole move unless it overshoots; then the part of it that ends where the slope is zero."""

            def along(share):
                return jnp.dot(slope(q + share * direction)[0], direction)

            one = jnp.ones((), q.dtype)
            rejected = along(one) > _OVERSHOOT * before

            def halve(_, ends):
                low, high = ends
                middle = (low + high) / 2
                beyond = along(middle) > 0
                return jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)

            shorter = lax.cond(
                rejected, lambda: lax.fori_loop(0, _HALVINGS, halve, (one * 0, one))[1], lambda: one
            )
            return shorter, rejected.astype(jnp.int32)

        def body(carry):
            q, gradient, active, outer, inner, halved, *_ = carry
            solved = conjugate_gradients(
                self._product(active, self._multiply, self.dtype), -gradient, self.inner_tol, self.max_inner
            )
            share, tried = search(q, solved.x, jnp.abs(jnp.dot(gradient, solved.x)))
            q = q + share * solved.x
            exact = self._product(active, jnp.matmul, jnp.float64)(solved.x.astype(jnp.float64))
            b = -gradient.astype(jnp.float64)
            true = jnp.linalg.norm(b - exact) / jnp.linalg.norm(b)
            gradient, active = slope(q)
            return (
                q,
                gradient,
                active,
                outer + 1,
                inner + solved.iterations,
                halved + tried,
                solved.residual,
                true.astype(q.dtype),
                solved.reason,
            )

        def residual(carry):
            return jnp.max(jnp.abs(carry[1]))

        nothing, zero = jnp.full((), jnp.nan, self.dtype), jnp.zeros((), jnp.int32)
        none = jnp.asarray(Reason.NONE.value, jnp.int8)
        start = (free, *slope(free), zero, zero, zero, nothing, nothing, none)
        ended = lax.while_loop(
            lambda carry: (residual(carry) >= self.tol) & (carry[3] < self.max_outer), body, start
        )
        q, _, active, outer, inner, halved, recurrence, true, why = ended
        last = residual(ended)
        reason = jnp.where(last >= self.tol, Reason.CAP.value, Reason.TOLERANCE.value)
        reason = jnp.where(jnp.isfinite(last), reason, Reason.NOT_FINITE.value).astype(jnp.int8)
        record = ColumnRecord(
            active > 0, self.gaps(q), outer, inner, halved, reason, last, recurrence, true, why
        )
        return ColumnState(q, (q - state.q) / jnp.broadcast_to(self.h, q.shape)), record


@dataclass(frozen=True)
class ColumnRun:
    """A finished rollout.

    Attributes:
        column: the program.
        q, v: shape (steps + 1, balls).
        record: of every step, leading axis steps.
    """

    column: Column
    q: Float[np.ndarray, "rows balls"]
    v: Float[np.ndarray, "rows balls"]
    record: ColumnRecord

    @property
    def steps(self) -> int:
        """How many were made."""
        return len(self.q) - 1

    def first_difference(self, other: ColumnRun) -> tuple[int, int, float, float] | None:
        """First step (from 1) and ball whose contact differs, with both gaps; None where none does."""
        differ = np.asarray(self.record.contact) != np.asarray(other.record.contact)
        if not differ.any():
            return None
        step, ball = (int(k) for k in np.argwhere(differ)[0])
        first, second = (float(np.asarray(run.record.gap)[step, ball]) for run in (self, other))
        return step + 1, ball, first, second

    def ended(self) -> dict[str, int]:
        """How many outer loops ended for which reason."""
        codes, counts = np.unique(np.asarray(self.record.reason), return_counts=True)
        return {Reason(code).word: int(n) for code, n in zip(codes, counts, strict=True)}


@eqx.filter_jit
def _roll(column: Column, start: ColumnState, steps: int):
    def step(state, _):
        state, record = column.advance(state)
        return state, (state, record)

    return lax.scan(step, start, length=steps)[1]


def simulate_column(column: Column, start: ColumnState, steps: int) -> ColumnRun:
    """Advance a column and record every decision of both solvers."""
    states, record = jax.tree.map(np.asarray, _roll(column, start, steps))
    rows = [
        np.concatenate([np.asarray(first)[None], rest]) for first, rest in zip(start, states, strict=True)
    ]
    return ColumnRun(column, rows[0], rows[1], record)


def in_format(column: Column, format: str) -> Column:
    """The same column with its inner products in another format."""
    numbers = ("h", "k", "gravity", "tol", "inner_tol")
    given = {name: float(getattr(column, name)) for name in numbers}
    caps = {name: int(getattr(column, name)) for name in ("max_outer", "max_inner")}
    return Column.create(column.balls, format, **given, **caps)
