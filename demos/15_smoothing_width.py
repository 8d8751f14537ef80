"""A softplus contact: the effect of its width on the loss, and the resulting bias."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from mdnum.ball import BallVerlet, ExactPenalty, Penalty, SemiImplicitEuler, World, arrive
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

K, TIME, STEPS = 3000.0, 2.0, 200
WIDTHS = (0.0, 0.001, 0.003, 0.01, 0.02, 0.03, 0.05, 0.1)
#: Widths small enough to see the order of the bias, and steps fine enough to see nothing else.
NARROW, FINE = (0.002, 0.004), 40_000
#: The start that the loss asks for.
WANTED = 1.0
STARTS = np.linspace(0.9, 1.1, 1001)
#: Of these, those that are compared with the exact motion.
SOME = slice(None, None, 10)
SHOWN = {0.0: "bad", 0.01: "second", 0.03: "first", 0.1: "third"}


@dataclass(frozen=True)
class Landscape:
    """Loss of one program as a function of the initial height.

    Attributes:
        loss, slope: the loss, m², and the derivative of the final height with respect to the initial height.
        minima: local minima of the loss inside the window.
        best: initial height with the lowest loss, m.
        rough: standard deviation of the derivative from the derivative of the exact motion.
    """

    loss: np.ndarray
    slope: np.ndarray
    minima: int
    best: float
    rough: float


def run() -> Demo:
    """Find the initial height for a given final height, on floors of increasing softness."""
    motion = [ExactPenalty(float(y), k=K).height(TIME) for y in STARTS[SOME]]
    known = np.array([float(one.gradient["y0"]) for one in motion])
    target = float(ExactPenalty(WANTED, k=K).height(TIME).value)
    exact = (np.array([float(one.value) for one in motion]) - target) ** 2
    h = TIME / STEPS
    hard = World.create(Penalty(K), SemiImplicitEuler(h))
    soft = World.create(Penalty(K, eps=0.01, smooth=True), SemiImplicitEuler(h))
    found: dict[float, Landscape] = {}
    for eps in WIDTHS:
        world = soft.with_values({"eps": eps}) if eps else hard
        y, slope = (np.asarray(x) for x in arrive(world, jnp.asarray(STARTS), STEPS, "y0"))
        loss = (y - target) ** 2
        inside = (loss[1:-1] < loss[:-2]) & (loss[1:-1] <= loss[2:])
        found[eps] = Landscape(
            loss,
            slope,
            int(np.sum(inside)),
            float(STARTS[np.argmin(loss)]),
            float(np.std(slope[SOME] - known)),
        )
    travel = h * float(np.sqrt(2 * 9.81 * WANTED))
    single = min(eps for eps, one in found.items() if one.minima == 1)
    order = _order_of_bias()
    bias = {eps: one.best - WANTED for eps, one in found.items()}
    calm = min(WIDTHS, key=lambda eps: found[eps].rough)
    return Demo(
        title="How soft a floor",
        question=(
            "Which width of a softplus contact makes the loss suitable for optimization, and how "
            "large is the bias?"
        ),
        result=(
            f"With a contact {single:g} m wide, one of {found[0.0].minima} minima remains; at 0.1 m "
            f"this minimum has moved by {bias[0.1]:.3f} m."
        ),
        answer=(
            f"With a hard contact the loss has {found[0.0].minima} minima and its derivative has an "
            f"error of {found[0.0].rough:.0f}, while the exact derivative is about 2. From a width of "
            f"{single:g} m on, "
            f"{single / travel:.1f} of the distance that the ball falls in one step, one minimum "
            f"remains; at "
            f"{calm:g} m the derivative has an error of {found[calm].rough:.3f}. But a softer floor "
            f"changes the problem: at 0.1 m the minimum has moved by {bias[0.1]:.3f} m. For small "
            f"widths the bias grows "
            f"as the width to the power {order:.2f}."
        ),
        numbers={
            "minima_hard": found[0.0].minima,
            "one_minimum_from": single,
            "one_minimum_from_in_steps_of_fall": single / travel,
            "gradient_error_hard": found[0.0].rough,
            "gradient_error_calmest": found[calm].rough,
            "calmest_width": calm,
            "minimizer_shift_at_0.1": bias[0.1],
            "order_of_bias": order,
        },
        checks=(
            Claim(
                "a hard contact has many minima, a soft contact has a single minimum",
                [found[0.0].minima, found[single].minima],
                "above 20, and 1",
                found[0.0].minima > 20 and found[single].minima == 1,
            ),
            Claim(
                "the error of the derivative decreases by a factor of at least a thousand",
                found[0.0].rough / found[calm].rough,
                "above 1000",
                found[0.0].rough > 1000 * found[calm].rough,
            ),
            Claim(
                "and then the bias takes over",
                [bias[calm], bias[WIDTHS[-1]]],
                "the largest width shifts the minimum at least five times as far as the best width",
                abs(bias[WIDTHS[-1]]) > 5 * abs(bias[calm]),
            ),
            Claim("the bias of small widths is quadratic", order, "2 ± 0.1", abs(order - 2) < 0.1),
        ),
        tables=(
            table(
                f"Initial height that ends at the given height after 2 s: k = {K:g} 1/s², h = {h:g} s",
                ("width (m)", "minima", "best start (m)", "shift (m)", "error of dy/dy0", "largest |dy/dy0|"),
                tuple(
                    (eps, one.minima, one.best, bias[eps], one.rough, float(np.abs(one.slope).max()))
                    for eps, one in found.items()
                ),
            ),
        ),
        plots=(
            Plot(
                "loss",
                title="The loss",
                x_label="height at the start (m)",
                y_label="(y(2 s) - wanted)² (m²)",
                series=(
                    *(_series(eps, found[eps].loss) for eps in SHOWN),
                    Series("exact, hard", STARTS[SOME], exact, "line", "ink", dashed=True),
                ),
                verticals=((WANTED, "wanted"),),
                caption="With a hard contact there are many minima around the exact curve, with a soft "
                "contact one shifted minimum.",
            ),
            Plot(
                "derivative-that",
                title="The derivative that an optimizer would follow",
                x_label="height at the start (m)",
                y_label="dy/dy0",
                y_scale="symlog",
                series=(
                    *(_series(eps, found[eps].slope) for eps in SHOWN),
                    Series("exact, hard", STARTS[SOME], known, "line", "ink", dashed=True),
                ),
                caption="With a hard contact the sign of the derivative is determined by the last step "
                "of the contact.",
            ),
            Plot(
                "trade",
                title="The trade",
                x_label="width (m)",
                y_label="error",
                x_scale="log",
                y_scale="log",
                series=(
                    Series(
                        "error of the derivative",
                        np.array(WIDTHS[1:]),
                        np.array([found[eps].rough for eps in WIDTHS[1:]]),
                        "line+points",
                        "bad",
                    ),
                    Series(
                        "shift of the minimum (m)",
                        np.array(WIDTHS[1:]),
                        np.array([max(abs(bias[eps]), 1e-4) for eps in WIDTHS[1:]]),
                        "line+points",
                        "first",
                    ),
                ),
                verticals=((travel, "fall in one step"),),
                caption="The best width is half the distance moved in one step; for larger widths only "
                "the bias grows.",
            ),
        ),
        in_md=(
            "This is the switching width of a cutoff: if it is wide enough to be resolved by the "
            "steps, forces and gradients are smooth, but the simulated potential is a different one."
        ),
        data={
            "minima": {f"{eps:g}": one.minima for eps, one in found.items()},
            "gradient_error": {f"{eps:g}": one.rough for eps, one in found.items()},
            "minimizer_shift": {f"{eps:g}": value for eps, value in bias.items()},
        },
    )


def _series(eps: float, values: np.ndarray) -> Series:
    label = f"width {eps:g} m" if eps else "hard"
    return Series(label, STARTS, values, "line", SHOWN[eps])  # type: ignore[arg-type]


def _order_of_bias() -> float:
    """Return the order of the bias of the final height relative to a hard floor, without time-step errors."""
    starts = STARTS[::100]
    exact = np.array([float(ExactPenalty(float(y), k=K).height(TIME).value) for y in starts])
    world = World.create(Penalty(K, eps=0.01, smooth=True), BallVerlet(TIME / FINE))
    off = []
    for eps in NARROW:
        y, _ = arrive(world.with_values({"eps": eps}), jnp.asarray(starts), FINE, "y0")
        off.append(np.sqrt(np.mean((np.asarray(y) - exact) ** 2)))
    return float(np.log(off[1] / off[0]) / np.log(NARROW[1] / NARROW[0]))
