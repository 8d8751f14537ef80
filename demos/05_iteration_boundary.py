"""The iteration count of a solver along its gain: a saw whose teeth stand between adjacent floats."""

from __future__ import annotations

import math

import numpy as np

from mdnum.ball import GlobalSum, Problem, Projection, ResidualPenetration, SemiImplicitEuler, World
from mdnum.ball.boundaries import Boundary, BoundaryMap, boundaries
from mdnum.precision import ulp_distance
from mdnum.workflow.demos import Claim, Demo, Plot, Series, table

ALPHA, DEPTH, TOL = 0.5, 0.45, 1e-4
LOW, HIGH, POINTS = 0.48, 0.53, 101


def relaxation(k: float = 0.5) -> Problem:
    """One ball below the floor, one projection, the penetration that it leaves."""
    world = World.create(Projection(k, ALPHA, GlobalSum(TOL, 200)), SemiImplicitEuler(1.0), gravity=0.0)
    return Problem(world, np.array([-DEPTH]), 0.0, 1, ResidualPenetration(1))


def exact(n: int) -> float:
    """The gain at which n iterations leave exactly the tolerance, in real arithmetic."""
    return (1 - (TOL / DEPTH) ** (1 / n)) / ALPHA


def run() -> Demo:
    """Find the boundaries; say what happens at the one nearest 0.5."""
    found = boundaries(relaxation(), "k", LOW, HIGH, points=POINTS)
    one = min(found.boundaries, key=lambda b: abs(b.above.at - 0.5035))
    below, above = one.below, one.above
    ulps = [int(ulp_distance(b.below.at, b.above.at)) for b in found.boundaries]
    known = [exact(b.above.iterations) for b in found.boundaries]
    off = [abs(int(ulp_distance(b.above.at, k))) for b, k in zip(found.boundaries, known, strict=True)]
    ends = (found.loss[-1] - found.loss[0]) / (found.at[-1] - found.at[0])
    inside = float(np.mean(found.gradient))
    smooth = abs(below.gradient) * (above.at - below.at)
    return Demo(
        title="Between two floats the solver makes one iteration fewer",
        question="How does what a projection leaves depend on its gain, down to the last bit?",
        answer=(
            f"At k = {below.at!r} the solver makes {below.iterations} iterations, at the next float "
            f"{above.iterations}: the residual after {one.iteration} is {below.margin:.1g} on one side of "
            f"the tolerance and {above.margin:.1g} on the other. The loss goes from {below.loss:.3g} to "
            f"{above.loss:.3g} and its derivative from {below.gradient:.3g} to {above.gradient:.3g}, where a "
            f"smooth function would change by {smooth:.1g}. It took {one.evaluations} rollouts to find. "
            f"Every derivative says that a larger gain leaves less ({inside:.2g} on average); over the whole "
            f"interval the loss changes by {ends:.1g} per unit of gain."
        ),
        numbers={
            "k_below": below.at,
            "k_above": above.at,
            "iterations": [below.iterations, above.iterations],
            "loss": [below.loss, above.loss],
            "gradient": [below.gradient, above.gradient],
            "residual": [below.residual, above.residual],
            "margin": [below.margin, above.margin],
            "evaluations": one.evaluations,
            "boundaries": len(found.boundaries),
            "mean_gradient": inside,
            "secant": float(ends),
        },
        checks=[
            Claim("every boundary stands between adjacent floats", ulps, "1 ulp each", set(ulps) == {1}),
            Claim(
                "each takes one iteration away",
                [b.below.iterations - b.above.iterations for b in found.boundaries],
                "1 each",
                all(b.below.iterations == b.above.iterations + 1 for b in found.boundaries),
            ),
            Claim(
                "all that real arithmetic has in the interval, and no other",
                len(found.boundaries),
                str(_expected()),
                len(found.boundaries) == _expected(),
            ),
            Claim(
                "each is where real arithmetic has it, but for the rounding of its iterations",
                off,
                "within 64 ulps",
                max(off) <= 64,
            ),
            Claim(
                "margins have opposite signs",
                [[b.below.margin, b.above.margin] for b in found.boundaries],
                "0 or less below, above 0 above",
                all(b.below.margin <= 0 < b.above.margin for b in found.boundaries),
            ),
            Claim(
                "the loss jumps by what one iteration leaves less",
                one.jump,
                f"{TOL:g} * alpha * k to 1e-9 relative",
                math.isclose(one.jump, TOL * ALPHA * above.at, rel_tol=1e-9),
            ),
            Claim("few rollouts", one.evaluations, "at most 60", one.evaluations <= 60),
        ],
        tables=[_table(found)],
        plots=[_loss_plot(found), _gradient_plot(found)],
        in_md=(
            "A tolerance of a constraint solver or of a minimizer, a list rebuilt one step earlier: along "
            "any parameter the program changes at a set of points, and a gradient knows nothing of them."
        ),
        data={"words": [b.words for b in found.boundaries]},
    )


def _expected() -> int:
    counts = range(1, 200)
    return sum(1 for n in counts if LOW < exact(n) <= HIGH)


def _table(found: BoundaryMap) -> Table:
    def cells(one: Boundary) -> tuple:
        return (
            repr(one.below.at), one.below.iterations, one.above.iterations, one.below.margin,
            one.above.margin, one.below.loss, one.above.loss, one.below.gradient, one.above.gradient,
            one.evaluations,
        )  # fmt: skip

    columns = (
        "k below", "iterations", "above", "margin (m)", "above", "loss (m)", "above", "dloss/dk", "above",
        "rollouts",
    )  # fmt: skip
    return table("Boundaries along the gain", columns, tuple(cells(one) for one in found.boundaries))


def _marks(found: BoundaryMap) -> tuple[tuple[float, str], ...]:
    return tuple((b.above.at, f"{b.below.iterations} to {b.above.iterations}") for b in found.boundaries)


def _cut(found: BoundaryMap, grid: np.ndarray, side: str) -> tuple[np.ndarray, np.ndarray]:
    """Points of the grid and of the boundaries, with a gap at each boundary."""
    x, y = list(found.at), list(grid)
    for one in found.boundaries:
        for end, value in (
            (one.below.at, getattr(one.below, side)),
            (np.nan, np.nan),
            (one.above.at, getattr(one.above, side)),
        ):
            x.append(one.below.at if np.isnan(end) else end)
            y.append(value)
    # the gap sorts between the two sides of its boundary
    rank = np.argsort(np.array(x), kind="stable")
    return np.array(x)[rank], np.array(y)[rank]


def _loss_plot(found: BoundaryMap) -> Plot:
    x, y = _cut(found, found.loss, "loss")
    return Plot(
        "penetration-that",
        title="Penetration that is left, along the gain",
        x_label="gain k",
        y_label="loss (m)",
        series=(Series("loss", x, y), Series("grid", found.at, found.loss, "points", "muted")),
        caption="It falls between boundaries and jumps back to the tolerance at each.",
        verticals=_marks(found),
        horizontals=((TOL, "tolerance"),),
    )


def _gradient_plot(found: BoundaryMap) -> Plot:
    x, y = _cut(found, found.gradient, "gradient")
    flat = np.full(2, (found.loss[-1] - found.loss[0]) / (found.at[-1] - found.at[0]))
    return Plot(
        "derivative-through",
        title="Its derivative, through the iterations that ran",
        x_label="gain k",
        y_label="dloss/dk (m)",
        series=(
            Series("derivative", x, y, role="second"),
            Series("slope over the whole interval", found.at[[0, -1]], flat, role="muted", dashed=True),
        ),
        caption="Right everywhere but at the boundaries, and of the wrong size for any step across one.",
        verticals=_marks(found),
    )
