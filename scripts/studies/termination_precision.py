"""Which precision of a stopping residual changes what a solver does?

Answer. Only a sequential sum in bfloat16 does: it stops early in 13 of 200 steps, and the derivative
changes by 1.4 %. A pairwise or exact sum in bfloat16, and any sum in float16 and float32, runs the program
of float64. It takes 31 s.

Balls lie on a floor and are shaken; each step a projection iterates until the penetrations of the whole batch
sum to less than a tolerance. The state stays in one dtype. Only the sum is made in others and in several
orders, and compared with the sum in float64:

    iterations   of all steps together
    early        steps in which the solver stopped sooner than with the float64 sum
    late         steps in which it stopped later
    capped       steps in which it never met the tolerance
    first        the first step with another count
    loss         mean penetration that is left, summed over steps
    d loss / dk  by the gain, through the iterations that ran
    change       of that derivative, relative

How to read it. A row with no early and no late step ran the same program. A narrow sum that stops early has
lost small terms to rounding, one that stops late has rounded them up; an order that loses less (pairwise,
compensated, exact) mends a narrow sum only as far as its dtype goes, a wide sum mends it whatever the order.
Where the counts differ the derivative is that of another program, and it jumps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import COLORS, figure, parser, save, say, start, table

from mdnum.ball import BallProblem, GlobalSum, Projection, ResidualPenetration, SemiImplicitEuler, World
from mdnum.gradients.ball import ThroughIterations
from mdnum.numerics import RolePrecision
from mdnum.numerics.reductions import parse
from mdnum.numerics.roles import ALL

ORDERS = ("sequential", "pairwise", "exact")
SHAKE = 3.0
FIRST, SECOND = "float64", "sequential"


@dataclass(frozen=True)
class Row:
    """One precision of the sum."""

    sum: str
    order: str
    iterations: np.ndarray
    capped: int
    loss: float
    slope: float


def pose(state: str, kind: str, order: str, balls: int, steps: int, tol: float) -> BallProblem:
    """Balls shaken by a seeded random acceleration; only the residual's sum differs from call to call."""
    policy = RolePrecision(state, state, kind, kind, "float64")
    contact = Projection(0.5, 0.5, GlobalSum(tol, 200, parse(order)))
    control = SHAKE * np.random.default_rng(0).normal(size=(steps, balls))
    world = World.create(contact, SemiImplicitEuler(0.01), control=control, policy=policy)
    return BallProblem(world, np.zeros(balls), 0.0, steps, ResidualPenetration(1))


def measure(state: str, kind: str, order: str, balls: int, steps: int, tol: float) -> Row:
    """Run it and differentiate it."""
    problem = pose(state, kind, order, balls, steps, tol)
    run = problem.run(keep=False)
    made = ThroughIterations()(problem, ["k"], run)
    return Row(kind, order, run.iterations, run.ended().get("cap", 0), made.value, float(made.gradient["k"]))


def draw(rows: list[Row], path: Path) -> None:
    """How many iterations each sum makes more or fewer, and the change of the derivative."""
    drawn = figure(9.0, 5.5)
    left, right = drawn.subplots(1, 2, width_ratios=(2, 1))
    plain = [row for row in rows if row.order == SECOND]
    steps = np.arange(1, len(rows[0].iterations) + 1)
    for row, color in zip(plain, COLORS, strict=False):
        behind = np.cumsum(row.iterations - rows[0].iterations)
        left.plot(steps, behind, drawstyle="steps-mid", color=color, label=row.sum)
    left.set(xlabel="step", ylabel="iterations so far, more than with a float64 sum", title="Sequential sums")
    left.legend()
    names = [f"{row.sum} {row.order}" for row in rows[1:]]
    change = [abs(row.slope / rows[0].slope - 1) for row in rows[1:]]
    right.barh(names, np.maximum(change, 1e-17), color=COLORS[1])
    right.set(xscale="log", xlim=(1e-17, 10), xlabel="relative change", title="d loss / dk")
    right.invert_yaxis()
    save(drawn, path)


def main() -> None:
    """Parse, run, print."""
    words = parser(__doc__, __file__)
    words.add_argument("--state", default="float32", choices=list(ALL), help="dtype of the state")
    words.add_argument("--sums", nargs="+", default=["float32", "bfloat16", "float16"], choices=list(ALL))
    words.add_argument("--orders", nargs="+", default=list(ORDERS), help="orders of the sum")
    words.add_argument("--balls", type=int, default=512)
    words.add_argument("--steps", type=int, default=200)
    words.add_argument("--tol", type=float, default=1e-2, help="tolerance, m")
    asked = words.parse_args()
    pairs = [(FIRST, SECOND), *((kind, order) for kind in asked.sums for order in asked.orders)]
    rows = []
    for kind, order in pairs:
        say(f"sum in {kind}, {order}")
        rows.append(measure(asked.state, kind, order, asked.balls, asked.steps, asked.tol))
    first = rows[0]
    lines = []
    for row in rows:
        differ = np.flatnonzero(row.iterations != first.iterations)
        early, late = (
            int(np.sum(test))
            for test in (row.iterations < first.iterations, row.iterations > first.iterations)
        )
        begins = int(differ[0]) + 1 if len(differ) else None
        change = abs(row.slope / first.slope - 1) if first.slope else None
        lines.append(
            (
                row.sum,
                row.order,
                int(row.iterations.sum()),
                early,
                late,
                row.capped,
                begins,
                row.loss,
                row.slope,
                change,
            )
        )
    columns = (
        "sum in",
        "order",
        "iterations",
        "early",
        "late",
        "capped",
        "first",
        "loss",
        "dloss_dk",
        "change",
    )
    title = f"{asked.balls} balls, {asked.steps} steps, state in {asked.state}, tolerance {asked.tol:g} m"
    table(title, columns, lines, words=2)
    draw(rows, asked.output)


if __name__ == "__main__":
    start(main)
