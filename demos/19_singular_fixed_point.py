"""An implicit derivative at a singular fixed point, and the effect of a regularization."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mdnum import numerics
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: Loads, and stiffnesses that are added to the system of the implicit derivative.
LOADS, ADDED = (1e-3, 8e-6, 1e-9, 1e-12, 0.0), (1e-6, 1.2e-3, 1e-2)
#: Condition number that leaves a derivative no more than half of its digits, where it is refused.
REFUSED, ITERATIONS = 1 / np.sqrt(numerics.unit_roundoff(np.dtype(float))), 1000


def update(x: jax.Array, p: jax.Array, spring: jax.Array | float = 0.0) -> jax.Array:
    """Return a step toward the rest position under a load p, in the well x⁴/4 with a linear spring."""
    return x - (x**3 + spring * x - p)


def implicit(x: float, p: float, added: float = 0.0, spring: float = 0.0) -> float:
    """Return dx/dp = dG/dp / (1 - dG/dx + added) at a fixed point x = G(x, p)."""
    at = jnp.asarray(x), jnp.asarray(p)
    by_x, by_p = jax.grad(lambda x, p: update(x, p, spring), (0, 1))(*at)
    return float(by_p / (1 - by_x + added))


def rest(p: float, spring: float) -> float:
    """Return the rest position of the bead under a load on both springs, by Newton's method."""
    x = np.cbrt(p) + 1.0
    for _ in range(200):
        x -= (x**3 + spring * x - p) / (3 * x * x + spring)
    return float(x)


def told(value: float | bool) -> float | bool | str:
    """Return a number for a table, with infinity as text, because tables contain only finite numbers."""
    return "infinite" if value == np.inf else value


def run() -> Demo:
    """Compute derivatives for loads that approach the singular load, then with added stiffness."""
    at = [float(np.cbrt(p)) for p in LOADS]
    plain = [implicit(x, p) for x, p in zip(at, LOADS, strict=True)]
    exact = [np.inf if p == 0 else p ** (-2 / 3) / 3 for p in LOADS]
    # of 1 - dG/dx = 3 x², beside a spring of stiffness 1
    conditions = [np.inf if x == 0 else 1 / (3 * x * x) for x in at]
    refused = [bool(c > REFUSED) for c in conditions]
    solved = {a: [implicit(x, p, added=a) for x, p in zip(at, LOADS, strict=True)] for a in ADDED}
    moved = {a: [implicit(rest(p, a), p, spring=a) for p in LOADS] for a in ADDED}
    h, spring = 1e-9, ADDED[1]
    real = (rest(LOADS[1] + h, spring) - rest(LOADS[1] - h, spring)) / (2 * h)
    x, slope = 0.5, 0.0
    for _ in range(ITERATIONS):
        # the iterations at the singular load, and their derivative carried along
        x, slope = x - x**3, slope * (1 - 3 * x * x) + 1
    ends = [solved[spring][-1], moved[spring][-1]]
    known = (conditions, refused, exact, plain)
    half = solved[spring][1] / exact[1]
    kink = float(jax.grad(lambda p: jnp.maximum(p, 0.0))(0.0))
    return Demo(
        title="A fixed point whose derivative does not exist",
        question=(
"The equilibrium position of a bead under a load p is x = p^(1/3). What is dx/dp at zero "
"load?"
),
        result=f"dx/dp is infinite at p = 0 and {plain[1]:.2f} at 8e-6. A regularization of {spring:g} in "
        f"the linear solve halves the value at 8e-6, and gives {solved[spring][-1]:.2f} at p = 0, the "
        f"inverse of the regularization.",
        answer=f"The linear system divides by 1 - dG/dx = 3 x^2. If a stiffness is added to this system "
        f"alone, the result is a finite number, but not the derivative of any problem. If the stiffness "
        f"is added to the energy, the result is the exact derivative of another problem, in which the "
        f"bead rests at another position. At p = 0 both results are the inverse of the stiffness. "
        f"Iterations do not help: after {ITERATIONS} iterations x is still {x:.4f}, and their "
        f"derivative is {slope / ITERATIONS:.2f} times their number.",
        numbers={
            "derivative": plain[:-1], "half": half, "at_zero": {f"{a:g}": s[-1] for a, s in solved.items()},
            "condition": conditions[:-1], "refused": refused, "left_after_iterations": x,
            "slope_of_iterations": slope, "derivative_of_max_at_kink": kink,
        },
        checks=[
            Claim("away from the singular point the implicit derivative is correct", plain[1], "833.33 "
                "to 1e-12",
                  bool(np.isclose(plain[1], exact[1], rtol=1e-12))),
            Claim("at it there is none", plain[-1], "inf", plain[-1] == np.inf),
            Claim("a stiffness of 3 x^2 in the solve halves it", half, "0.5", abs(half - 0.5) < 1e-12),
            Claim("with a spring in the energy the derivative is that of the changed problem",
                  moved[spring][1], f"{real:.6g} to 1e-5",
                  abs(moved[spring][1] / real - 1) < 1e-5),
            Claim("at p = 0 both results are 1 / stiffness", ends, f"{1 / spring:.2f}",
                  bool(np.allclose(ends, 1 / spring, rtol=1e-9))),
            Claim("at the kink of max(0, p), where no derivative exists, JAX returns", kink, "1/2",
                  kink == 0.5),
        ],
        tables=[table("dx/dp", ("p", "condition number", "refused", "exact", "implicit", *(
            f"{a:g} in the {what}" for what in ("solve", "energy") for a in ADDED)), list(zip(
                LOADS, *(map(told, one) for one in known), *solved.values(), *moved.values(), strict=True)))],
        plots=[Plot("regularized", "The derivative and its regularizations", "p", "dx/dp", (
            Series("exact", np.array(LOADS[:-1]), np.array(exact[:-1]), "line+points", "ink"),
            *(Series(f"{a:g} in the solve", np.array(LOADS[:-1]), np.array(solved[a][:-1]), "line", role)
              for a, role in zip(ADDED, ("first", "second", "third"), strict=True)),
        ), x_scale="log", y_scale="log", caption="At p = 0 each regularized derivative is the inverse "
            "of the regularization.")],
        in_md=(
"For a structure with a soft mode, the smallest eigenvalue of the Hessian vanishes, and "
"the derivatives of all relaxed positions diverge. A Tikhonov term hides this problem, "
"but does not solve it."
),
    )  # fmt: skip
