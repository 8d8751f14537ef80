"""Precision, accuracy, stability, conditioning and discretization error of one run, each as a number."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from mdnum.ball import ExactPenalty, Penalty, SemiImplicitEuler, World, arrive
from mdnum.numerics import RolePrecision, unit_roundoff
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: Stiffness of the floor, 1/s²; time, s; the run that is examined: precision, step (s), start (m).
K, TIME, RUN = 1e4, 2.0, ("float32", 1e-3, 1.0)
#: What is changed: everything else is as in the run.
CHANGED = {
    "the run": RUN, "float64": ("float64", 1e-3, 1.0), "float16": ("float16", 1e-3, 1.0),
    "five times the step": ("float32", 5e-3, 1.0), "beyond the stability limit": ("float32", 0.0205, 1.0),
    "started 2 cm up": ("float32", 1e-3, 0.02),
}  # fmt: skip
HEAD = ("unit roundoff", "rounding error (m)", "discretization error (m)", "h sqrt(k) / 2", "condition "
"number",
        "error (m)")  # fmt: skip


def five(worlds: dict[str, World], precision: str, h: float, y0: float) -> tuple[float, ...]:
    """Return the numbers named in `HEAD` for the final height of a run."""
    steps = round(TIME / h)
    known = ExactPenalty(y0, 0.0, 9.81, K, 0.0).height(steps * h)
    exact, slope = float(known.value), float(known.gradient["y0"])

    def height(name: str) -> float:
        start = jnp.full(1, y0, worlds[name].policy.dtype("state"))
        return float(np.asarray(arrive(worlds[name].with_values({"h": h}), start, steps, "k")[0])[0])

    here, wide = height(precision), height("float64")
    stability = h * np.sqrt(K) / 2
    return (unit_roundoff(worlds[precision].policy.dtype("state")), abs(here - wide), abs(wide - exact),
            float(stability), abs(slope * y0 / exact), abs(here - exact))  # fmt: skip


def run() -> Demo:
    """Compute the five numbers for one run, and for runs in which one setting is changed."""
    worlds = {name: World.create(Penalty(K), SemiImplicitEuler(1e-3), policy=RolePrecision.all(name))
              for name in ("float64", "float32", "float16")}  # fmt: skip
    found = {what: five(worlds, *changed) for what, changed in CHANGED.items()}
    thrown = found["beyond the stability limit"][5]
    roundoff, rounding, steps, stability, condition, error = found["the run"]
    largest = {HEAD[k]: max(found, key=lambda what, k=k: found[what][k] if found[what][3] < 1 else -1)
               for k in (1, 2, 4)}  # fmt: skip
    h = 1e-3 / 2 ** np.arange(-2.0, 6)
    runs = {name: np.array([five(worlds, name, one, 1.0) for one in h]) for name in worlds}
    return Demo(
        title="Five things that are called error",
        question=(
"A ball on a stiff floor is simulated for 2000 steps in float32: how accurate is its "
"height after 2 s, and why?"
),
        result=(
f"The error of the height is {error:.1e} m, although the rounding error is {rounding:.1e} "
f"m and the discretization error {steps:.1e} m: in this run the two cancel. Five "
"different quantities describe the errors of the run."
),
        answer=f"Precision is {roundoff:.1e}, and it is the same for every run in float32. The rounding "
        f"error is the difference from the same program in float64. The discretization error is the "
        f"difference of the float64 run from the exact motion. h sqrt(k) is {100 * stability:.0f} % of "
        f"its limit, so that neither error grows; the motion itself multiplies a relative error of the "
        f"initial height by {condition:.1f}. "
        "If one setting is changed, mainly one number changes: float16 has another rounding error, a "
        "longer step has another discretization error, a step beyond the limit makes the run unstable, "
        "and a start 2 cm above the floor makes the same program 29 times as sensitive.",
        numbers={
            "precision": roundoff, "rounding": rounding, "discretization": steps, "stability": stability,
            "condition": condition, "error": error, "largest": largest,
            "unstable_error": thrown, "condition_near_the_floor": found["started 2 cm up"][4],
        },
        checks=[
            Claim("the errors of the run cancel", error, f"below {rounding:.1e} and {steps:.1e}",
                  error < min(rounding, steps)),
            Claim("rounding is largest in", largest[HEAD[1]], "float16", largest[HEAD[1]] == "float16"),
            Claim("the discretization error is largest with", largest[HEAD[2]], "five times the step",
                  largest[HEAD[2]] == "five times the step"),
            Claim("the condition number is largest when", largest[HEAD[4]], "started 2 cm up",
                  largest[HEAD[4]] == "started 2 cm up"),
            Claim("a step beyond the stability limit makes the other numbers meaningless", thrown,
                  "above 1 m", thrown > 1),
        ],
        tables=[table("one run, and runs with one changed setting", ("run", *HEAD),
                      [(what, *values) for what, values in found.items()])],
        plots=[Plot("errors", "Error of the height over the step", "h (s)", "error (m)", (
            Series("discretization", h, runs["float64"][:, 2], "line+points", "ink"),
            Series("rounding, float32", h, runs["float32"][:, 1], "line+points"),
            Series("rounding, float16", h, runs["float16"][:, 1], "line+points", "bad"),
        ), x_scale="log", y_scale="log", caption="A shorter step reduces the discretization error and "
            "increases the rounding error.")],
        in_md=(
"The five quantities of a simulation are its dtype, the difference from a reference "
"code, half of dt times the fastest frequency, the growth of a displacement, and the "
"change when dt is halved."
),
    )  # fmt: skip
