"""A solver with ten-bit matrix products that reports convergence although it has not converged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Int8

from mdnum.ball.stopping import Reason
from mdnum.errors import InputError
from mdnum.numerics.formats import format_of, round_to
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

Vector = Float[Array, "n"]


def matmul(
    a: Float[Array, "... m k"], b: Float[Array, "... k n"], name: str = "float32"
) -> Float[Array, "... m n"]:
    """Emulate a device's matrix product: inputs in one format, products and sums in a wider one.

    With "float64" and "float32", everything is in this type. With "tf32", "bfloat16" and "float16", the
    inputs are rounded to the format, products are exact, and sums are in float32. The result has the dtype of
    the first matrix.

    Error: at most (2u + gamma_k) |a| |b| with the format's u and float32's gamma. The sums use the order of
    the CPU's own product, which differs from that of a device.
    """
    format_of(name)
    if name == "float64":
        return jnp.matmul(a.astype(jnp.float64), b.astype(jnp.float64)).astype(a.dtype)
    a32, b32 = (round_to(q, name).astype(jnp.float32) for q in (a, b))
    return jnp.matmul(a32, b32, precision=lax.Precision.HIGHEST).astype(a.dtype)


class Solution(NamedTuple):
    """Result of a conjugate gradient solve.

    Attributes:
        x: the solution.
        iterations: number of matrix products.
        residual: residual of the recurrence, relative to the right-hand side.
        reason: a code of `Reason`: tolerance, iteration limit or not finite.
        history: residual of the recurrence at every stopping decision, shape (max_iter + 1,), NaN after the
            last; shape (0,) if not requested.
        true_history: |b - A x| / |b|, computed with `true_product`, at every stopping decision.
    """

    x: Vector
    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    reason: Int8[Array, ""]
    history: Float[Array, "decisions"]
    true_history: Float[Array, "decisions"]


def conjugate_gradients(
    product: Callable[[Vector], Vector],
    b: Vector,
    tol: Any,
    max_iter: Any,
    *,
    true_product: Callable[[Vector], Vector] | None = None,
) -> Solution:
    """Solve A x = b for a symmetric positive definite A, starting from zero.

    The solver is not differentiable in reverse mode, because the number of iterations is determined at run
    time.

    Args:
        product: function v -> A v, in the arithmetic under study.
        b: right-hand side; its dtype is used for all vectors and dot products.
        tol: stop when the residual of the recurrence is below tol * |b|.
        max_iter: largest number of iterations; it may be traced if no histories are stored.
        true_product: function v -> A v in a wider dtype, with which the true residual is measured; without it
            no histories are stored.

    Source: Hestenes & Stiefel, J. Res. NBS 49, 409 (1952).
    """
    size2 = jnp.dot(b, b)
    limit2 = jnp.asarray(tol).astype(b.dtype) ** 2 * size2
    safe = jnp.where(size2 > 0, size2, 1)
    length = max_iter + 1 if true_product is not None else 0

    def relative(rr):
        return jnp.sqrt(rr / safe)

    def true_residual(x):
        assert true_product is not None
        wide = true_product(x)
        gap = b.astype(wide.dtype) - wide
        return jnp.sqrt(jnp.dot(gap, gap) / safe.astype(wide.dtype)).astype(b.dtype)

    def note(kept, i, x, rr):
        if not length:
            return kept
        return kept[0].at[i].set(relative(rr)), kept[1].at[i].set(true_residual(x))

    def body(carry):
        x, r, p, rr, i, kept = carry
        q = product(p)
        step = rr / jnp.dot(p, q)
        x, r = x + step * p, r - step * q
        new = jnp.dot(r, r)
        return x, r, r + (new / rr) * p, new, i + 1, note(kept, i + 1, x, new)

    blank = jnp.full(length, jnp.nan, b.dtype)
    zero = jnp.zeros_like(b)
    start = (zero, b, b, size2, jnp.zeros((), jnp.int32), note((blank, blank), 0, zero, size2))
    # the loop also ends at a NaN, which is not above anything
    x, _, _, rr, iterations, kept = lax.while_loop(
        lambda carry: (carry[3] > limit2) & (carry[4] < max_iter), body, start
    )
    reason = jnp.where(rr > limit2, Reason.CAP.value, Reason.TOLERANCE.value)
    finite = jnp.isfinite(rr) & jnp.all(jnp.isfinite(x))
    reason = jnp.where(finite, reason, Reason.NOT_FINITE.value).astype(jnp.int8)
    return Solution(x, iterations, relative(rr), reason, kept[0], kept[1])


Balls = Float[Array, "balls"]

#: Formats of the inner products; the first is that of everything else too.
FORMATS = ("float64", "float32", "tf32", "bfloat16", "float16")
#: A move is too long if the slope at its end is positive and above this share of the slope at its start.
_OVERSHOOT = 0.1
#: Bisections that then find where along the move the slope is zero.
_HALVINGS = 12


class ColumnState(NamedTuple):
    """Heights of the balls relative to their places in a just touching stack (m), and velocities."""

    q: Balls
    v: Balls


class ColumnRecord(NamedTuple):
    """Decisions of one step.

    Attributes:
        contact: whether ball i pushes on the ball below (ball 0 on the floor) at the end of the step.
        gap: distance that the contact decision compares with zero, m.
        outer: number of Newton iterations.
        inner: total number of conjugate gradient iterations.
        rejected: number of moves that the line search rejected (and shortened).
        reason: code of the `Reason` for the end of the outer loop.
        residual: largest |gradient| at the last decision of the outer loop, m.
        recurrence: relative residual of the last inner solve according to its recurrence.
        true: true relative residual of the last inner solve, computed in float64.
        inner_reason: code of the reason for the end of the last inner solve.
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
    """Parameters of the simulation of a falling column of balls.

    Attributes:
        h: time step, s.
        k: stiffness of a contact per mass, 1/s².
        gravity: m/s².
        tol: the outer loop stops when every component of the gradient is below this value, m.
        inner_tol: relative residual at which conjugate gradients stop.
        code: index of the format of the inner matrix products in FORMATS; not static, so that all formats
            share one compiled program.
        max_outer, max_inner: largest numbers of iterations.
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
        """Create a column, with its parameters checked and converted.

        Args:
            balls: how many.
            format: format of the inner matrix products, one of FORMATS; with "float64" all numbers are
            float64.
            h, k, gravity, tol, inner_tol, max_outer, max_inner: see the class.

        Raises:
            InputError: a number is out of range, or the format is unknown.
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
        """Dtype of all numbers except the inner matrix products."""
        return np.dtype(self.h.dtype)

    @property
    def format(self) -> str:
        """Name of the format of the inner matrix products."""
        return FORMATS[int(self.code)]

    @property
    def condition(self) -> float:
        """Condition number of the linear system if all contacts are closed."""
        jacobian = np.eye(self.balls) - np.eye(self.balls, k=-1)
        stiff = float(self.h) ** 2 * float(self.k)
        return float(np.linalg.cond(np.eye(self.balls) + stiff * jacobian.T @ jacobian))

    def start(self, q: Any, v: Any = 0.0) -> ColumnState:
        """Return the state at step 0: heights relative to the touching stack, m, and velocities, m/s."""
        q = jnp.broadcast_to(jnp.asarray(q, self.dtype), (self.balls,))
        return ColumnState(q, jnp.broadcast_to(jnp.asarray(v, self.dtype), (self.balls,)))

    def gaps(self, q: Balls) -> Balls:
        """Return the distance of each ball from the ball below, m; negative if the two balls push."""
        return q - jnp.concatenate([jnp.zeros(1, q.dtype), q[:-1]])

    def _product(self, active: Balls, multiply, dtype):
        """Return the function v -> (I + h²k Jᵀ A J) v, with a given function for matrix products."""
        jacobian = jnp.eye(self.balls, dtype=dtype) - jnp.eye(self.balls, k=-1, dtype=dtype)
        stiff = (self.h * self.h * self.k).astype(dtype)

        def product(p):
            push = active.astype(dtype) * multiply(jacobian, p[:, None])[:, 0]
            return p + stiff * multiply(jacobian.T, push[:, None])[:, 0]

        return product

    def _multiply(self, a, b):
        """Return a matrix product in the format of the column."""
        if self.dtype == np.float64:
            return a @ b
        return lax.switch(self.code - 1, [partial(matmul, name=name) for name in FORMATS[1:]], a, b)

    def advance(self, state: ColumnState) -> tuple[ColumnState, ColumnRecord]:
        """Make one step; return the next state and the decisions of the step."""
        stiff = self.h * self.h * self.k
        free = state.q + self.h * state.v - self.h * self.h * self.gravity

        def slope(q):
            gap = self.gaps(q)
            push = jnp.minimum(gap, 0.0)
            above = jnp.concatenate([push[1:], jnp.zeros(1, q.dtype)])
            return (q - free) + stiff * (push - above), (gap < 0).astype(q.dtype)

        def search(q, direction, before):
            """Return the move, shortened to the point of zero slope if it overshoots."""

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
    """Result of a run of the column.

    Attributes:
        column: parameters of the run.
        q, v: shape (steps + 1, balls).
        record: record of every step, with steps along the leading axis.
    """

    column: Column
    q: Float[np.ndarray, "rows balls"]
    v: Float[np.ndarray, "rows balls"]
    record: ColumnRecord

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.q) - 1

    def first_difference(self, other: ColumnRun) -> tuple[int, int, float, float] | None:
        """Return the first step (from 1) and ball whose contact differs, with both gaps; None without any."""
        differ = np.asarray(self.record.contact) != np.asarray(other.record.contact)
        if not differ.any():
            return None
        step, ball = (int(k) for k in np.argwhere(differ)[0])
        first, second = (float(np.asarray(run.record.gap)[step, ball]) for run in (self, other))
        return step + 1, ball, first, second

    def ended(self) -> dict[str, int]:
        """Count the outer loops that ended for each reason."""
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
    """Return the column with inner matrix products in another format."""
    numbers = ("h", "k", "gravity", "tol", "inner_tol")
    given = {name: float(getattr(column, name)) for name in numbers}
    caps = {name: int(getattr(column, name)) for name in ("max_outer", "max_inner")}
    return Column.create(column.balls, format, **given, **caps)


#: Size of the linear systems, their condition numbers, tolerance and cap.
SIZE, HARD, EASY, TOL, CAP = 50, 1e4, 1e2, 1e-5, 400
SHOWN = ("float32", "tf32", "bfloat16")
#: The column: balls, steps, and the small budget of outer iterations of the second set of runs.
BALLS, STEPS, BUDGET = 48, 60, 4


def system(condition: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a matrix with logarithmically even eigenvalues from 1 to 1/condition, and a right side."""
    rng = np.random.default_rng(0)
    basis, _ = np.linalg.qr(rng.normal(size=(SIZE, SIZE)))
    matrix = (basis * np.logspace(0, -np.log10(condition), SIZE)) @ basis.T
    return (matrix + matrix.T) / 2, rng.normal(size=SIZE)


@jax.jit
def solve(matrix: Any, b: Any) -> dict[str, Solution]:
    """Solve in float32 with the matrix product in each format; return also true residuals in float64."""
    low = matrix.astype(jnp.float32)

    def one(code):
        def product(v):
            return lax.switch(code, [partial(matmul, low, name=name) for name in SHOWN], v[:, None])[:, 0]

        return conjugate_gradients(
            product, b.astype(jnp.float32), TOL, CAP, true_product=lambda x: matrix @ x.astype(jnp.float64)
        )

    # one compiled loop for all formats
    _, solved = lax.scan(lambda _, code: (None, one(code)), None, jnp.arange(len(SHOWN)))
    return {name: jax.tree.map(lambda leaf, k=k: leaf[k], solved) for k, name in enumerate(SHOWN)}


def column_runs(max_outer: int) -> dict[str, ColumnRun]:
    """Simulate the falling column in every format, float64 first."""
    gaps = np.random.default_rng(0).uniform(0, 2e-3, BALLS)
    reference = Column.create(
        BALLS, "float64", k=1e7, tol=1e-6, inner_tol=1e-4, max_outer=max_outer, max_inner=CAP
    )
    columns = {name: in_format(reference, name) for name in ("float64", *SHOWN)}
    return {name: simulate_column(one, one.start(np.cumsum(gaps)), STEPS) for name, one in columns.items()}


def true_residual(solution: Solution) -> float:
    """Return the true relative residual of a solution, in contrast to the residual of the recurrence."""
    return float(solution.true_history[solution.iterations])


def run() -> Demo:
    """Demonstrate the linear solve alone, and inside a contact problem."""
    hard, easy = (solve(*map(jnp.asarray, system(c))) for c in (HARD, EASY))
    full, short = column_runs(40), column_runs(BUDGET)
    counts = {name: int(one.iterations) for name, one in hard.items()}
    believed = {name: float(one.residual) for name, one in hard.items()}
    true = {name: true_residual(one) for name, one in hard.items()}
    inner = {name: int(one.record.inner.sum()) for name, one in full.items()}
    outer = {name: int(one.record.outer.sum()) for name, one in full.items()}
    flips = {name: short["float64"].first_difference(one) for name, one in short.items()}
    flip = flips["tf32"]
    in_words = "no contact differs" if flip is None else f"a contact first differs in step {flip[0]}"
    reasons = {name: Reason(int(one.reason)) for name, one in hard.items()}
    return Demo(
        title="Ten bits in a matrix product, inside a solver",
        question=(
            "Some devices multiply float32 matrices with ten fraction bits unless told otherwise. How "
            "does this affect an iterative solver, and the contacts that depend on it?"
        ),
        result=(
            f"Conjugate gradients with TF32 products report a residual of {believed['tf32']:.1e}; the "
            f"true residual is {true['tf32']:.2g}."
        ),
        answer=(
            f"At condition number {HARD:.0e}, conjugate gradients with TF32 products stop after "
            f"{counts['tf32']} iterations with a residual of {believed['tf32']:.1e} by their "
            f"recurrence; the true residual is {true['tf32']:.2g}. With float32 the true residual is "
            f"{true['float32']:.1e} after {counts['float32']} iterations; with bfloat16 the limit of "
            f"{CAP} iterations is reached. In a column of {BALLS} balls the solver needs "
            f"{inner['tf32']} inner iterations instead of {inner['float32']}, and if only {BUDGET} "
            f"outer iterations per step are allowed, {in_words}."
        ),
        numbers={
            "true_residual_tf32": true["tf32"],
            "recurrence_residual_tf32": believed["tf32"],
            "iterations_tf32": counts["tf32"],
            "true_residual_float32": true["float32"],
            "iterations_float32": counts["float32"],
            "iterations_bfloat16": counts["bfloat16"],
            "iterations_at_condition_100": {name: int(easy[name].iterations) for name in SHOWN},
            "column_inner_iterations": inner,
            "column_outer_iterations": outer,
            "first_contact_that_differs": {name: None if f is None else f[0] for name, f in flips.items()},
        },
        checks=[
            Claim(
                "TF32: the recurrence reports convergence",
                believed["tf32"],
                f"at most {TOL}, before the cap",
                believed["tf32"] <= TOL and reasons["tf32"] == Reason.TOLERANCE,
            ),
            Claim(
                "TF32: the true residual is about 0.1", true["tf32"], "0.03 to 0.3", 0.03 < true["tf32"] < 0.3
            ),
            Claim(
                "float32: the true residual is about 2e-4",
                true["float32"],
                "below 1e-3",
                true["float32"] < 1e-3,
            ),
            Claim(
                "bfloat16 reaches the limit of iterations",
                counts["bfloat16"],
                str(CAP),
                counts["bfloat16"] == CAP,
            ),
            Claim(
                "at condition number 100 the counts are nearly the same",
                [int(one.iterations) for one in easy.values()],
                "within 10 of one another",
                max(int(one.iterations) for one in easy.values())
                - min(int(one.iterations) for one in easy.values())
                <= 10,
            ),
            Claim(
                "in the column fewer bits need more inner iterations",
                inner,
                "growing from float64 to bfloat16",
                inner["float64"] < inner["float32"] < inner["tf32"] < inner["bfloat16"],
            ),
            Claim(
                "every outer loop of the column still ends at its tolerance",
                {name: one.ended() for name, one in full.items()},
                f"tolerance, {STEPS} times",
                all(one.ended() == {"tolerance": STEPS} for one in full.values()),
            ),
            Claim(
                f"with {BUDGET} outer iterations TF32 changes a contact and float32 changes none",
                [flips["float32"], flips["tf32"]],
                "none, some",
                flips["float32"] is None and flip is not None,
            ),
        ],
        tables=[
            table(
                "conjugate gradients alone",
                (
                    "condition number",
                    "products in",
                    "iterations",
                    "ended by",
                    "recurrence residual",
                    "true residual",
                ),
                tuple(
                    (
                        condition,
                        name,
                        int(one.iterations),
                        Reason(int(one.reason)).word,
                        float(one.residual),
                        true_residual(one),
                    )
                    for condition, solved in ((HARD, hard), (EASY, easy))
                    for name, one in ((name, solved[name]) for name in SHOWN)
                ),
            ),
            table(
                f"a column of {BALLS} balls, {STEPS} steps",
                (
                    "products in",
                    "outer iterations",
                    "inner iterations",
                    "largest true residual",
                    f"first contact that differs ({BUDGET} outer iterations)",
                ),
                tuple(
                    (
                        name,
                        outer[name],
                        inner[name],
                        float(np.nanmax(one.record.true)),
                        "none" if (f := flips[name]) is None else f"step {f[0]}, ball {f[1]}",
                    )
                    for name, one in full.items()
                ),
            ),
        ],
        plots=[_residuals(hard), _inner(full)],
        in_md=(
            "Constraint solvers, polarizable charges and fits by Gauss-Newton are such solves; the matrix "
            "products of a long-range sum are such products."
        ),
        data={
            "condition_of_the_column": full["float64"].column.condition,
            "inner_by_step": {name: np.asarray(one.record.inner) for name, one in full.items()},
            "margins_of_the_flip": None if flip is None else list(flip[2:]),
        },
    )


def _residuals(solved: dict[str, Solution]) -> Plot:
    count = np.arange(CAP + 1)
    kept = {
        (name, what): np.asarray(getattr(solved[name], what), float)
        for name in ("float32", "tf32")
        for what in ("true_history", "history")
    }
    return Plot(
        "residuals-at",
        title=f"Residuals at condition number {HARD:.0e}",
        x_label="iterations",
        y_label="relative residual",
        series=(
            Series("float32, true", count, kept["float32", "true_history"], role="first"),
            Series("float32, recurrence", count, kept["float32", "history"], role="first", dashed=True),
            Series("TF32, true", count, kept["tf32", "true_history"], role="bad"),
            Series("TF32, recurrence", count, kept["tf32", "history"], role="bad", dashed=True),
        ),
        y_scale="log",
        caption="The recurrence (dashed) falls to the tolerance in both formats. The true residual "
        "stays at a level that is determined by the rounding of the products.",
        horizontals=((TOL, "tolerance"),),
    )


def _inner(runs: dict[str, ColumnRun]) -> Plot:
    step = np.arange(1, STEPS + 1)
    counts = {name: np.asarray(one.record.inner) for name, one in runs.items()}
    return Plot(
        "inner-iterations",
        title="Inner iterations of the column",
        x_label="step",
        y_label="conjugate gradient iterations",
        series=(
            Series("float64", step, counts["float64"], role="muted"),
            Series("float32", step, counts["float32"], role="first"),
            Series("TF32", step, counts["tf32"], role="second"),
            Series("bfloat16", step, counts["bfloat16"], role="bad"),
        ),
        caption="The column lands between steps 1 and 11 and collapses once more around step 14. With "
        "fewer bits, more iterations are needed.",
    )
