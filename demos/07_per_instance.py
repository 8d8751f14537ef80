"""One more ball below the floor, far from the others: which solvers does it affect?"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mdnum.ball import (
    BallProblem,
    BallRun,
    FixedCount,
    GlobalSum,
    Maximum,
    PerInstance,
    Projection,
    SemiImplicitEuler,
    World,
)
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

K = ALPHA = 0.5
TOL, CAP = 1e-3, 100
#: Penetrations of the batch, m; together they take 7 iterations, and a little more would take 8.
BATCH = tuple(TOL * share for share in (3.0, 1.5, 0.2, 0.1, 2.0))
#: Penetration of the ball that joins them, m: near the tolerance, and below it.
STRANGER = 0.95 * TOL
#: Where it is when it has nothing to do with the floor; a batch of the same size is the same program.
AWAY = -1.0


class LeftOf(eqx.Module):
    """Mean remaining penetration of the first balls of a batch, m, summed over steps."""

    balls: int = eqx.field(static=True)

    def step(self, state, record, dtype):
        """Return the mean remaining penetration of one step."""
        return jnp.mean(record.left[: self.balls].astype(dtype))

    def end(self, state, steps, total):
        """Return the sum over steps."""
        return total


def rules() -> dict[str, Any]:
    """Return the stopping rules that are compared."""
    return {
        "global sum": GlobalSum(TOL, CAP),
        "maximum": Maximum(TOL, CAP),
        "per instance": PerInstance(TOL, CAP),
        "fixed count": FixedCount(4),
    }


def batch(rule: Any, depths: tuple[float, ...]) -> BallProblem:
    """Return the problem of balls and one projection; the loss includes only the balls of `BATCH`."""
    world = World.create(Projection(K, ALPHA, rule), SemiImplicitEuler(1.0), gravity=0.0)
    return BallProblem(world, -np.array(depths), 0.0, 1, LeftOf(len(BATCH)))


def counts(run: BallRun) -> np.ndarray:
    """Return the number of solver iterations of each ball of the batch."""
    return np.broadcast_to(run.iterations[0], (run.balls,))[: len(BATCH)]


def run() -> Demo:
    """Compare each stopping rule with the additional ball above and below the floor."""
    found: dict[str, dict[str, Any]] = {}
    for name, rule in rules().items():
        alone, joined = (batch(rule, (*BATCH, depth)) for depth in (AWAY, STRANGER))
        before, after = counts(alone.run()), counts(joined.run())
        made = [one.value_and_grad(["k"]) for one in (alone, joined)]
        found[name] = {
            "before": before.tolist(),
            "after": after.tolist(),
            "coupling": float(np.mean(before != after)),
            "loss": [value for value, _ in made],
            "grad_k": [slopes["k"] for _, slopes in made],
        }
    total, own = found["global sum"], found["per instance"]
    drift = _growth()
    return Demo(
        title="A sum over the batch couples independent balls",
        question=(
            "A ball far from the others penetrates the floor. Does this affect the solvers of the others?"
        ),
        result=(
            "With a common sum, one more ball in the batch changes the number of iterations for "
            f"every other ball from {total['before'][0]} to {total['after'][0]}; with a separate rule "
            f"for each ball, no number changes."
        ),
        answer=(
            "With a common sum for the batch, all of them are affected: the number of iterations "
            f"changes from {total['before'][0]} to {total['after'][0]}, and the derivative of their "
            f"loss with respect to the gain from {total['grad_k'][0]:.2g} to "
            f"{total['grad_k'][1]:.2g}. With a rule for each ball, no other ball is affected. A rule "
            "based on the largest term couples the balls only if the additional ball has the largest "
            "term and exceeds the tolerance."
        ),
        numbers={
            "coupling": {name: row["coupling"] for name, row in found.items()},
            "iterations_before": {name: row["before"] for name, row in found.items()},
            "iterations_after": {name: row["after"] for name, row in found.items()},
            "grad_k": {name: row["grad_k"] for name, row in found.items()},
        },
        checks=[
            Claim(
                "global sum: fraction of other balls whose number of iterations changes",
                total["coupling"],
                "1",
                total["coupling"] == 1,
            ),
            Claim("per instance: the same share", own["coupling"], "0", own["coupling"] == 0),
            Claim(
                "fixed count: the same share",
                found["fixed count"]["coupling"],
                "0",
                found["fixed count"]["coupling"] == 0,
            ),
            Claim(
                "per instance: the loss of the other balls and its derivative do not change a bit",
                [own["loss"], own["grad_k"]],
                "equal pairs",
                own["loss"][0] == own["loss"][1] and own["grad_k"][0] == own["grad_k"][1],
            ),
            Claim(
                "global sum: the derivative of the loss belongs to another number of iterations",
                total["grad_k"],
                "n p (3/4)^(n-1) / 2 with n = 7 and 8",
                all(
                    np.isclose(slope, -np.mean(BATCH) * n * (1 - ALPHA * K) ** (n - 1) * ALPHA, rtol=1e-12)
                    for slope, n in zip(total["grad_k"], (7, 8), strict=True)
                ),
            ),
            Claim(
                "a larger batch needs more iterations with one sum, but not with a rule for each ball",
                [drift["global sum"], drift["per instance"]],
                "rising; constant",
                drift["global sum"][-1] > drift["global sum"][0] and len(set(drift["per instance"])) == 1,
            ),
        ],
        tables=[
            table(
                "the five balls of the batch, without and with a sixth",
                ("rule", "iterations before", "after", "coupling", "dloss/dk before", "after"),
                tuple(
                    (
                        name,
                        _short(row["before"]),
                        _short(row["after"]),
                        row["coupling"],
                        *row["grad_k"],
                    )
                    for name, row in found.items()
                ),
            )
        ],
        plots=[
            Plot(
                "iterations-ball",
                title="Iterations of a ball over the size of its batch",
                x_label="balls in the batch",
                y_label="iterations",
                x_scale="log",
                series=(
                    Series("global sum", _SIZES, np.array(drift["global sum"], float), "line+points", "bad"),
                    Series("per instance", _SIZES, np.array(drift["per instance"], float), "line+points"),
                ),
                caption="Equal balls, 0.45 m below the floor: with one sum the solve for a ball depends "
                "on the number of other balls.",
            )
        ],
        in_md=(
            "The energy of a batch of structures, the residual norm of all constraints and the "
            "largest displacement in the box are such common numbers: one structure, constraint or "
            "atom can decide the next step of all others."
        ),
        data=found,
    )


_SIZES = np.array([1.0, 10.0, 100.0])


def _growth() -> dict[str, list[int]]:
    """Return the iterations of the first of several equal balls."""
    shared = [batch(GlobalSum(TOL, CAP), (0.45,) * int(size)).run(keep=False) for size in _SIZES]
    own = batch(PerInstance(TOL, CAP), (0.45,) * (len(BATCH) + 1)).run(keep=False).iterations[0]
    return {
        "global sum": [int(one.iterations[0]) for one in shared],
        "per instance": [int(n) for n in own[: len(_SIZES)]],
    }


def _short(values: list[int]) -> str:
    return " ".join(str(value) for value in values)
