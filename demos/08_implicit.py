"""The derivative of a solver's iterations differs from the derivative of its fixed point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from mdnum.ball import BallProblem, GlobalSum, Projection, ResidualPenetration, SemiImplicitEuler, World
from mdnum.ball.stopping import elementwise
from mdnum.gradients.ball_contacts import FixedPointRule, Implicit
from mdnum.report.section import Table
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

K = ALPHA = 0.5
DEPTH = 0.45
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
ITERATIONS = (10, 100, 1000)
SOLVES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
CONDITION = 1e4


@dataclass(frozen=True)
class Memory:
    """Bytes of temporary arrays in a compiled gradient through a projection with a number of iterations.

    Attributes:
        iterations: number of iterations of the projection.
        unrolled: reverse mode over the iterations, which stores data of each iteration.
        carried: tangents propagated in the loop, as in mdnum's unrolled derivative (possible because the
            result of each ball depends on that ball only).
        implicit: a linear solve at the fixed point.
        value: the loss alone.
    """

    iterations: int
    unrolled: int
    carried: int
    implicit: int
    value: int


def memory(iterations: Sequence[int], balls: int = 1000) -> list[Memory]:
    """Return the compiler's temporary memory for value and gradient with respect to gain and initial height.

    Args:
        iterations: numbers of iterations for which the gradient is compiled.
        balls: number of balls in the batch, float64.
    """
    rows = []
    for count in iterations:
        sizes = [
            _temporaries(jax.value_and_grad(how, argnums=(0, 1)), balls, count)
            for how in (unrolled, carried, implicit)
        ]
        rows.append(Memory(count, sizes[0], sizes[1], sizes[2], _temporaries(carried, balls, count)))
    return rows


def _temporaries(function, balls: int, count: int) -> int:
    gain = jax.ShapeDtypeStruct((), jnp.float64)
    y = jax.ShapeDtypeStruct((balls,), jnp.float64)
    compiled = jax.jit(lambda gain, y: function(gain, y, count)).lower(gain, y).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    return int(analysis.temp_size_in_bytes)


def _once(gain, y):
    return y + gain * jnp.maximum(-y, 0.0)


def unrolled(gain: Float[Array, ""], y: Float[Array, "balls"], count: int) -> Float[Array, ""]:
    """Return the mean square of the remaining penetration, by a scan whose steps reverse mode stores."""
    y, _ = jax.lax.scan(lambda y, _: (_once(gain, y), None), y, None, length=count)
    return jnp.mean(y**2)


def carried(gain: Float[Array, ""], y: Float[Array, "balls"], count: int) -> Float[Array, ""]:
    """Return the mean square of the remaining penetration, with tangents propagated in the loop."""

    def run(inputs, rest):
        y, gain = inputs
        return (jax.lax.fori_loop(0, count, lambda _, y: _once(gain, y), y),), ()

    (y,), _ = elementwise(run)((y, jnp.broadcast_to(gain, y.shape)), ())
    return jnp.mean(y**2)


def implicit(gain: Float[Array, ""], y: Float[Array, "balls"], count: int) -> Float[Array, ""]:
    """Return the mean square of the remaining penetration, with the derivative of the fixed point."""
    contact = y < 0
    ended = jax.lax.stop_gradient(_loop(gain, y, count))
    y = FixedPointRule().attach(jnp.where(contact, ended, y), jnp.broadcast_to(gain, y.shape), contact)
    return jnp.mean(y**2)


def _loop(gain, y, count):
    gain, y = jax.lax.stop_gradient((gain, y))
    return jax.lax.fori_loop(0, count, lambda _, y: _once(gain, y), y)


@dataclass(frozen=True)
class Accuracy:
    """Error of a fixed-point derivative whose linear solve is stopped early.

    Attributes:
        tolerance: tolerance of the linear solve.
        regularization: number added to the diagonal.
        error: error of the derivative, relative to the exact derivative.
    """

    tolerance: float
    regularization: float
    error: float


def accuracy(
    tolerances: Sequence[float],
    regularizations: Sequence[float] = (0.0,),
    *,
    condition: float = 1e4,
    unknowns: int = 200,
    seed: int = 0,
) -> list[Accuracy]:
    """Measure how the tolerance and the regularization of the backward solve affect a derivative.

    The fixed point is x = x - A (x - p c), with a symmetric A whose eigenvalues are spaced evenly in the
    logarithm from 1 / condition to 1. For any A, x = p c and dx/dp = c, so the residual of the solve is the
    only error.

    Args:
        tolerances, regularizations: values; every pair is tested.
        condition: largest over smallest eigenvalue of A.
    """
    random = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(random.normal(size=(unknowns, unknowns)))
    matrix = jnp.asarray(basis * np.geomspace(1 / condition, 1.0, unknowns) @ basis.T)
    direction = jnp.asarray(random.normal(size=unknowns))
    rows = []
    for regularization in regularizations:
        for tolerance in tolerances:
            options = jnp.asarray(tolerance), jnp.asarray(regularization)
            found = np.asarray(_tangent(matrix, direction, *options))
            error = np.linalg.norm(found - np.asarray(direction)) / np.linalg.norm(direction)
            rows.append(Accuracy(tolerance, regularization, float(error)))
    return rows


@eqx.filter_jit
def _tangent(matrix, direction, tolerance, regularization):
    def update(x, p):
        return x - matrix @ (x - p * direction)

    one = (jnp.ones(()),)
    options = {"tolerance": tolerance, "regularization": regularization, "max_iter": 10_000}
    return fixed_point_tangent(update, direction, one, one, **options)


def solve(
    matvec: Callable[[Any], Any],
    right: Float[Array, "unknowns"],
    tolerance: float | Float[Array, ""] = 1e-12,
    regularization: float | Float[Array, ""] = 0.0,
    max_iter: int = 200,
) -> Float[Array, "unknowns"]:
    """Solve (A + regularization) x = right by differentiable conjugate gradients.

    Args:
        matvec: product with A, which is symmetric and positive definite.
        tolerance: tolerance of the residual, relative to the right-hand side.
        regularization: number added to the diagonal of A; the relative change of x is about regularization /
            smallest eigenvalue.

    Error: relative error of at most tolerance times the condition number.
    """

    def matrix(x):
        return matvec(x) + jnp.asarray(regularization, x.dtype) * x

    def conjugate(matvec, b):
        return cg(matvec, b, tol=tolerance, maxiter=max_iter)[0]  # type: ignore[arg-type]

    return jax.lax.custom_linear_solve(matrix, right, conjugate, symmetric=True)


def fixed_point_tangent(
    update: Callable[..., Float[Array, "unknowns"]],
    x: Float[Array, "unknowns"],
    parameters: tuple[Any, ...],
    tangents: tuple[Any, ...],
    **options: Any,
) -> Float[Array, "unknowns"]:
    """Return dx for x = update(x, *parameters) by the implicit function theorem: (1 - dG/dx) dx = dG/dp dp.

    Args:
        update: the function G; 1 - dG/dx must be symmetric and positive definite at x.
        x: a fixed point; the error of dx is about the distance of x from the exact fixed point.
        options: options of `solve`.
    """
    _, right = jax.jvp(lambda *given: update(x, *given), parameters, tangents)

    def matvec(dx):
        return dx - jax.jvp(lambda at: update(at, *parameters), (x,), (dx,))[1]

    return solve(matvec, right, **options)


def relaxation(tol: float, derivative: FixedPointRule | None = None) -> BallProblem:
    """Return the problem of a ball below the floor and one projection; the loss is the remaining penetration.

    Args:
        tol: tolerance of the projection, m.
        derivative: derivative of the fixed point, or None for the derivative of the iterations.
    """
    contact = Projection(K, ALPHA, GlobalSum(tol, 200), derivative=derivative)
    world = World.create(contact, SemiImplicitEuler(1.0), gravity=0.0)
    return BallProblem(world, np.array([-DEPTH]), 0.0, 1, ResidualPenetration(1))


def run() -> Demo:
    """Compare derivatives with respect to the gain, and the memory and accuracy of both methods."""
    runs = [relaxation(tol).run(keep=False) for tol in TOLERANCES]
    counts = [int(run.iterations[0]) for run in runs]
    ran = [relaxation(tol).value_and_grad(["k"]) for tol in TOLERANCES]
    unrolled = np.array([slopes["k"] for _, slopes in ran])
    fixed, near = (
        [relaxation(tol, rule).value_and_grad(["k"])[1]["k"] for tol in TOLERANCES]
        for rule in (FixedPointRule(), FixedPointRule(at_iterate=True))
    )
    said = Implicit()(relaxation(TOLERANCES[0]), ["k"])
    exact = [-DEPTH * n * (1 - ALPHA * K) ** (n - 1) * ALPHA for n in counts]
    order = np.polyfit(np.log(TOLERANCES), np.log(-unrolled), 1)[0]
    tapes = memory(ITERATIONS)
    solved = accuracy(SOLVES, condition=CONDITION)
    moved = accuracy(SOLVES[-1:], (1e-8, 1e-7, 1e-6, 1e-5), condition=CONDITION)
    rate = np.polyfit(np.log([a.tolerance for a in solved[1:]]), np.log([a.error for a in solved[1:]]), 1)[0]
    growth = tapes[-1].unrolled / tapes[-2].unrolled
    flat = tapes[-1].implicit / tapes[-2].implicit
    return Demo(
        title="Iterations and their fixed point have different derivatives",
        question=(
            "A projection returns a ball to the floor. How does the final position depend on the gain?"
        ),
        result=(
            f"The derivative of the fixed point is 0; through the iterations at a tolerance of 1e-2 it "
            f"is {unrolled[0]:.2g}."
        ),
        answer=(
            "The fixed point is the floor, so its derivative with respect to k is 0. Through the "
            f"{counts[0]}, {counts[1]} and {counts[2]} iterations at tolerances of 1e-2, 1e-4 and 1e-6 "
            f"the derivative is {unrolled[0]:.2g}, {unrolled[1]:.2g} and {unrolled[2]:.2g}: an artifact "
            f"that is proportional to the tolerance (power {order:.2f}). Reverse mode over n iterations "
            f"stores data of each iteration, {tapes[-1].unrolled / 2**20:.0f} MiB for 1,000 balls and "
            f"{ITERATIONS[-1]} iterations; the memory of the linear solve does not grow. The tolerance "
            f"of this solve, times the condition number, is an error of the derivative."
        ),
        numbers={
            "grad_k_unrolled": unrolled.tolist(),
            "grad_k_implicit": fixed,
            "tolerances": list(TOLERANCES),
            "iterations": counts,
            "power_of_tol": float(order),
            "depends_on_k": said.depends["k"],
            "memory_ratio_unrolled": growth,
            "memory_ratio_implicit": flat,
            "solve_error_power": float(rate),
        },
        checks=[
            Claim(
                "the unrolled derivative is that of p0 (1 - alpha k)^n",
                unrolled.tolist(),
                "to 1e-12 relative",
                bool(np.allclose(unrolled, exact, rtol=1e-12, atol=0)),
            ),
            Claim("the implicit derivative is 0 at every tolerance", fixed, "0", not np.any(fixed)),
            Claim("and mdnum says so", said.notes["k"], "does not depend on k", not said.depends["k"]),
            Claim(
                "the artifact is proportional to the tolerance",
                float(order),
                "a power of 0.9 to 1",
                bool(0.85 < order < 1.05),
            ),
            Claim(
                "the implicit derivative at the stopped iterate contains the tolerance as -p/k",
                near,
                "-p/k to 1e-10 relative",
                bool(np.allclose(near, [-value / K for value, _ in ran], rtol=1e-10, atol=0)),
            ),
            Claim(
                "ten times the iterations: memory of the unrolled derivative",
                growth,
                "8 to 11 times",
                bool(8 < growth < 11),
            ),
            Claim("and of the implicit one", flat, "1", flat == 1),
            Claim(
                f"at condition number {CONDITION:g} the error follows the tolerance of the solve",
                float(rate),
                "a power of 0.9 to 1.1",
                bool(0.9 < rate < 1.1),
            ),
        ],
        tables=[
            table(
                "derivative of the remaining penetration with respect to the gain k",
                (
                    "tolerance (m)",
                    "iterations",
                    "left (m)",
                    "unrolled",
                    "implicit",
                    "implicit at the iterate",
                ),
                tuple(
                    zip(
                        TOLERANCES,
                        counts,
                        (value for value, _ in ran),
                        unrolled.tolist(),
                        fixed,
                        near,
                        strict=True,
                    )
                ),
            ),
            _memory_table(tapes),
            _accuracy_table(solved, moved),
        ],
        plots=[_artefact(unrolled, near), _memory_plot(tapes), _accuracy_plot(solved)],
        in_md=(
            "Bond constraints (SHAKE), induced dipoles and relaxed structures are also fixed points: "
            "differentiating the iterations adds a term of the order of the tolerance."
        ),
        data={"says": {"implicit": said.description, "why": said.notes["k"]}},
    )


def _memory_table(tapes: list[Memory]) -> Table:
    return table(
        "temporaries of value and gradient, 1,000 balls in float64 (bytes)",
        ("iterations", "unrolled, taped", "unrolled, tangents carried along", "implicit", "loss alone"),
        tuple((row.iterations, row.unrolled, row.carried, row.implicit, row.value) for row in tapes),
    )


def _accuracy_table(solved: list[Accuracy], moved: list[Accuracy]) -> Table:
    return table(
        f"error of an implicit derivative, 200 coupled unknowns, condition number {CONDITION:g}",
        ("tolerance of the solve", "regularization", "relative error"),
        tuple((row.tolerance, row.regularization, row.error) for row in (*solved, *moved)),
    )


def _artefact(unrolled: np.ndarray, near: list[float]) -> Plot:
    x = np.array(TOLERANCES)
    return Plot(
        "tolerance-adds",
        title="Error of the derivative with respect to the gain, over the tolerance",
        x_label="tolerance (m)",
        y_label="|derivative by k| (m)",
        x_scale="log",
        y_scale="log",
        series=(
            Series("unrolled", x, -unrolled, "line+points", "bad"),
            Series("implicit at the stopped iterate", x, -np.array(near), "line+points", "second"),
            Series("proportional to the tolerance", x, x, "line", "muted", dashed=True),
        ),
        caption="The implicit derivative at the fixed point is exactly 0, and not shown on a "
        "logarithmic axis.",
    )


def _memory_plot(tapes: list[Memory]) -> Plot:
    x = np.array([row.iterations for row in tapes], float)
    return Plot(
        "memory-gradient",
        title="Memory of a gradient over the number of iterations",
        x_label="iterations",
        y_label="temporaries (bytes)",
        x_scale="log",
        y_scale="log",
        series=(
            Series(
                "unrolled, taped", x, np.array([row.unrolled for row in tapes], float), "line+points", "bad"
            ),
            Series(
                "tangents carried along", x, np.array([row.carried for row in tapes], float), "line+points"
            ),
            Series("implicit", x, np.array([row.implicit for row in tapes], float), "line+points", "second"),
        ),
        caption="Only the stored data of reverse mode grow (memory as planned by the compiler).",
    )


def _accuracy_plot(solved: list[Accuracy]) -> Plot:
    x = np.array([row.tolerance for row in solved])
    return Plot(
        "backward-solve",
        title="Error of the backward solve",
        x_label="tolerance of the solve",
        y_label="relative error of the derivative",
        x_scale="log",
        y_scale="log",
        series=(
            Series("measured", x, np.array([row.error for row in solved]), "line+points"),
            Series("tolerance times condition number", x, x * CONDITION, "line", "muted", dashed=True),
        ),
        caption="The derivative of an implicit function is only as accurate as its linear solve.",
    )
