"""The number of solver iterations jumps between adjacent gains, so the loss is a sawtooth."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from mdnum.ball import BallProblem, GlobalSum, Projection, ResidualPenetration, SemiImplicitEuler, World
from mdnum.numerics.rounding import neighbor, ordinal
from mdnum.verbs.demos import Claim, Demo, Plot, Series, Table, table

ALPHA, DEPTH, TOL = 0.5, 0.45, 1e-4
LOW, HIGH, POINTS = 0.48, 0.53, 101


@dataclass(frozen=True)
class Side:
    """Remaining penetration after one projection, with its derivative and its iterations.

    Attributes:
        at: gain of the solver.
        loss, gradient: remaining penetration, m, and its derivative with respect to the gain at a fixed
        number of iterations.
        iterations: number of solver iterations.
        residuals: residual at every stopping decision, m.
    """

    at: float
    loss: float
    gradient: float
    iterations: int
    residuals: np.ndarray

    def residual(self, iteration: int) -> float:
        """Residual at the stopping decision of an iteration."""
        return float(self.residuals[iteration])


@dataclass(frozen=True)
class Tooth:
    """Two adjacent floats with different numbers of iterations, and the number of runs of the search."""

    below: Side
    above: Side
    evaluations: int

    @property
    def iteration(self) -> int:
        """Iteration of the stopping decision that differs between the two gains."""
        return min(self.below.iterations, self.above.iterations)

    def margin(self, side: Side) -> float:
        """Tolerance minus residual at the differing decision."""
        return TOL - side.residual(self.iteration)


@cache
def relaxation() -> BallProblem:
    """Return the problem of one ball and one projection; the loss is the remaining penetration."""
    world = World.create(Projection(0.5, ALPHA, GlobalSum(TOL, 200)), SemiImplicitEuler(1.0), gravity=0.0)
    return BallProblem(world, np.array([-DEPTH]), 0.0, 1, ResidualPenetration(1))


def side(k: float) -> Side:
    """Return the result of the projection for a gain."""
    problem = relaxation().with_values({"k": k})
    run = problem.run(history=True)
    loss, slope = problem.value_and_grad(["k"])
    assert run.history is not None
    return Side(float(k), loss, slope["k"], int(run.iterations[0]), run.history[0])


def teeth(low: float, high: float) -> list[tuple[float, float, int]]:
    """Find pairs of adjacent gains with different numbers of iterations, and the number of runs."""

    @cache
    def count(k: float) -> int:
        return int(relaxation().with_values({"k": k}).run(keep=False).iterations[0])

    found, spent, stretches = [], 0, [(low, high)]
    while stretches:
        low, high = stretches.pop()
        if count(low) == count(high):
            continue
        if (between := int(ordinal(high) - ordinal(low))) > 1:
            middle = float(neighbor(low, between // 2))
            stretches += [(middle, high), (low, middle)]
            continue
        # two more to annotate it
        found.append((low, high, count.cache_info().misses - spent + 2))
        spent = count.cache_info().misses
    return found


def exact(n: int) -> float:
    """Return the gain for which n exact iterations leave a penetration equal to the tolerance."""
    return (1 - (TOL / DEPTH) ** (1 / n)) / ALPHA


def run() -> Demo:
    """Find the boundaries between numbers of iterations, and describe the boundary nearest to 0.5."""
    grid = [side(k) for k in np.linspace(LOW, HIGH, POINTS)]
    cells = [
        pair
        for a, b in itertools.pairwise(grid)
        if a.iterations != b.iterations
        for pair in teeth(a.at, b.at)
    ]
    found = [Tooth(side(low), side(high), runs) for low, high, runs in cells]
    one = min(found, key=lambda b: abs(b.above.at - 0.5035))
    below, above = one.below, one.above
    ulps = [int(ordinal(b.above.at) - ordinal(b.below.at)) for b in found]
    known = [exact(b.above.iterations) for b in found]
    off = [abs(int(ordinal(k) - ordinal(b.above.at))) for b, k in zip(found, known, strict=True)]
    ends = (grid[-1].loss - grid[0].loss) / (grid[-1].at - grid[0].at)
    inside = float(np.mean([point.gradient for point in grid]))
    margins = [[b.margin(b.below), b.margin(b.above)] for b in found]
    margin = [one.margin(below), one.margin(above)]
    jump = above.loss - below.loss
    smooth = abs(below.gradient) * (above.at - below.at)
    return Demo(
        title="Between two floats the solver makes one iteration fewer",
        question=(
            "How does the remaining penetration after a projection depend on the gain, down to the last bit?"
        ),
        result=(
            f"Between two adjacent floats of k the solver makes {below.iterations} or {above.iterations} "
            f"iterations, and the loss jumps from {below.loss:.3g} to {above.loss:.3g}."
        ),
        answer=(
            f"At k = {below.at!r} the solver makes {below.iterations} iterations, at the next float "
            f"{above.iterations}: the residual after {one.iteration} is {margin[0]:.1g} on one side of "
            f"the tolerance and {margin[1]:.1g} on the other. The loss goes from {below.loss:.3g} to "
            f"{above.loss:.3g} and its derivative from {below.gradient:.3g} to {above.gradient:.3g}, where a "
            f"smooth function would change by {smooth:.1g}. The search took {one.evaluations} runs. "
            f"Every derivative states that the loss decreases with the gain ({inside:.2g} on average); "
            f"over the whole interval the loss changes by {ends:.1g} per unit of gain."
        ),
        numbers={
            "k_below": below.at,
            "k_above": above.at,
            "iterations": [below.iterations, above.iterations],
            "loss": [below.loss, above.loss],
            "gradient": [below.gradient, above.gradient],
            "residual": [below.residual(one.iteration), above.residual(one.iteration)],
            "margin": margin,
            "evaluations": one.evaluations,
            "boundaries": len(found),
            "mean_gradient": inside,
            "secant": float(ends),
        },
        checks=[
            Claim("every boundary stands between adjacent floats", ulps, "1 ulp each", set(ulps) == {1}),
            Claim(
                "at each boundary the solver makes one iteration fewer",
                [b.below.iterations - b.above.iterations for b in found],
                "1 each",
                all(b.below.iterations == b.above.iterations + 1 for b in found),
            ),
            Claim(
                "the boundaries are those of real arithmetic in the interval",
                len(found),
                str(_expected()),
                len(found) == _expected(),
            ),
            Claim(
                "each boundary agrees with real arithmetic within the rounding of its iterations",
                off,
                "within 64 ulps",
                max(off) <= 64,
            ),
            Claim(
                "margins have opposite signs",
                margins,
                "0 or less below, above 0 above",
                all(low <= 0 < high for low, high in margins),
            ),
            Claim(
                "the loss jumps by the change of one iteration",
                jump,
                f"{TOL:g} * alpha * k to 1e-9 relative",
                math.isclose(jump, TOL * ALPHA * above.at, rel_tol=1e-9),
            ),
            Claim("few rollouts", one.evaluations, "at most 60", one.evaluations <= 60),
        ],
        tables=[_table(found)],
        plots=_plots(grid, found),
        in_md=(
            "A tolerance of a constraint solver or a minimizer, or a list that is rebuilt one step "
            "earlier, has the same effect: along any parameter the sequence of operations changes at "
            "certain points, and a gradient contains no information on them."
        ),
        data={"at": [b.above.at for b in found]},
    )


def _expected() -> int:
    counts = range(1, 200)
    return sum(1 for n in counts if LOW < exact(n) <= HIGH)


def _table(found: list[Tooth]) -> Table:
    rows = [
        (
            repr(one.below.at), one.below.iterations, one.above.iterations, one.margin(one.below),
            one.margin(one.above), one.below.loss, one.above.loss, one.below.gradient, one.above.gradient,
            one.evaluations,
        )
        for one in found
    ]  # fmt: skip
    columns = (
        "k below", "iterations", "above", "margin (m)", "above", "loss (m)", "above", "dloss/dk", "above",
        "rollouts",
    )  # fmt: skip
    return table("Boundaries along the gain", columns, rows)


def _plots(grid: list[Side], found: list[Tooth]) -> list[Plot]:
    at, loss = np.array([point.at for point in grid]), np.array([point.loss for point in grid])
    # a gap between the two sides of each boundary
    blank = {"loss": np.nan, "gradient": np.nan}
    gaps = [point for b in found for point in (b.below, replace(b.below, **blank), b.above)]
    points = sorted([*grid, *gaps], key=lambda point: point.at)
    x = np.array([point.at for point in points])
    flat = np.full(2, (loss[-1] - loss[0]) / (at[-1] - at[0]))
    marks = tuple((b.above.at, f"{b.below.iterations} to {b.above.iterations}") for b in found)
    return [
        Plot(
            "loss",
            title="Remaining penetration over the gain",
            x_label="gain k",
            y_label="loss (m)",
            series=(
                Series("loss", x, np.array([point.loss for point in points])),
                Series("grid", at, loss, "points", "muted"),
            ),
            caption="The penetration decreases between boundaries and jumps back to the tolerance at "
            "each boundary.",
            verticals=marks,
            horizontals=((TOL, "tolerance"),),
        ),
        Plot(
            "derivative",
            title="Derivative of the penetration through the executed iterations",
            x_label="gain k",
            y_label="dloss/dk (m)",
            series=(
                Series("derivative", x, np.array([point.gradient for point in points]), role="second"),
                Series("slope over the whole interval", at[[0, -1]], flat, role="muted", dashed=True),
            ),
            caption="The derivative is correct except at the boundaries, but does not describe a change "
            "across a boundary.",
            verticals=marks,
        ),
    ]
