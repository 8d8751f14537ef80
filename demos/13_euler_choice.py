"""Explicit and semi-implicit Euler differ in the order of two lines, and have different gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mdnum.ball import (
    BallVerlet,
    ExactPenalty,
    ExplicitEuler,
    ImplicitMidpoint,
    Penalty,
    SemiImplicitEuler,
    World,
    arrive,
    simulate,
)
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

K, TIME, STEPS = 100.0, 2.0, 200
COUNTS = (400, 800, 1600, 3200, 6400)
SCHEMES: dict[str, Any] = {
    "explicit Euler": ExplicitEuler,
    "semi-implicit Euler": SemiImplicitEuler,
    "velocity Verlet": BallVerlet,
    "implicit midpoint": ImplicitMidpoint,
}
EULERS = tuple(SCHEMES)[:2]
#: The ball of the headline first.
STARTS = np.concatenate([[1.0], np.linspace(0.8, 1.2, 16)])
ROLES = ("bad", "first", "second", "third")


@dataclass(frozen=True)
class Convergence:
    """Errors at one time for several step sizes.

    Attributes:
        h: time steps, s, shape (sizes,).
        value: root mean square error of the height over the batch, m, shape (sizes,).
        slope: root mean square error of the derivative of the height, shape (sizes,).
        largest: largest magnitude of the derivatives of the program, shape (sizes,).
    """

    h: Float[np.ndarray, "sizes"]
    value: Float[np.ndarray, "sizes"]
    slope: Float[np.ndarray, "sizes"]
    largest: Float[np.ndarray, "sizes"]

    def order(self, of: str = "value") -> float:
        """Return the exponent p of error ~ h^p: the slope of a straight line through the logarithms."""
        return float(np.polyfit(np.log(self.h), np.log(getattr(self, of)), 1)[0])


def converge(
    world: World,
    exact: Callable[[float], ExactPenalty],
    y0: Float[np.ndarray, "balls"],
    time: float,
    counts: Sequence[int],
    name: str = "y0",
) -> Convergence:
    """Run a batch to the same time with several step sizes and compare with the exact motion.

    Args:
        world: world of the ball; its time step is replaced.
        exact: function from an initial height to the exact motion.
        y0: initial heights, m.
        time: time at which heights are compared, s.
        counts: numbers of steps.
        name: parameter with respect to which heights are differentiated.
    """
    known = [exact(float(y)).height(time) for y in y0]
    heights = np.array([float(one.value) for one in known])
    slopes = np.array([float(one.gradient[name]) for one in known])
    errors = []
    for count in counts:
        here = world.with_values({"h": time / count})
        y, dy = arrive(here, jnp.asarray(y0), count, name)
        off = (np.asarray(y) - heights, np.asarray(dy) - slopes)
        errors.append([*(np.sqrt(np.mean(x**2)) for x in off), np.max(np.abs(np.asarray(dy)))])
    return Convergence(time / np.asarray(counts, np.float64), *np.array(errors).T)


def run() -> Demo:
    """Bounce a ball on a spring floor with four schemes and compare heights and derivatives."""
    exact = ExactPenalty(1.0, k=K)
    end, h = exact.height(TIME), TIME / STEPS
    worlds = {name: World.create(Penalty(K), scheme(h)) for name, scheme in SCHEMES.items()}
    rows, orders, found, lines, slopes, paths, first = [], {}, {}, [], [], [], {}
    for (name, world), role in zip(worlds.items(), ROLES, strict=True):
        made = converge(world, lambda y: ExactPenalty(y, k=K), STARTS, TIME, COUNTS)
        orders[name] = (made.order(), made.order("slope"))
        lines.append(Series(name, made.h, made.value, "line+points", role))
        slopes.append(Series(name, made.h, made.slope, "line+points", role))
        found[name] = _first(world, "y0")
        if name in EULERS:
            found[name] += _first(world, "k")[1:]
            path = simulate(world, world.start(1.0), STEPS)
            first[name] = int(path.first_contact[0])
            paths.append(Series(name, path.time, path.y[:, 0], "line", role))
        rows.append((name, *found[name], *([None] if len(found[name]) == 2 else [])))
    rows.append(("exact", *(float(x) for x in (end.value, end.gradient["y0"], end.gradient["k"]))))
    time = np.linspace(0, TIME, 401)
    explicit, semi = found["explicit Euler"], found["semi-implicit Euler"]
    grown = float(explicit[0] / float(end.value))
    opposite = explicit[1] * semi[1] < 0
    return Demo(
        title="Two Eulers, two gradients",
        question=(
            "A step can move the ball with the old or with the new velocity. Does this affect the result?"
        ),
        result=(
            f"Depending on the order of two lines, the derivative after 2 s is {explicit[1]:+.3f} or "
            f"{semi[1]:+.3f} (exact: {float(end.gradient['y0']):+.3f})."
        ),
        answer=(
            f"The two programs differ in the order of two lines. After 2 s with h = {h:g} s the ball is "
            f"at {explicit[0]:.3f} and {semi[0]:.3f} m (exact: {float(end.value):.3f}), with "
            f"derivatives with respect to the initial height of {explicit[1]:.3f} and {semi[1]:.3f} "
            f"(exact: {float(end.gradient['y0']):.3f})"
            + (": not even the sign agrees. " if opposite else ". ")
            + "Both numbers are exact derivatives of their own program, and both approach the "
            "derivative of the motion with order 1. Schemes of order 2 have order 2 in the height, "
            "but only order 1 in the derivative."
        ),
        numbers={
            "dy_dy0_explicit": explicit[1],
            "dy_dy0_semi_implicit": semi[1],
            "dy_dy0_exact": float(end.gradient["y0"]),
            "dy_dk_explicit": explicit[2],
            "dy_dk_semi_implicit": semi[2],
            "dy_dk_exact": float(end.gradient["k"]),
            "first_contact_explicit": first["explicit Euler"],
            "first_contact_semi_implicit": first["semi-implicit Euler"],
            "order_of_height": {name: value for name, (value, _) in orders.items()},
            "order_of_derivative": {name: slope for name, (_, slope) in orders.items()},
        },
        checks=(
            Claim(
                "the gradients of the two programs differ by more than the exact gradient",
                abs(explicit[1] - semi[1]),
                f"above {abs(float(end.gradient['y0'])):.3g}",
                abs(explicit[1] - semi[1]) > abs(float(end.gradient["y0"])),
            ),
            Claim(
                "semi-implicit Euler is closer, in height and in both derivatives",
                [abs(x - y) for x, y in zip(semi, rows[-1][1:], strict=True)],
                "each below explicit Euler's error",
                all(abs(s - x) < abs(e - x) for e, s, x in zip(explicit, semi, rows[-1][1:], strict=True)),
            ),
            *(
                Claim(
                    f"{name}: order {order} in the height, 1 in the derivative",
                    [round(x, 2) for x in orders[name]],
                    f"{order} ± 0.2 and 1 ± 0.25",
                    abs(orders[name][0] - order) < 0.2 and abs(orders[name][1] - 1) < 0.25,
                )
                for name, order in zip(SCHEMES, (1, 1, 2, 2), strict=True)
            ),
        ),
        tables=(
            table(
                f"After {STEPS} steps of {h:g} s on a floor of k = {K:g} 1/s²",
                ("scheme", "height (m)", "dy/dy0", "dy/dk (m s²)"),
                tuple(rows),
            ),
        ),
        plots=(
            Plot(
                "ball-both",
                title="The ball by both programs",
                x_label="time (s)",
                y_label="height (m)",
                series=(
                    Series("exact", time, exact.height(time).value, "line", "ink", dashed=True),
                    *paths,
                ),
                horizontals=((0.0, "floor"),),
                caption="Explicit Euler gains energy in every contact; semi-implicit Euler does not.",
            ),
            _against_step("height", "Error of the height against the step", "error of y (m)", lines),
            _against_step("slope", "Error of the derivative against the step", "error of dy/dy0", slopes),
        ),
        in_md=(
            "The integrator is part of the program that is differentiated: velocity Verlet and "
            "leapfrog with different half steps have different gradients. If the derivative of the "
            "force is not continuous, the order of the gradient is lower by one."
        ),
        data={"energy_gain": grown},
    )


def _first(world: World, name: str) -> list[float]:
    """Return the height of the first ball and its derivative."""
    return [float(np.asarray(x)[0]) for x in arrive(world, jnp.asarray(STARTS), STEPS, name)]


def _against_step(name: str, title: str, label: str, lines: list[Series]) -> Plot:
    return Plot(
        name,
        title=title,
        x_label="h (s)",
        y_label=f"{label}, root mean square",
        x_scale="log",
        y_scale="log",
        series=tuple(lines),
    )
