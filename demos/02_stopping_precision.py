"""A batch whose penetrations sum to the tolerance: the dtype of the sum decides whether the loop runs."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from mdnum.ball import (
    BallProblem,
    BallRun,
    GlobalSum,
    Projection,
    ResidualPenetration,
    SemiImplicitEuler,
    World,
)
from mdnum.errors import InputError
from mdnum.gradients.ball import ThroughIterations
from mdnum.gradients.problem import Gradient
from mdnum.numerics.roles import ALL, RolePrecision
from mdnum.numerics.rounding import neighbor
from mdnum.numerics.sums import Reduction, Sequential
from mdnum.verbs.demos import Claim, Demo, Plot, Series, Table, load, table

K = ALPHA = 0.5
STEPS, MAX_ITER, TOL, SMALL = 4, 25, 1e-3, 8
FORMATS = ("bfloat16", "float16")


def boundary_batch(dtype: str, tol: float = TOL, small: int = SMALL) -> tuple[float, np.ndarray]:
    """Penetrations that sum to a tolerance in exact arithmetic and stay below it in a narrow one.

    One is the float below the tolerance, the others share the gap: each is less than half a unit in the last
    place of the first, so that a sum in this dtype which starts with the first never notices them.

    Args:
        dtype: a name such as "bfloat16".
        tol: m, rounded to the dtype.
        small: how many share the gap; a power of 2 keeps the sum exact.

    Returns:
        the tolerance as rounded, and the penetrations in float64, shape (small + 1,).

    Raises:
        InputError: the gap, or its share, is no number of the dtype.
    """
    kind = ALL[dtype]
    limit = np.asarray(tol, kind)[()]
    below = neighbor(limit, -1, kind)
    share = (float(limit) - float(below)) / small
    if share == 0 or float(np.asarray(share, kind)) != share:
        raise InputError(
            f"a {small}th of the gap below {float(limit):g}, {share:g}, is no {dtype}",
            remedy="Choose a larger tolerance, or a power of 2 of small terms.",
        )
    return float(limit), np.array([float(below)] + [share] * small)


def problem(dtype: str, policy: RolePrecision, reduction: Reduction = Sequential()) -> BallProblem:
    """The batch on the boundary of a dtype, four steps without gravity.

    Args:
        dtype: whose boundary the batch lies on.
        policy: dtype by role.
        reduction: order of the residual's sum.
    """
    tol, depths = boundary_batch(dtype)
    contact = Projection(K, ALPHA, GlobalSum(tol, MAX_ITER, reduction))
    world = World.create(contact, SemiImplicitEuler(0.01), gravity=0.0, policy=policy)
    return BallProblem(world, -depths, 0.0, STEPS, ResidualPenetration())


def policies(dtype: str) -> dict[str, RolePrecision]:
    """The three that are compared: wide, narrow with a narrow sum, narrow with a wide sum.

    All take the loss in float32 of what positions they have: a loss of sixteen bits would be rounded itself.
    """
    wide = "float32"
    return {
        "float32": RolePrecision.all(wide),
        f"{dtype}, fragile sum": RolePrecision(dtype, dtype, dtype, dtype, wide),
        f"{dtype}, float32 sum": RolePrecision(dtype, dtype, wide, wide, wide),
    }


@dataclass(frozen=True)
class Row:
    """One run: its record and its derivative by the gain."""

    dtype: str
    name: str
    run: BallRun
    gradient: Gradient

    @property
    def moves(self) -> np.ndarray:
        """Largest change of a position in each step, m, shape (steps,)."""
        return np.abs(np.diff(self.run.y.astype(np.float64), axis=0)).max(axis=1)

    @property
    def contact(self) -> int | None:
        """First step (from 1) in which a ball touches the floor; None where none does."""
        touched = self.run.first_contact[self.run.first_contact > 0]
        return int(touched.min()) if len(touched) else None

    def data(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        assert self.run.history is not None
        first = self.run.history[0].astype(np.float64)
        return {
            "iterations": self.run.iterations.tolist(),
            "penetration": [float(x) for x in self.run.residual],
            "penetration_before": [float(x) for x in self.run.history[:, 0]],
            "residuals_of_step_1": [float(x) for x in first[np.isfinite(first)]],
            "largest_move": [float(x) for x in self.moves],
            "first_contact": self.contact,
            "loss": self.gradient.value,
            "grad_k": self.gradient.gradient["k"],
            "depends_on_k": self.gradient.depends["k"],
            "says": self.gradient.notes["k"],
        }


def measure(dtype: str) -> list[Row]:
    """The three runs of one narrow dtype."""
    rows = []
    for name, policy in policies(dtype).items():
        posed = problem(dtype, policy)
        run = posed.run(history=True)
        rows.append(Row(dtype, name, run, ThroughIterations()(posed, ["k"], run)))
    return rows


def exact(dtype: str) -> tuple[list[float], float]:
    """Losses of no iteration and of one, and the derivative by the gain of one, in exact arithmetic."""
    _, depths = boundary_batch(dtype)
    squares = sum(Fraction(float(depth)) ** 2 for depth in depths) / len(depths)
    share = 1 - Fraction(ALPHA) * Fraction(K)
    return [float(squares), float(share**2 * squares)], float(-2 * share * Fraction(ALPHA) * squares)


def run() -> Demo:
    """Three precisions in two formats, and loss scaling for the one whose derivative underflows."""
    rows = {dtype: measure(dtype) for dtype in FORMATS}
    half = rows["float16"][2]
    posed = problem("float16", policies("float16")[half.name])
    scaled = ThroughIterations(loss_scale=2.0**15)(posed, ["k"], half.run)
    data = {dtype: {row.name: row.data() for row in rows[dtype]} for dtype in FORMATS}
    slopes = {dtype: [row.gradient.gradient["k"] for row in rows[dtype]] for dtype in FORMATS}
    counts = {dtype: [row.run.iterations.tolist() for row in rows[dtype]] for dtype in FORMATS}
    truth = {dtype: exact(dtype)[1] for dtype in FORMATS}
    losses = {dtype: [row.gradient.value for row in rows[dtype]] for dtype in FORMATS}
    exact_losses = {dtype: [exact(dtype)[0][n] for n in (1, 0, 1)] for dtype in FORMATS}
    step = 2.0**-24
    lost = abs(slopes["float16"][2] / truth["float16"] - 1)
    restored = abs(scaled.gradient["k"] / truth["float16"] - 1)
    sums = {dtype: _sums(dtype) for dtype in FORMATS}
    ran, did_not = [1, 0, 0, 0], [0, 0, 0, 0]
    fragile = [rows[dtype][1].gradient for dtype in FORMATS]
    checks = [
        Claim(
            "the penetrations sum to the tolerance exactly",
            [float(sums[dtype][0].exact) for dtype in FORMATS],
            "the tolerance",
            all(sums[dtype][0].exact == Fraction(boundary_batch(dtype)[0]) for dtype in FORMATS),
        ),
        *(
            Claim(
                f"iterations by step on the boundary of {dtype}: wide, fragile, float32 sum",
                counts[dtype],
                f"{ran}, {did_not}, {ran}",
                counts[dtype] == [ran, did_not, ran],
            )
            for dtype in FORMATS
        ),
        *(
            Claim(
                f"losses on the boundary of {dtype} are those of the exact positions, to float32",
                losses[dtype],
                "one iteration, none, one, to 2^-20 relative",
                all(
                    abs(loss / expected - 1) < 2.0**-20
                    for loss, expected in zip(losses[dtype], exact_losses[dtype], strict=True)
                ),
            )
            for dtype in FORMATS
        ),
        Claim(
            "the loss of a fragile run does not depend on k, and the gradient reports this",
            [one.notes["k"] for one in fragile],
            "ended before k was used; derivative 0",
            all(not one.depends["k"] and one.gradient["k"] == 0.0 for one in fragile)
            and all("ended before k was used" in one.notes["k"] for one in fragile),
        ),
        *(
            Claim(
                f"a float32 sum restores the derivative in {dtype}",
                slopes[dtype][2],
                expected,
                bool(abs(slopes[dtype][2] / truth[dtype] - 1) < limit and slopes[dtype][2] != 0),
            )
            for dtype, expected, limit in (
                ("bfloat16", f"{truth['bfloat16']:.4g} to 1e-3", 1e-3),
                ("float16", f"{truth['float16']:.4g}, but only in steps of 2^-24", 0.5),
            )
        ),
        Claim(
            "the derivative in float16 is a whole number of its smallest subnormal",
            slopes["float16"][2] / step,
            "an integer",
            float(slopes["float16"][2] / step).is_integer(),
        ),
        Claim("loss scaling brings it back", restored, "below 1e-3 relative", bool(restored < 1e-3)),
    ]
    return Demo(
        title="The dtype of a sum decides whether the solver runs",
        question=("The sum of the penetrations of a batch equals the tolerance. Does the solver start?"),
        result=(
            "If the residual is summed in bfloat16 or float16, it is one ulp too small, the solver "
            f"makes no iteration, and dloss/dk is exactly 0 instead of {truth['bfloat16']:.2g}."
        ),
        answer=(
            "If the residual is summed in float32, the solver makes one iteration and the loss "
            "depends on k. If it is summed in bfloat16 or float16, largest term first, the small "
            "terms are lost to rounding, the sum stays one ulp below the tolerance, and the loop "
            "ends before k is used: the loss does not depend on k, and the derivative is exactly 0. "
            "A float32 sum of the same 16-bit state makes the loss depend on k again. In float16 the "
            f"derivative is then still a subnormal number with an error of {100 * lost:.0f} %; if the "
            f"loss is scaled by 2^15, the error is {restored:.1g}."
        ),
        numbers={
            "iterations": counts,
            "loss": losses,
            "grad_k": slopes,
            "grad_k_exact": truth,
            "grad_k_scaled": scaled.gradient["k"],
            "error_unscaled": lost,
            "error_scaled": restored,
            "depends_on_k": {d: [row.gradient.depends["k"] for row in rows[d]] for d in FORMATS},
            "tolerance": {dtype: boundary_batch(dtype)[0] for dtype in FORMATS},
        },
        checks=checks,
        tables=[_table(rows, truth, scaled), *(_running(dtype, sums[dtype][1]) for dtype in FORMATS)],
        plots=[_sum_plot(sums), _penetrations(rows)],
        in_md=(
            "Forces, displacements and residuals are also sums. If a list is rebuilt when a sum "
            "exceeds a threshold, or a constraint solver stops at a tolerance, the last bit of the "
            "sum may decide."
        ),
        data={**data, "float16 scaled": {"grad_k": scaled.gradient["k"], "loss_scale": 2.0**15}},
    )


def _sums(dtype: str) -> tuple[Any, Any]:
    """The history of the residual's sum in float32 and in the narrow dtype."""
    _, depths = boundary_batch(dtype)
    running_sum_table = load("sum-order").running_sum_table
    return running_sum_table(depths, np.float32), running_sum_table(depths, ALL[dtype])


def _table(rows: dict[str, list[Row]], truth: dict[str, float], scaled: Gradient) -> Table:
    lines = [
        (
            row.dtype,
            row.name,
            " ".join(str(n) for n in row.run.iterations),
            float(row.run.history[0, 0]),  # type: ignore[index]
            " ".join(f"{move:.4g}" for move in row.moves),
            row.contact,
            row.gradient.value,
            row.gradient.gradient["k"],
            truth[row.dtype],
            row.gradient.depends["k"],
        )
        for dtype in FORMATS
        for row in rows[dtype]
    ]
    half = lines[-1]
    lines.append(
        (*half[:1], "float16, float32 sum, loss scaled", *half[2:7], scaled.gradient["k"], *half[8:])
    )
    columns = (
        "boundary of", "run", "iterations", "first residual (m)", "largest move by step (m)", "first contact",
        "loss (m²)", "dloss/dk", "exact", "depends on k",
    )  # fmt: skip
    return table("Three precisions on two boundaries", columns, tuple(lines))


def _running(dtype: str, history: Any) -> Table:
    return table(f"The fragile sum in {dtype}, addition by addition", history.columns, history.table())


def _sum_plot(sums: dict[str, tuple[Any, Any]]) -> Plot:
    series = []
    roles: tuple[tuple[str, Any, Any], ...] = (("bfloat16", "second", "first"), ("float16", "third", "bad"))
    for dtype, wide, narrow in roles:
        limit, depths = boundary_batch(dtype)
        ulp = limit - depths[0]
        for history, role in zip(sums[dtype], (wide, narrow), strict=True):
            y = np.array([(row.running - limit) / ulp for row in history.rows])
            series.append(
                Series(f"{history.dtype}, boundary of {dtype}", np.arange(len(y)) + 1, y, "steps", role)
            )
    return Plot(
        "running-sum",
        title="Running sum of the residual",
        x_label="terms added",
        y_label="sum - tolerance (ulps of the narrow dtype)",
        series=tuple(series),
        caption="In a narrow dtype the eight small terms do not change the sum. In float32 the sum "
        "equals the tolerance, so the solver continues.",
        horizontals=((0.0, "tolerance"),),
    )


def _penetrations(rows: dict[str, list[Row]]) -> Plot:
    series = []
    roles: dict[str, Any] = {"bfloat16": ("muted", "first", "second"), "float16": ("ink", "bad", "third")}
    for dtype in FORMATS:
        for row, role in zip(rows[dtype], roles[dtype], strict=True):
            left = np.concatenate([row.run.history[:1, 0], row.run.residual[:1]]).astype(np.float64)  # type: ignore[index]
            name = f"{row.name} (boundary of {dtype})" if row.name == "float32" else row.name
            series.append(Series(name, np.arange(2), left, "line+points", role))
    return Plot(
        "penetration-before",
        title="Penetration before and after the solver of the first step",
        x_label="0: before, 1: where the solver stopped",
        y_label="sum of penetrations (m)",
        series=tuple(series),
        caption="The fragile runs make no iteration; in the other runs the sum decreases by a quarter.",
        horizontals=((boundary_batch("bfloat16")[0], "tolerance in bfloat16"),),
    )
