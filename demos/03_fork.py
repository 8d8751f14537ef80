"""Two runs with initial heights one ulp apart, whose first contacts differ by one step."""

from __future__ import annotations

import numpy as np

from mdnum.ball import (
    BallDifference,
    BallProblem,
    BallRun,
    Impact,
    Penalty,
    SemiImplicitEuler,
    World,
    first_difference,
    simulate,
)
from mdnum.numerics.rounding import neighbor, ordinal
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

H, STEPS = 0.01, 200
#: Heights (m) with different first contacts, between which the boundary lies.
LOW, HIGH = 1.0, 1.02
#: Stiffness of the ball on a spring, 1/s², for comparison: its force is 0 where the contact begins.
STIFFNESS = 2000.0


def adjacent(world: World, low: float, high: float, steps: int) -> tuple[float, float, int]:
    """Find neighboring initial heights whose first contacts are at different steps, by bisection over floats.

    Args:
        world: the world of the ball.
        low, high: heights with different first contacts, m.
        steps: number of steps of each run.

    Returns:
        the two heights, and the number of runs of the search.
    """

    def first(y0: float) -> int:
        return int(simulate(world, world.start(y0), steps, keep=False).first_contact[0])

    start = first(low)
    runs = 1
    while (between := int(ordinal(high) - ordinal(low))) > 1:
        middle = float(neighbor(low, between // 2))
        runs += 1
        if first(middle) == start:
            low = middle
        else:
            high = middle
    return low, high, runs


def run() -> Demo:
    """Find the pair of heights, and determine whether the flip separates the two runs."""
    reset = World.create(Impact(restitution=0.8, rest_speed=0.0), SemiImplicitEuler(H))
    spring = World.create(Penalty(STIFFNESS), SemiImplicitEuler(H))
    low, high, runs = adjacent(reset, LOW, HIGH, STEPS)
    a, b = (simulate(reset, reset.start(y0), STEPS) for y0 in (low, high))
    told = simulate(reset, reset.start(high), STEPS, imposed=a.decisions())
    c, d = (simulate(spring, spring.start(y0), STEPS) for y0 in (low, high))
    parted, held, soft = first_difference(a, b), first_difference(a, told), first_difference(c, d)
    assert parted.fork is not None
    contact = [int(run.first_contact[0]) for run in (a, b, c, d)]
    at = parted.fork
    before = float(parted.separation[:at].max())
    after = float(parted.separation[at:].max())
    slopes = [
        BallProblem(reset, y0, 0.0, STEPS).value_and_grad(["restitution"])[1]["restitution"]
        for y0 in (low, high)
    ]
    apart = int(ordinal(high) - ordinal(low))
    height = -parted.margins[0], -parted.margins[1]
    jump = H * abs(float(b.v[at - 1, 0]))
    return Demo(
        title="One ulp changes the step of the first contact",
        question=(
            "The initial heights of two balls are neighboring floats. Do the balls touch the floor "
            "in the same step?"
        ),
        result=(
            "If the initial height is one ulp larger, the ball touches the floor at step "
            f"{contact[1]} instead of {contact[0]}: the separation of the two balls is {before:.1g} m "
            f"before and {after:.2g} m afterwards."
        ),
        answer=(
            f"If the initial heights are {low!r} m and the next float, one ball touches the floor in "
            f"step {contact[0]} and the other in step {contact[1]}: at the end of step {at} their "
            f"heights are {height[0]:.2g} m and {height[1]:.2g} m. The velocity of one ball is reset, "
            f"the other ball falls for one more step, and a separation of {before:.1g} m becomes "
            f"{after:.1g} m. With the decisions of the first ball imposed, the second ball stays "
            f"within {held.separation.max():.1g} m of the first ball: the decision is the cause. On a "
            f"spring the "
            "same flip does not separate the balls, because the force is 0 when contact begins."
        ),
        numbers={
            "first_contact": contact[:2],
            "ulps_apart": apart,
            "y0": low,
            "y0_hex": float(low).hex(),
            "heights_at_the_fork": list(height),
            "separation_before": before,
            "separation_after": after,
            "separation_told": float(held.separation.max()),
            "separation_on_a_spring": float(soft.separation.max()),
            "runs": runs,
        },
        checks=[
            Claim("the initial heights are neighboring floats", apart, "1 ulp", apart == 1),
            Claim(
                "first contacts are one step apart",
                contact[1] - contact[0],
                "1",
                contact[1] - contact[0] == 1,
            ),
            Claim(
                "the fork is in the contact channel, at the first contact of the lower ball",
                [parted.channel, at],
                f"contact, {contact[0]}",
                parted.channel == "contact" and at == contact[0],
            ),
            Claim(
                "before the fork the separation is within rounding", before, "below 1e-14 m", before < 1e-14
            ),
            Claim(
                "after the fork the separation is at least the fall of a step",
                after,
                f"at least {jump:.3g} m",
                after >= jump * (1 - 1e-9),
            ),
            Claim(
                "with the same decisions the separation stays within rounding",
                float(held.separation.max()),
                "below 1e-14 m",
                bool(held.separation.max() < 1e-14),
            ),
            Claim(
                "on a spring the flip occurs, too, but does not separate the balls",
                [soft.fork, float(soft.separation.max())],
                f"fork at {contact[2]}, below 1e-13 m",
                soft.fork == contact[2] and bool(soft.separation.max() < 1e-13),
            ),
        ],
        tables=[
            table(
                "the pair",
                ("ball", "start (m)", "as hexadecimal", "first contact", "height there (m)", "d y(T)/de (m)"),
                tuple(
                    (name, y0, float(y0).hex(), first, h, slope)
                    for name, y0, first, h, slope in zip(
                        ("lower", "upper"), (low, high), contact[:2], height, slopes, strict=True
                    )
                ),
            ),
            table(
                "what separates them",
                ("contact", "second ball", "fork", "largest separation (m)"),
                (
                    ("velocity reset", "decides for itself", at, after),
                    (
                        "velocity reset",
                        "has the first one's decisions imposed",
                        held.fork,
                        float(held.separation.max()),
                    ),
                    ("spring", "decides for itself", soft.fork, float(soft.separation.max())),
                ),
            ),
        ],
        plots=[_heights(a, b, at), _separations(a, parted, held, soft)],
        in_md=(
            "A pair of atoms crosses the cutoff one step earlier. With a hard cutoff the runs "
            "diverge because the force jumps; if the force goes to zero smoothly, the flip is a "
            "bystander."
        ),
        data={
            "separation": parted.separation,
            "separation_told": held.separation,
            "separation_on_a_spring": soft.separation,
            "gradient": slopes,
            "ordinals": ordinal(np.array([low, high])).tolist(),
        },
    )


def _heights(a: BallRun, b: BallRun, at: int) -> Plot:
    return Plot(
        "heights-two",
        title="Heights of two balls that start one ulp apart",
        x_label="time (s)",
        y_label="height (m)",
        series=(
            Series("lower", a.time, a.y[:, 0], role="first"),
            Series("upper", b.time, b.y[:, 0], role="second", dashed=True),
        ),
        caption="The curves agree up to the first contact, and differ afterwards.",
        verticals=((at * H, "fork"),),
    )


def _separations(a: BallRun, parted: BallDifference, held: BallDifference, soft: BallDifference) -> Plot:
    def shown(found: BallDifference) -> np.ndarray:
        return np.where(found.separation > 0, found.separation, np.nan)

    assert parted.fork is not None
    return Plot(
        "separation-two",
        title="Separation of the two balls",
        x_label="time (s)",
        y_label="|difference of heights| (m)",
        y_scale="log",
        series=(
            Series("velocity reset", a.time, shown(parted), role="bad"),
            Series("the same decisions imposed", a.time, shown(held), role="first"),
            Series("on a spring", a.time, shown(soft), role="second"),
        ),
        caption="One flip increases the separation from rounding to the fall during one step. If the "
        "decision is imposed, or if the force is zero at the boundary, the separation stays at rounding.",
        verticals=((parted.fork * H, "fork"),),
    )
