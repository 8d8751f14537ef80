"""Hysteresis, a gap between two thresholds: its effect on fluctuating decisions, and its cost."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from mdnum.ball import (
    BallRun,
    GlobalSum,
    HysteresisStop,
    Penalty,
    Projection,
    SemiImplicitEuler,
    World,
    simulate,
)
from mdnum.numerics.reductions import parse
from mdnum.numerics.roles import RolePrecision
from mdnum.numerics.sums import Reduction
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: A ball that rests on a soft spring and is shaken: it wavers about the floor.
BALLS, STEPS, H, STIFFNESS, DAMPING, SHAKE = 16, 2000, 5e-3, 1000.0, 5.0, 9.0
LIFTS = (0.002, 0.005, 0.01, 0.02)
#: Balls that are pressed to the floor: every step they sink by about what the solver tolerates.
PRESSED, PRESSED_STEPS, G, PRESSED_H, WAVER = 16, 400, 9.75, 1 / 128, 0.5
TOL = PRESSED * G * PRESSED_H**2
GAPS = (1.02, 1.05, 1.1)
ORDERS = ("sequential", "reversed")


def shaken(lift: float | None) -> BallRun:
    """Simulate balls at rest on a spring under a random acceleration (m/s², with a fixed seed).

    Args:
        lift: height at which a contact ends, m; None for 0.
    """
    control = SHAKE * np.random.default_rng(0).normal(size=(STEPS, BALLS))
    world = World.create(
        Penalty(STIFFNESS, damping=DAMPING), SemiImplicitEuler(H), control=control, hysteresis=lift
    )
    return simulate(world, world.start(np.full(BALLS, -9.81 / STIFFNESS)), STEPS)


def pressed(order: Reduction, gap: float | None) -> BallRun:
    """Simulate balls at rest on a hard floor, whose penetrations are summed in float16 for the stopping rule.

    Args:
        order: order of the sum.
        gap: the solver starts at residuals above gap * tol; None to start at tol.
    """
    control = WAVER * np.random.default_rng(1).normal(size=(PRESSED_STEPS, PRESSED))
    tol = float(np.float16(TOL))
    rule: Any = GlobalSum(tol, 50, order)
    if gap is not None:
        rule = HysteresisStop(rule, float(np.float16(gap * TOL)))
    narrow = RolePrecision("float32", "float32", "float16", "float16", "float32")
    world = World.create(
        Projection(0.5, 0.5, rule, restitution=0.0), SemiImplicitEuler(PRESSED_H), G, control, narrow
    )
    return simulate(world, world.start(np.zeros(PRESSED)), PRESSED_STEPS)


def flips(starts: np.ndarray) -> int:
    """Count the decisions that differ from the previous decision along the leading axis."""
    return int(np.sum(starts[1:] != starts[:-1]))


def run() -> Demo:
    """Count the flips of contacts and of stopping decisions with one threshold and with two thresholds."""
    contact: dict[float, BallRun] = {0.0: shaken(None)} | {lift: shaken(lift) for lift in LIFTS}
    rows = {lift: len(one.contacts) for lift, one in contact.items()}
    stop = {gap: [pressed(parse(order), gap) for order in ORDERS] for gap in (None, *GAPS)}
    starts = {gap: flips(runs[0].iterations > 0) for gap, runs in stop.items()}
    apart = {gap: int(np.sum(runs[0].iterations != runs[1].iterations)) for gap, runs in stop.items()}
    left = {gap: float(np.mean(runs[0].residual.astype(np.float64))) for gap, runs in stop.items()}
    low, high = rows[0.0], rows[LIFTS[2]]
    one, two = GAPS[1], None
    return Demo(
        title="Two thresholds instead of one",
        question=(
            "A quantity fluctuates around the threshold of a decision. What is the effect of two "
            "separate thresholds?"
        ),
        result=(
            f"With a gap between two thresholds there are {high} instead of {low} contact flips, and "
            f"{starts[one]} instead of {starts[two]} flips of a stopping decision."
        ),
        answer=(
            f"Balls on a vibrating spring cross the floor {low} times; if a contact begins below 0 "
            f"but ends only above {LIFTS[2]:g} m, there are {high} flips. A solver that starts when "
            f"a float16 sum reaches tol changes its decision {starts[two]} times in {PRESSED_STEPS} "
            f"steps, and in {apart[two]} of these steps another order of the sum gives a different "
            f"decision; if it starts at {one:g} tol, the numbers are {starts[one]} and {apart[one]}. "
            "The disadvantage is that the spring pulls on balls within the gap, and penetrations "
            "within the gap are not removed. A gap narrower than the noise has little effect."
        ),
        numbers={
            "contact_flips_without": low,
            "contact_flips_with": high,
            "stop_flips_without": starts[two],
            "stop_flips_with": starts[one],
            "orders_disagree_without": apart[two],
            "orders_disagree_with": apart[one],
            "left_without": left[two],
            "left_with": left[one],
        },
        checks=[
            Claim("a wider gap reduces the contact flips", list(rows.values()), "falling", _falls(rows)),
            Claim("a gap of 1 cm removes most of them", [low, high], "below a tenth", high < low / 10),
            Claim(
                "a ball leaves contact only above the gap",
                float(_leaves(contact[LIFTS[2]])),
                f"above {LIFTS[2]:g} m",
                bool(_leaves(contact[LIFTS[2]]) > LIFTS[2]),
            ),
            Claim(
                "without a gap the solver's decision to start fluctuates",
                starts[two],
                "more than 100 times",
                starts[two] > 100,
            ),
            Claim("and does not with one", starts[one], "0", starts[one] == 0),
            Claim(
                "without a gap the order of the sum decides in some steps",
                apart[two],
                "at least 1",
                apart[two] > 0,
            ),
            Claim("and in none with one", apart[one], "0", apart[one] == 0),
            Claim(
                "the disadvantage: more penetration remains",
                left[one] / left[two],
                "above 1",
                left[one] > left[two],
            ),
        ],
        tables=[
            table(
                "contact of 16 shaken balls, 2,000 steps",
                ("gap (m)", "flips", "share of time in contact", "mean height (m)"),
                tuple(
                    (lift, rows[lift], float(one.contact.mean()), float(one.y.mean()))
                    for lift, one in contact.items()
                ),
            ),
            table(
                "start of the solver, 400 steps of 16 pressed balls",
                (
                    "starts at (tol)",
                    "flips in time",
                    "steps where two orders disagree",
                    "mean residual left (m)",
                ),
                tuple((gap or 1.0, starts[gap], apart[gap], left[gap]) for gap in stop),
            ),
        ],
        plots=[_heights(contact[0.0], contact[LIFTS[2]]), _gaps(rows), _residuals(stop[None][0])],
        in_md=(
            "The skin of a Verlet list is such a gap for rebuilding the list, but not for the "
            "interaction: a pair at the cutoff flips as often as without a skin. If pairs entered at "
            "r - d and left at r + d, they would flip less often."
        ),
        data={"contact_flips": {str(lift): n for lift, n in rows.items()}},
    )


def _falls(rows: dict[float, int]) -> bool:
    values = list(rows.values())
    return all(a > b for a, b in itertools.pairwise(values))


def _leaves(run: BallRun) -> float:
    """Return the lowest height at which a contact ended, m."""
    rows = ~run.contacts.entered
    return float(np.min(run.height[run.contacts.step[rows] - 1, run.contacts.subject[rows, 0]]))


def _heights(plain: BallRun, gap: BallRun) -> Plot:
    shown = slice(0, 200)
    return Plot(
        "shaken-ball",
        title="Height and contacts of a shaken ball",
        x_label="time (s)",
        y_label="height (m)",
        series=(
            Series("height, one threshold", plain.time[shown], plain.y[shown, 0], role="first"),
            Series(
                "in contact, one threshold",
                plain.time[shown],
                np.where(plain.contact[shown, 0], -0.045, np.nan),
                "line",
                "first",
            ),
            Series(
                "in contact, with a gap",
                gap.time[shown],
                np.where(gap.contact[shown, 0], -0.05, np.nan),
                "line",
                "second",
            ),
        ),
        caption="The lower lines are unbroken while the ball is in contact.",
        horizontals=((0.0, "floor"), (LIFTS[2], "contact ends")),
    )


def _gaps(rows: dict[float, int]) -> Plot:
    return Plot(
        "contact-flips",
        title="Contact flips over the width of the gap",
        x_label="gap (m)",
        y_label="flips",
        y_scale="symlog",
        series=(Series("flips", np.array(list(rows)), np.array(list(rows.values()), float), "line+points"),),
        caption="The gap has to be wider than the fluctuations of the ball, which are about 0.7 cm here.",
    )


def _residuals(run: BallRun) -> Plot:
    start = np.abs(np.minimum(run.height, 0)).sum(axis=1, dtype=np.float64) / TOL
    return Plot(
        "solver-finds",
        title="Residual at the beginning of each step",
        x_label="step",
        y_label="sum of penetrations / tol",
        series=(Series("first residual", np.arange(1, len(start) + 1), start, "points"),),
        caption="The residual fluctuates around the tolerance and stays well below the second threshold.",
        horizontals=((1.0, "tol"), (GAPS[1], "starts here with a gap")),
    )
