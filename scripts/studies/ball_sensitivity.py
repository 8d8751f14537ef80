"""How do a bouncing ball's decisions, loss and gradient answer to h, k, tol and eps?

Answer. The step moves the first contact by whole steps, and the loss by up to 8 %. Derivatives through a
spring floor are noise (d/dy0 between -430 and 63); a softplus floor has smooth ones (1.3 to 2.6). A
tolerance changes nothing until it changes a number of iterations. It takes 17 s.

One ball is dropped on a spring floor (k: stiffness), on a softplus floor of width eps, and on a floor
that is found by iteration (k: gain, tol: when to stop). One knob at a time is turned around its value,
and the table says for each setting:

    contact     step in which the contact decision is first yes, and its time
    iterations  made by the projection in all, and the most in one step
    loss        height at the end for the floors with a force; squared penetration left by the projection
    d/dk, d/dy0 its derivative through the program that ran

How to read it. The step h moves the first contact by whole steps and the loss with it. The motion on a
spring depends smoothly on k; the program does not, because each contact is a whole number of steps: its
loss is rough over the fine grid of the figure, and d/dk and d/dy0 are those of the roughness. A softplus
floor takes the roughness away, and its width eps moves the loss. tol changes nothing until it changes a
number of iterations, and then the loss jumps; the derivative of a projection is an artefact of where it
stopped, and shrinks with tol.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import figure, parser, save, say, start, table

from mdnum.ball import (
    BallProblem,
    FinalHeight,
    Penalty,
    PerInstance,
    Projection,
    ResidualPenetration,
    SemiImplicitEuler,
    World,
)
from mdnum.errors import InputError

#: Around which the knobs are turned.
STIFFNESS, WIDTH, GAIN, TOL = 3000.0, 0.02, 0.5, 1e-6
KNOBS = (
    ("spring", "h"),
    ("spring", "k"),
    ("softplus", "eps"),
    ("softplus", "k"),
    ("projection", "h"),
    ("projection", "k"),
    ("projection", "tol"),
)


@dataclass(frozen=True)
class Row:
    """One setting of one knob."""

    floor: str
    knob: str
    value: float
    contact: int
    time: float
    iterations: int
    most: int
    loss: float
    by_k: float
    by_y0: float


def problems(height: float, time: float, h: float) -> dict[str, BallProblem]:
    """The three floors under the same ball."""
    scheme, steps = SemiImplicitEuler(h), round(time / h)
    floors = {
        "spring": (Penalty(STIFFNESS), FinalHeight()),
        "softplus": (Penalty(STIFFNESS, eps=WIDTH, smooth=True), FinalHeight()),
        "projection": (Projection(GAIN, 0.5, PerInstance(TOL, 1000)), ResidualPenetration()),
    }
    return {
        name: BallProblem(World.create(contact, scheme), height, 0.0, steps, loss)
        for name, (contact, loss) in floors.items()
    }


def measure(problem: BallProblem, floor: str, knob: str, value: float) -> Row:
    """Run one setting, and differentiate it."""
    run = problem.run(keep=False)
    loss, slope = problem.value_and_grad(["k", "y0"])
    first = int(run.first_contact[0])
    iterations = np.asarray(run.iterations)
    return Row(
        floor,
        knob,
        value,
        first,
        first * run.h,
        int(iterations.sum()),
        int(iterations.max()),
        loss,
        slope["k"],
        slope["y0"],
    )


def turn(problem: BallProblem, floor: str, knob: str, factors: np.ndarray, time: float) -> Iterator[Row]:
    """One knob at several multiples of its value; the time at the end stays the same."""
    own = float(problem.world.value(knob))
    for factor in factors:
        here = problem.with_values({knob: own * factor})
        if knob == "h":
            here = replace(here, steps=round(time / (own * factor)))
        yield measure(here, floor, knob, own * float(factor))


def draw(fine: dict[tuple[str, str], list[Row]], own: dict[tuple[str, str], float], path) -> None:
    """Loss, its derivative by k, and iterations or first contact, against each knob."""
    drawn = figure(14.0, 6.5)
    parts = drawn.subplots(3, len(fine), sharex=True)
    for column, ((floor, knob), rows) in enumerate(fine.items()):
        x = [row.value / own[floor, knob] for row in rows]
        projected = floor == "projection"
        lines = (
            [row.loss for row in rows],
            [row.by_k for row in rows],
            [row.iterations for row in rows] if projected else [row.time for row in rows],
        )
        for part, y in zip(parts[:, column], lines, strict=True):
            part.plot(x, y, "o-" if len(x) < 20 else "-", ms=3, lw=0.9)
            part.locator_params(nbins=4)
            part.ticklabel_format(axis="y", scilimits=(-2, 3), useOffset=False)
        parts[0, column].set_title(f"{floor}: {knob}", pad=14)
        parts[2, column].set_xlabel(f"{knob} / {own[floor, knob]:g}")
        parts[2, column].set_ylabel("iterations" if projected else "first contact (s)")
    parts[0, 0].set_ylabel("loss")
    parts[1, 0].set_ylabel("d loss / dk")
    save(drawn, path)


def main() -> None:
    """Parse, turn every knob, print and draw."""
    made = parser(__doc__, __file__)
    made.add_argument("--height", type=float, default=1.0, help="height at the start, m (default 1)")
    made.add_argument("--time", type=float, default=2.0, help="time at the end, s (default 2)")
    made.add_argument("--h", type=float, default=0.01, help="time step, s (default 0.01)")
    made.add_argument(
        "--factors", nargs="+", type=float, default=[0.5, 0.9, 1.0, 1.1, 2.0], metavar="X",
        help="settings in the table, as multiples of each knob's value (default 0.5 0.9 1 1.1 2)",
    )  # fmt: skip
    made.add_argument("--points", type=int, default=151, help="points of each line (default 151)")
    chosen = made.parse_args()
    if not chosen.time >= chosen.h > 0:
        raise InputError(f"h = {chosen.h:g}; expected above 0 and at most the time", where="--h")
    if min(chosen.factors) <= 0:
        raise InputError("a factor is a positive number", where="--factors")
    if 0.5 * GAIN * max(chosen.factors) >= 2:
        raise InputError(
            f"a gain of {GAIN * max(chosen.factors):g} overshoots more than it corrects",
            where="--factors",
            remedy=f"Choose factors below {4 / GAIN:g}",
        )
    ready = problems(chosen.height, chosen.time, chosen.h)
    factors = np.array(chosen.factors)
    # another h is another number of steps, hence another compilation
    grid = np.geomspace(factors.min(), factors.max(), max(chosen.points, 2))
    rows, fine = [], {}
    for floor, knob in KNOBS:
        say(f"{floor}: {knob}")
        mine = list(turn(ready[floor], floor, knob, factors, chosen.time))
        rows += mine
        fine[floor, knob] = (
            sorted(mine, key=lambda row: row.value)
            if knob == "h"
            else list(turn(ready[floor], floor, knob, grid, chosen.time))
        )
    table(
        f"A ball from {chosen.height:g} m, {chosen.time:g} s, h = {chosen.h:g} s, semi-implicit Euler",
        (
            "floor", "knob", "value", "contact", "at (s)", "iterations", "most", "loss", "d/dk", "d/dy0",
        ),
        (
            (
                row.floor, row.knob, f"{row.value:.4g}", row.contact, f"{row.time:.4f}", row.iterations,
                row.most, f"{row.loss:.6g}", f"{row.by_k:+.3e}", f"{row.by_y0:+.3e}",
            )
            for row in rows
        ),
        words=2,
    )  # fmt: skip
    own = {key: float(ready[key[0]].world.value(key[1])) for key in fine}
    draw(fine, own, chosen.output)


if __name__ == "__main__":
    start(main)
