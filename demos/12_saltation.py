"""The derivative through an impact includes the change of the impact time, which fixed steps omit."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from mdnum.ball import EventLocated, ExactImpact, Impact, SemiImplicitEuler, World, arrive
from mdnum.errors import InputError
from mdnum.numerics.saltation import carry
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

TIME = 2.0
COUNTS = (200, 632, 2000, 6325, 20_000, 63_246, 200_000)
#: The two orders in which a derivative and steps can be made.
FIRST, THEN = "discretize, then differentiate (steps)", "differentiate, then discretize (saltation)"
#: Those of 1e-2, 1e-3 and 1e-4 s.
DECADES = (0, 2, 4)
#: The ball of the headline first, then the batch that errors are averaged over.
STARTS = np.concatenate([[1.0], np.linspace(0.9, 1.1, 31)])


def saltated(world: World, y0: Float[Array, "balls"], steps: int, name: str) -> tuple[Array, Array]:
    """Return heights after a number of steps, and the derivative of the approximated exact motion.

    Impacts are reset at the end of a step. Between impacts the tangent is that of the flight; at an impact it
    is multiplied by the saltation matrix for the speed at which the simulated ball arrives.

    Raises:
        InputError: the parameter is not y0 or v0.
    """
    if name not in ("y0", "v0"):
        raise InputError(f"saltation along {name!r}; expected y0 or v0")
    return _saltated(world, y0, jnp.asarray(steps), name)


@eqx.filter_jit
def _saltated(world: World, y0: Array, steps: Array, name: str) -> tuple[Array, Array]:
    h, g, e = world.value("h"), world.gravity, world.value("restitution")
    zero, one = jnp.zeros_like(y0), jnp.ones_like(y0)
    reset = jnp.stack([jnp.stack([one, zero], -1), jnp.stack([zero, -e * one], -1)], -2)
    normal = jnp.stack([one, zero], -1)

    def step(_, carried):
        state, dy, dv = carried
        after, record = world.advance(state)
        speed = state.v - h * g
        before = jnp.stack([speed, -g * one], -1)
        later = jnp.stack([-e * speed, -g * one], -1)
        tangent = jnp.stack([dy + h * dv, dv], -1)
        through = carry(tangent, reset, before, later, normal)
        tangent = jnp.where(record.contact[:, None], through, tangent)
        return after, tangent[:, 0], tangent[:, 1]

    start = (world.start(y0, 0.0), one * float(name == "y0"), one * float(name == "v0"))
    state, dy, _ = lax.fori_loop(0, steps, step, start)
    return state.y, dy


def run() -> Demo:
    """Differentiate the height after three impacts with respect to the initial height, by three methods."""
    exact = np.array([float(ExactImpact(y).height(TIME).gradient["y0"]) for y in STARTS])
    heights = np.array([float(ExactImpact(y).height(TIME).value) for y in STARTS])
    naive = World.create(Impact(), SemiImplicitEuler(0.01))
    located = World.create(Impact(), EventLocated(TIME / 10))
    y0 = jnp.asarray(STARTS)

    def spread(error: np.ndarray) -> float:
        return float(np.sqrt(np.mean(error[1:] ** 2)))

    y, slope = (np.asarray(x) for x in arrive(located, y0, 10, "y0"))
    by_time, value_by_time = slope, float(np.max(np.abs(y - heights)))
    rows: list[tuple] = []
    values, by_steps, by_saltation = [], [], []
    for count in COUNTS:
        here = naive.with_values({"h": TIME / count})
        y, slope = (np.asarray(x) for x in arrive(here, y0, count, "y0"))
        values.append(spread(y - heights))
        by_steps.append(slope)
        by_saltation.append(np.asarray(saltated(here, y0, count, "y0")[1]))
        for how, found in ((FIRST, slope), (THEN, by_saltation[-1])):
            error = found - exact
            rows.append((how, TIME / count, float(found[0]), float(error[0]), spread(error)))
    error = by_time - exact
    rows.append(("time of impact", TIME / 10, float(by_time[0]), float(error[0]), spread(error)))
    h = TIME / np.array(COUNTS)
    restored = np.array([spread(slope - exact) for slope in by_saltation])
    missed = np.array([spread(slope - exact) for slope in by_steps])
    order = float(np.polyfit(np.log(h), np.log(restored), 1)[0])
    zero = all(np.all(slope == 0.0) for slope in by_steps)
    # up to the first impact, which is after 0.45 s
    flight = naive.with_values({"h": 0.004})
    apart = np.asarray(arrive(flight, y0[:1], 100, "y0")[1]) - np.asarray(
        saltated(flight, y0[:1], 100, "y0")[1]
    )
    return Demo(
        title="The derivative through an impact",
        question=("How does the height after three impacts depend on the initial height?"),
        result=(
            f"The derivative of the height with respect to the initial height is {exact[0]:.5f}. The "
            "derivative of the steps of the program is 0 at every step size; with the saltation "
            f"matrix the error is of order {order:.2f} in the step size."
        ),
        answer=(
            f"By {exact[0]:.5f} m per m. Discretize, then differentiate: the derivative of the steps is "
            "exactly 0 at every step size, because a step that puts the ball on the floor discards its "
            "previous height. Differentiate, then discretize: the tangent of the motion, with the "
            "saltation matrix "
            f"at each impact, is {by_saltation[-1][0]:.4f} at the smallest step, and its error shrinks with "
            f"order {order:.2f}. Without an impact the two derivatives agree. If the impact is located "
            f"inside the step, they agree, too: the remaining error is {abs(error[0]):.0e}."
        ),
        numbers={
            "exact": float(exact[0]),
            "discretize_then_differentiate": {f"{h[i]:g}": float(by_steps[i][0]) for i in DECADES},
            "differentiate_then_discretize": {f"{h[i]:g}": float(by_saltation[i][0]) for i in DECADES},
            "apart_without_impact": float(apart[0]),
            "saltation_error": {f"{h[i]:g}": float(abs(by_saltation[i][0] - exact[0])) for i in DECADES},
            "saltation_order": order,
            "time_of_impact_error": float(abs(error[0])),
            "height_order": float(np.polyfit(np.log(h), np.log(values), 1)[0]),
        },
        checks=(
            Claim(
                "differentiating the steps gives zero at every step size",
                float(max(np.max(np.abs(s)) for s in by_steps)),
                "exactly 0.0",
                zero,
            ),
            Claim(
                "before the first impact both derivatives agree",
                float(apart[0]),
                "exactly 0.0",
                bool(apart[0] == 0),
            ),
            Claim(
                "with the saltation matrix the error is of order h", order, "1 ± 0.2", abs(order - 1) < 0.2
            ),
            Claim(
                "with the time of impact the derivative is exact to rounding",
                float(np.max(np.abs(error))),
                "below 1e-12",
                bool(np.max(np.abs(error)) < 1e-12),
            ),
            Claim("so is the height", value_by_time, "below 1e-14", value_by_time < 1e-14),
        ),
        tables=(
            table(
                "Derivative of the height at 2 s with respect to the initial height",
                ("by", "h (s)", "derivative, from 1 m", "error", "error, 31 starts"),
                tuple(rows),
            ),
        ),
        plots=(
            Plot(
                "error-derivative",
                title="Error of the derivative over the step",
                x_label="h (s)",
                y_label="error of dy/dy0, root mean square",
                x_scale="log",
                y_scale="log",
                series=(
                    Series("steps", h, missed, "line+points", "bad"),
                    Series("steps and saltation", h, restored, "line+points", "first"),
                    Series("order 1", h, restored[-1] * h / h[-1], "line", "muted", dashed=True),
                ),
                caption="The error of the steps alone does not depend on h; with the saltation matrix it is "
                "of order 1.",
            ),
            _history(naive),
        ),
        in_md=(
            "When a pair crosses a hard cutoff, the force jumps. Without the saltation term the "
            "derivative does not contain the shift of the crossing time (0.360 instead of 0.4114 in "
            "pair/leaving-well)."
        ),
    )


def _history(world: World) -> Plot:
    """Return the derivative over time by all three methods."""
    time = np.linspace(0, TIME, 801)
    steps = np.arange(0, 201, 2)
    one = jnp.ones(1)
    plain = [float(np.asarray(arrive(world, one, int(n), "y0")[1])[0]) for n in steps]
    salted = [float(np.asarray(saltated(world, one, int(n), "y0")[1])[0]) for n in steps]
    motion = ExactImpact(1.0).height(time).gradient["y0"]
    return Plot(
        "derivative-along",
        title="The derivative over time, from 1 m with h = 0.01 s",
        x_label="time (s)",
        y_label="dy/dy0",
        series=(
            Series("exact", time, motion, "line", "ink"),
            Series("steps", steps * 0.01, np.array(plain), "line", "bad"),
            Series("steps and saltation", steps * 0.01, np.array(salted), "points", "first"),
        ),
        caption="All derivatives agree up to the first impact, at which the derivative of the steps "
        "becomes zero.",
    )
