"""Residuals of 9.96e-4 and 1.004e-3 at a tolerance of 1e-3, and their effect on each run."""

from __future__ import annotations

import numpy as np

from mdnum.ball import BallProblem, GlobalSum, Projection, ResidualPenetration, SemiImplicitEuler, World
from mdnum.numerics import Threshold
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

TOL, RESIDUALS, K, ALPHA, E, G, H = 1e-3, (9.96e-4, 1.004e-3), 0.5, 0.5, 0.8, 9.81, 2.5e-4
#: Speed (m/s) with which the ball is thrown down, and steps that are made.
SPEED, STEPS = 4.0, 3000


def bounces(y: float) -> dict[str, np.ndarray]:
    """Simulate a ball thrown down; each step starts from the penetration left by the solver.

    Returns:
        heights (m), iterations and contacts of each step.
    """
    v, rule, rows = -SPEED, Threshold(TOL, "<", "residual"), []
    for _ in range(STEPS):
        v -= H * G
        y += H * v
        touches, iterations = y < 0, 0
        while touches and not rule.decide(-y):
            y -= ALPHA * K * y
            iterations += 1
        v = -E * v if touches and v < 0 else v
        rows.append((y, iterations, touches))
    return dict(zip(("y", "iterations", "contact"), map(np.array, zip(*rows, strict=True)), strict=True))


def run() -> Demo:
    """Make one stopping decision with both residuals, then the same decision within a bounce."""
    rule = Projection(K, ALPHA, GlobalSum(TOL, 100))
    world = World.create(rule, SemiImplicitEuler(1.0), gravity=0.0)
    problems = [BallProblem(world, np.array([-s]), 0.0, 1, ResidualPenetration(1)) for s in RESIDUALS]
    made = [problem.value_and_grad(["k"]) for problem in problems]
    left, slopes = [value for value, _ in made], [slope["k"] + 0.0 for _, slope in made]
    # both arrive with the same velocity in the first step, with the one residual or the other
    fall = H * (SPEED + H * G)
    runs = [bounces(fall - s) for s in RESIDUALS]
    lasts = [int(np.argmin(one["contact"])) for one in runs]
    again = [int(np.flatnonzero(one["contact"][n:])[0]) + n + 1 for one, n in zip(runs, lasts, strict=True)]
    apart = np.abs(runs[0]["y"] - runs[1]["y"])
    jump = float(runs[1]["y"][0] - runs[0]["y"][0])
    exact = -ALPHA * RESIDUALS[1]
    return Demo(
        title="Two residuals on either side of a tolerance",
        question=(
"The residual S is 9.96e-4 in one run and 1.004e-3 in another, and the tolerance is "
"1e-3. What happens next?"
),
        result=f"With S = 9.96e-4 the solver stops, with S = 1.004e-3 it makes one more iteration: the "
        f"ball that was lower by 8e-6 m ends higher by {jump:.3g} m, its contact lasts {lasts[1]} step "
        f"instead of {lasts[0]}, and its next contact begins at step {again[1]} instead of {again[0]}.",
        answer=f"The run that stops leaves a penetration of {left[0]:.3g} m, which does not depend on "
        f"k: the derivative "
        f"is exactly {slopes[0]:g}. The other run leaves {left[1]:.3g} m with a derivative of "
        f"{slopes[1]:.3g}. A difference of 0.8 % in the residual becomes a difference of a quarter of "
        f"the penetration, and from then on the ball touches the floor in different steps.",
        numbers={
            "left": left, "grad_k": slopes, "iterations": [int(one["iterations"][0]) for one in runs],
            "jump": jump, "contact_lasts": lasts, "next_contact": again,
            "contacts": [int(one["contact"].sum()) for one in runs], "largest_separation": float(apart.max()),
        },
        checks=[
            Claim("one stops, the other makes an iteration", [int(one["iterations"][0]) for one in runs],
                  "0 and 1", [int(one["iterations"][0]) for one in runs] == [0, 1]),
            Claim("an iteration reduces the penetration by the factor 1 - alpha k", left[1], "0.75 of "
                "1.004e-3",
                  bool(np.isclose(left[1], 0.75 * RESIDUALS[1], rtol=1e-12))),
            Claim("without an iteration nothing depends on k", slopes[0], "exactly 0", slopes[0] == 0),
            Claim("with one the derivative is -alpha S", slopes[1], f"{exact:.4g} to 1e-12",
                  bool(np.isclose(slopes[1], exact, rtol=1e-12))),
            Claim("later contacts begin at other steps", again, "two different steps", again[0] != again[1]),
        ],
        tables=[table("the two runs", ("S", "decision", "left (m)", "dleft/dk (m)", "contact lasts",
                                       "next contact begins"),
                      list(zip(RESIDUALS, ("stop", "go on"), left, slopes, lasts, again, strict=True)))],
        plots=[Plot("separation", "Distance of the two runs", "step", "|difference of heights| (m)",
                    (Series("", np.arange(1, STEPS + 1), apart),), y_scale="log",
                    caption="The distance is 8e-6 m before the decision, and thirty times as large "
                    "after it. If a contact begins a step earlier in one run, the distance jumps.")],
        in_md=(
"If a minimizer, SHAKE or a self-consistent field stops one iteration earlier, the "
"positions differ, and a list that is built from them may contain another pair."
),
    )  # fmt: skip
