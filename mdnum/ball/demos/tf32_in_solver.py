"""A solver whose matrix products keep ten bits: it says converged, and is not."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mdnum.ball.column import Column, ColumnRun, in_format, simulate_column
from mdnum.ball.conjugate import Solution, conjugate_gradients
from mdnum.ball.demos.base import Check, Demo, Plot, Series, Table
from mdnum.ball.state import Reason
from mdnum.precision.formats import matmul

#: Size of the linear systems, their condition numbers, tolerance and cap.
SIZE, HARD, EASY, TOL, CAP = 50, 1e4, 1e2, 1e-5, 400
FORMATS = ("float32", "tf32", "bfloat16")
#: The column: balls, steps, and the small budget of outer iterations of the second set of runs.
BALLS, STEPS, BUDGET = 48, 60, 4


def system(condition: float) -> tuple[np.ndarray, np.ndarray]:
    """A symmetric matrix with eigenvalues from 1 to 1/condition, even in the logarithm; a right-hand side."""
    rng = np.random.default_rng(0)
    basis, _ = np.linalg.qr(rng.normal(size=(SIZE, SIZE)))
    matrix = (basis * np.logspace(0, -np.log10(condition), SIZE)) @ basis.T
    return (matrix + matrix.T) / 2, rng.normal(size=SIZE)


@jax.jit
def solve(matrix: Any, b: Any) -> dict[str, Solution]:
    """Conjugate gradients in float32 with the product in each format; true residuals in float64."""
    low = matrix.astype(jnp.float32)

    def one(code):
        def product(v):
            return lax.switch(code, [partial(matmul, low, name=name) for name in FORMATS], v[:, None])[:, 0]

        return conjugate_gradients(
            product, b.astype(jnp.float32), TOL, CAP, true_product=lambda x: matrix @ x.astype(jnp.float64)
        )

    # one compiled loop for all formats
    _, solved = lax.scan(lambda _, code: (None, one(code)), None, jnp.arange(len(FORMATS)))
    return {name: jax.tree.map(lambda leaf, k=k: leaf[k], solved) for k, name in enumerate(FORMATS)}


def column_runs(max_outer: int) -> dict[str, ColumnRun]:
    """The falling column in every format, float64 first."""
    gaps = np.random.default_rng(0).uniform(0, 2e-3, BALLS)
    reference = Column.create(
        BALLS, "float64", k=1e7, tol=1e-6, inner_tol=1e-4, max_outer=max_outer, max_inner=CAP
    )
    columns = {name: in_format(reference, name) for name in ("float64", *FORMATS)}
    return {name: simulate_column(one, one.start(np.cumsum(gaps)), STEPS) for name, one in columns.items()}


def true_residual(solution: Solution) -> float:
    """The relative residual that a solution has, as opposed to the one it believes in."""
    return float(solution.true_history[solution.iterations])


def run() -> Demo:
    """The linear solve alone, and inside a contact problem."""
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
        name="tf32-in-solver",
        title="Ten bits in a matrix product, inside a solver",
        question=(
            "Some devices multiply float32 matrices with ten fraction bits unless told otherwise. What does "
            "that do to an iterative solver, and to the contacts it decides?"
        ),
        answer=(
            f"At condition number {HARD:.0e}, conjugate gradients with TF32 products stop after "
            f"{counts['tf32']} iterations with a residual of {believed['tf32']:.1e} by their recurrence; the "
            f"true one is {true['tf32']:.2g}. With float32 it is {true['float32']:.1e} after "
            f"{counts['float32']}; bfloat16 hits the cap of {CAP}. In a column of {BALLS} balls the products "
            f"cost {inner['tf32']} inner iterations instead of {inner['float32']}, and where only {BUDGET} "
            f"outer iterations per step are allowed, {in_words}."
        ),
        numbers={
            "true_residual_tf32": true["tf32"],
            "recurrence_residual_tf32": believed["tf32"],
            "iterations_tf32": counts["tf32"],
            "true_residual_float32": true["float32"],
            "iterations_float32": counts["float32"],
            "iterations_bfloat16": counts["bfloat16"],
            "iterations_at_condition_100": {name: int(easy[name].iterations) for name in FORMATS},
            "column_inner_iterations": inner,
            "column_outer_iterations": outer,
            "first_contact_that_differs": {name: None if f is None else f[0] for name, f in flips.items()},
        },
        checks=[
            Check(
                "TF32: the recurrence says converged",
                believed["tf32"],
                f"at most {TOL}, before the cap",
                believed["tf32"] <= TOL and reasons["tf32"] == Reason.TOLERANCE,
            ),
            Check(
                "TF32: the true residual is about 0.1", true["tf32"], "0.03 to 0.3", 0.03 < true["tf32"] < 0.3
            ),
            Check(
                "float32: the true residual is about 2e-4",
                true["float32"],
                "below 1e-3",
                true["float32"] < 1e-3,
            ),
            Check("bfloat16 hits the cap", counts["bfloat16"], str(CAP), counts["bfloat16"] == CAP),
            Check(
                "at condition number 100 the counts are nearly the same",
                [int(one.iterations) for one in easy.values()],
                "within 10 of one another",
                max(int(one.iterations) for one in easy.values())
                - min(int(one.iterations) for one in easy.values())
                <= 10,
            ),
            Check(
                "in the column fewer bits cost more inner iterations",
                inner,
                "growing from float64 to bfloat16",
                inner["float64"] < inner["float32"] < inner["tf32"] < inner["bfloat16"],
            ),
            Check(
                "every outer loop of it still ends at its tolerance",
                {name: one.ended() for name, one in full.items()},
                f"tolerance, {STEPS} times",
                all(one.ended() == {"tolerance": STEPS} for one in full.values()),
            ),
            Check(
                f"with {BUDGET} outer iterations TF32 changes a contact and float32 none",
                [flips["float32"], flips["tf32"]],
                "none, some",
                flips["float32"] is None and flip is not None,
            ),
        ],
        tables=[
            Table(
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
                    for name, one in ((name, solved[name]) for name in FORMATS)
                ),
            ),
            Table(
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
        caption="The recurrence (dashed) falls to the tolerance in both formats. The true residual stops "
        "where the rounding of the products lets it.",
        horizontals=((TOL, "tolerance"),),
    )


def _inner(runs: dict[str, ColumnRun]) -> Plot:
    step = np.arange(1, STEPS + 1)
    counts = {name: np.asarray(one.record.inner) for name, one in runs.items()}
    return Plot(
        title="Inner iterations of the column",
        x_label="step",
        y_label="conjugate gradient iterations",
        series=(
            Series("float64", step, counts["float64"], role="muted"),
            Series("float32", step, counts["float32"], role="first"),
            Series("TF32", step, counts["tf32"], role="second"),
            Series("bfloat16", step, counts["bfloat16"], role="bad"),
        ),
        caption="The column lands between steps 1 and 11 and collapses once more around step 14; the fewer "
        "bits, the more iterations.",
    )
