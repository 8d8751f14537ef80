"""Zeno: infinitely many bounces in a finite time, simulated by three programs."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from mdnum.ball import EventLocated, ExactImpact, Impact, Reason, SemiImplicitEuler, World, simulate
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

G, E = 9.81, 0.8
REST_SPEED = 1e-12
COUNTS = (1, 7, 60, 500)


def run() -> Demo:
    """Bounce a ball to rest: in closed form, with located impacts, and with fixed steps."""
    exact = ExactImpact(1.0, 0.0, G, E)
    rest = exact.rest_time()
    limit = float(rest.value)
    # the impact whose rebound is slow enough for the program to call it rest
    speed = float(exact.impact_speed(1).value)
    last = int(np.ceil(np.log(REST_SPEED / speed) / np.log(E)))
    promised = float(exact.impact_time(last).value)
    world = World.create(Impact(E, REST_SPEED), EventLocated(0.01, 1000), G)
    found = {count: _rest(world, 1.0, limit, count) for count in COUNTS}
    off = max(abs(t - limit) for t in found.values())
    # derivative of the program's time to rest, by differences of that time
    shift = 1e-4
    by_y0 = (_rest(world, 1 + shift, limit, 7) - _rest(world, 1 - shift, limit, 7)) / (2 * shift)
    higher, lower = (
        _rest(world.with_values({"restitution": E + sign * shift}), 1.0, limit, 7) for sign in (1, -1)
    )
    by_e = (higher - lower) / (2 * shift)

    located = simulate(world, world.start(1.0), 450)
    counted = np.cumsum(located.iterations[:, 0])
    moving = located.time[1:] < promised
    bounces = exact.bounces(located.time[1:])
    miscounted = int(np.sum(counted[moving] != bounces[moving]))
    at_rest = located.reason[:, 0] == Reason.REST.value
    # a ball that lies still is put back on the floor in every later step, which counts as one each
    counted_to_rest = int(counted[np.argmax(at_rest)])

    steps = (0.01, 0.001)
    plain = [
        simulate(World.create(Impact(E, 0.0), SemiImplicitEuler(h), G), world.start(1.0), round(8 / h))
        for h in steps
    ]
    contacts = [int(r.contact.sum()) for r in plain]
    late = [int(r.contact[r.time[1:] > limit + 1].sum()) for r in plain]
    left = [float(np.abs(r.v[-100:]).max()) for r in plain]
    gaps = [float(f"1e-{n}") for n in range(1, 11)]
    return Demo(
        title="Infinitely many bounces",
        question=("When does a bouncing ball come to rest, and which program finds this time?"),
        result=(
            f"The ball is at rest after {limit:.6f} s and infinitely many bounces. With located impacts "
            f"the time is found within {off:.0e} s; fixed steps never come to rest."
        ),
        answer=(
            f"In closed form, the ball is at rest at {limit:.6f} s, after infinitely many bounces. The "
            f"program that locates "
            f"impacts ends at a rebound of {REST_SPEED:g} m/s, which is bounce {last}; for any step it "
            f"ends within {off:.0e} s of the exact time. With fixed steps the ball never rests: a "
            f"second later it still touches the floor in every step, with a speed proportional to h."
        ),
        numbers={
            "rest_time": limit,
            "rest_time_located": found[7],
            "rest_time_error": off,
            "bounces_to_rest_speed": last,
            "rest_by_y0": float(rest.gradient["y0"]),
            "rest_by_y0_located": by_y0,
            "rest_by_restitution": float(rest.gradient["restitution"]),
            "rest_by_restitution_located": by_e,
            "contacts_in_fixed_steps": dict(zip(("0.01", "0.001"), contacts, strict=True)),
            "speed_left_in_fixed_steps": dict(zip(("0.01", "0.001"), left, strict=True)),
        },
        checks=(
            Claim(
                "with located impacts the ball rests at the time in closed form, for any step",
                off,
                "below 2e-12 s for 1, 7, 60 and 500 steps",
                off < 2e-12,
            ),
            Claim(
                "located impacts count every bounce up to this time",
                miscounted,
                "0 steps with another count",
                miscounted == 0 and counted_to_rest == last,
            ),
            Claim(
                "and lie still afterwards",
                float(np.abs(located.y[-1, 0]) + np.abs(located.v[-1, 0])),
                "exactly 0",
                bool(located.y[-1, 0] == 0 and located.v[-1, 0] == 0 and at_rest.any()),
            ),
            Claim(
                "the time to rest has the derivatives in closed form",
                [by_y0, by_e],
                "the closed form within 1e-6 (by differences)",
                all(
                    abs(seen / float(rest.gradient[name]) - 1) < 1e-6
                    for seen, name in ((by_y0, "y0"), (by_e, "restitution"))
                ),
            ),
            Claim(
                "fixed steps touch the floor in every step long after the end",
                late,
                "every step of the last 2.9 s",
                all(n >= round((8 - limit - 1) / h) - 1 for n, h in zip(late, steps, strict=True)),
            ),
            Claim(
                "with a speed proportional to the step",
                left[0] / left[1],
                "10 ± 0.1",
                abs(left[0] / left[1] - 10) < 0.1,
            ),
        ),
        tables=(
            table(
                "Bounces before a time (closed form)",
                ("time before rest (s)", "bounces"),
                tuple((float(x), int(exact.bounces(limit - x))) for x in gaps),
            ),
            table(
                "Time to rest (s)",
                ("program", "steps", "time", "minus closed form"),
                (
                    ("closed form", None, limit, 0.0),
                    (f"closed form, impact {last}", None, promised, promised - limit),
                    *(("impacts located", n, t, t - limit) for n, t in found.items()),
                    *(
                        (f"fixed steps of {h:g} s", r.steps, None, None)
                        for h, r in zip(steps, plain, strict=True)
                    ),
                ),
            ),
        ),
        plots=(_heights(exact, plain[0], limit), _staircase(exact, located, counted, limit)),
        in_md=(
            "Constraints and contacts may close at ever shorter intervals: a program that locates "
            "every event never ends, and a program that skips events never comes to rest."
        ),
    )


def _rest(world: World, y0: float, near: float, count: int) -> float:
    """Return the time at which the simulated ball comes to rest, to the last ulp, for a number of steps."""
    low, high = 0.9 * near, 1.1 * near
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return high
        if bool(_still(world.with_values({"h": middle / count}), jnp.asarray(y0), jnp.asarray(count))):
            high = middle
        else:
            low = middle


@eqx.filter_jit
def _still(world: World, y0: Array, count: Array) -> jax.Array:
    state = lax.fori_loop(0, count, lambda _, state: world.advance(state)[0], world.start(y0))
    return (state.y[0] == 0) & (state.v[0] == 0)


def _heights(exact: ExactImpact, plain, limit: float) -> Plot:
    time = np.linspace(0, 6, 1201)
    until = plain.time <= 6
    return Plot(
        "height-closed",
        title="Height, in closed form and in fixed steps of 0.01 s",
        x_label="time (s)",
        y_label="height (m)",
        series=(
            Series("closed form", time, exact.height(time).value, "line", "first"),
            Series("fixed steps", plain.time[until], plain.y[until, 0], "line", "bad"),
        ),
        verticals=((limit, "at rest"),),
        caption="The bounces get shorter by the restitution each time and end at a finite time.",
    )


def _staircase(exact: ExactImpact, located, counted: np.ndarray, limit: float) -> Plot:
    gap = np.logspace(0.6, -12, 600)
    gap = gap[gap < limit]
    seen = limit - located.time[1:]
    shown = (seen > 1e-12) & (seen < limit)
    return Plot(
        "bounces-so",
        title="Bounces so far",
        x_label="time left to rest (s)",
        y_label="bounces",
        x_scale="log",
        series=(
            Series("closed form", gap, exact.bounces(limit - gap), "steps", "ink"),
            Series(
                "impacts located, h = 0.01 s", seen[shown], counted[shown].astype(float), "points", "first"
            ),
        ),
        caption="The remaining time decreases by the same factor in each bounce, so the number of "
        "bounces has no limit.",
    )
