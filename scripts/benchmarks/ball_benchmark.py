"""How fast is the simulation of a batch of recorded balls, and how long does its gradient take?

Answer. 10,000 balls take 1,000 steps in 1.3 s on a spring, 4.4 s with located impacts and 4.6 s with a
projection; a gradient takes a third to a half of these times. It takes 30 s.

Ten thousand balls take a thousand steps in three worlds (a spring floor, located impacts, a projection
that iterates), every contact and iteration recorded; then the loss and its gradient by one parameter and
the start height are worked out. Runs and gradients take turns, so that a busy machine is busy for both.
Seconds are medians over the turns, after compilation; the ratio is that of the medians.

How to read it. The ratio travels to other machines, seconds do not.
"""

from __future__ import annotations

from functools import partial

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, start, table
from _turns import in_turn

from mdnum import ball

WORLDS = {
    "spring": (ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3), "k"),
    "located impacts": (ball.Impact(0.8, 1e-6), ball.EventLocated(1e-3), "restitution"),
    "projection": (ball.Projection(0.5, 0.5, ball.PerInstance(1e-6)), ball.SemiImplicitEuler(1e-3), "k"),
}


def main() -> None:
    """Turns, and their table."""
    options = parser(__doc__)
    options.add_argument("--balls", type=int, default=10_000, help="balls of a batch")
    options.add_argument("--steps", type=int, default=1000, help="steps of 1 ms")
    options.add_argument("--turns", type=int, default=3, help="turns, of which medians are taken")
    chosen = options.parse_args()
    rows = []
    for name, (contact, scheme, parameter) in WORLDS.items():
        world = ball.World.create(contact, scheme)
        problem = ball.BallProblem(world, np.linspace(0.5, 1.5, chosen.balls), 0.0, chosen.steps)
        works = {"run": problem.run, "gradient": partial(problem.value_and_grad, [parameter, "y0"])}
        taken = in_turn(works, chosen.turns, name)
        run, both = (float(np.median(spent[1:, 0])) for spent in taken.values())
        rows.append((name, parameter, f"{run:.4f}", f"{both:.4f}", f"{both / run:.2f}"))
    title = f"{chosen.balls:,} balls, {chosen.steps:,} steps"
    table(title, ("world", "parameter", "run, s", "gradient, s", "ratio"), rows)


if __name__ == "__main__":
    start(main)
