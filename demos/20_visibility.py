"""A ball behind an edge: visibility is an event, and smoothing it changes the optimization problem."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mdnum.ball import Impact, SemiImplicitEuler, World, simulate
from mdnum.numerics import Ledger, Threshold, gamma
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: Height of the edge and length of a step, steps; time (s) for which the ball is to be seen; widths (m).
EDGE, H, STEPS, G, WANTED = 1.0, 1e-3, 1400, 9.81, 0.5
WIDTHS = (0.01, 0.03, 0.1, 0.3)
SPEEDS = np.linspace(4.0, 6.0, 401)


def heights(v0: Array) -> Array:
    """Return the heights of balls thrown up from the floor, by the semi-implicit Euler method."""
    n = np.arange(1.0, STEPS + 1)[:, None]
    return jnp.asarray(n * H) * v0 - G * H * H * n * (n + 1) / 2


@jax.jit
def missed(v0: Array, width: float) -> tuple[Array, Array]:
    """Return the squared error of the time for which a ball is above the edge, and its derivative.

    Args:
        width: width of the sigmoid by which each step is weighted, m; 0 counts steps.
    """

    def loss(v0):
        above = heights(v0[None])[:, 0] - EDGE
        soft = jax.nn.sigmoid(above / jnp.where(width == 0, 1.0, width))
        return (H * jnp.sum(jnp.where(width == 0, jnp.heaviside(above, 0.0), soft)) - WANTED) ** 2

    return jax.vmap(jax.value_and_grad(loss))(v0)


def run() -> Demo:
    """Simulate a throw with its events, and find the throw that is visible for half a second."""
    world = World.create(Impact(), SemiImplicitEuler(H), gravity=G)
    thrown = simulate(world, world.start(0.0, 5.0), STEPS)
    y, rule = thrown.y[:, 0], Threshold(-EDGE, "<", "minus height")
    visible = np.array(rule.decide(-y))
    step = np.flatnonzero(np.diff(visible)) + 1
    bound = gamma(4, np.dtype(float)) * step * (EDGE + H * 5.0)
    ledger = Ledger("visibility", step, step[:, None] * 0, visible[step], y[step] - EDGE, bound, step * 0.0)
    # h n - g h² n (n + 1) / 2 passes the edge twice
    root = np.roots([-G * H * H / 2, 5.0 * H - G * H * H / 2, -EDGE])
    known = [int(np.floor(n)) + 1 for n in np.sort(root)]
    # T = 2 sqrt(v0² - 2 g e) / g, so that a throw is seen for so long from a speed on that is known
    total = 2 * np.sqrt(25 - 2 * G * EDGE) / G
    exact = 2 * 5.0 / (G * np.sqrt(25 - 2 * G * EDGE))
    best = float(np.sqrt(2 * G * EDGE + (G * WANTED / 2) ** 2))
    time = float(visible.sum() * H)
    # each crossing moves by dy/dv0 over the speed there: the time of an event has a derivative
    moved = float(sum(n * H / abs(thrown.v[n, 0]) for n in step))
    lost = {w: [np.array(part) for part in missed(jnp.asarray(SPEEDS), w)] for w in (0.0, *WIDTHS)}
    # speeds of 4.2 and 5 m/s: never seen, and seen for a time that a small change of speed changes by steps
    at = np.searchsorted(SPEEDS, (4.2, 5.0))
    slopes = {w: slope[at].tolist() for w, (_, slope) in lost.items()}
    found = {w: float(SPEEDS[np.argmin(value)]) for w, (value, _) in lost.items()}
    moves = {w: at - best for w, at in found.items()}
    wide, hard = WIDTHS[-2], slopes[0.0]
    return Demo(
        title="Seen or not is an event",
        question=(
"A ball is thrown up behind an edge of 1 m. At which speed is it visible for half a "
"second?"
),
        result=f"A ball thrown at {best:.4f} m/s is visible for half a second. If the visible time is "
        f"counted in steps, its derivative is 0 everywhere (exact: {exact:.4f} s per m/s); if it is "
        f"smoothed over {wide:g} m, the optimum is {found[wide]:.3f} m/s, the solution of another problem.",
        answer=f"The visible time counts the steps in which the ball is above the edge, and this "
        f"decision has no derivative. The times of the two crossings have derivatives, which add up to "
        f"{moved:.4f}. A sigmoid has a slope even if the ball is never visible, so that an optimizer "
        f"can start, but it moves the optimum by {moves[WIDTHS[0]]:.3f} to {moves[WIDTHS[-1]]:.3f} m/s "
        f"for widths of {WIDTHS[0]:g} "
        f"to {WIDTHS[-1]:g} m.",
        numbers={
            "best": best, "derivative": exact, "derivative_by_crossings": moved, "slope_counted": hard,
            "events": step.tolist(), "margins": ledger.margin.tolist(), "bounds": ledger.bound.tolist(),
            "optimum_moves": {f"{w:g}": move for w, move in moves.items()},
        },
        checks=[
            Claim("steps of the two events are those of the closed form", step.tolist(), str(known),
                  step.tolist() == known),
            Claim("neither is within rounding", int(ledger.ambiguous.sum()), "0", not ledger.ambiguous.any()),
            Claim("the count has no derivative", hard, "exactly 0", not np.any(hard)),
            Claim("the crossings have it", moved, f"{exact:.4f} to 1 %", abs(moved / exact - 1) < 0.01),
            Claim("the visible time is correct within two steps", time, f"{total:.4f} ± {2 * H:g}",
                  abs(time - total) <= 2 * H),
            Claim("a larger width moves the optimum further", list(moves.values())[1:], "increasing",
                  bool(np.all(np.diff(list(moves.values())[1:]) > 0))),
        ],
        tables=[table("softened by a sigmoid", ("width (m)", "optimum (m/s)", "moved by", "slope at 4.2 m/s",
                                               "slope at 5 m/s"),
                      [(w, found[w], moves[w], *slopes[w]) for w in lost])],
        plots=[Plot("loss", "Squared difference from half a second", "speed (m/s)", "loss (s²)", tuple(
            Series(f"width {w:g} m" if w else "counted", SPEEDS, lost[w][0], "line", role)
            for w, role in zip((0.0, *WIDTHS[1:]), ("ink", "first", "second", "third"), strict=True)),
            verticals=((best, "exact"),), caption="Counted in steps, the loss is flat if the ball is "
                "never visible, and a staircase elsewhere. The smoothed loss has a slope everywhere, "
                "and another minimum.")],
        in_md=(
"A coordination number counts neighbors within a radius; its smooth version has a "
"gradient, but is a different order parameter."
),
    )  # fmt: skip
