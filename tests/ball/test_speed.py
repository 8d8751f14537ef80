"""How long ten thousand balls take: generous bounds, for the day one of them grows tenfold."""

from __future__ import annotations

import time

import numpy as np
import pytest

from mdnum import ball

WORLDS = {
    "spring": (ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3), "k"),
    "located impacts": (ball.Impact(0.8, 1e-6), ball.EventLocated(1e-3), "restitution"),
    "projection": (ball.Projection(0.5, 0.5, ball.PerInstance(1e-6)), ball.SemiImplicitEuler(1e-3), "k"),
}


def shortest(call) -> float:
    """Seconds of the fastest of three calls after one that compiles."""
    call()
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_ten_thousand_balls_for_a_thousand_steps(name: str):
    contact, scheme, parameter = WORLDS[name]
    world = ball.World.create(contact, scheme)
    problem = ball.Problem(world, np.linspace(0.5, 1.5, 10_000), 0.0, 1000)
    recorded = shortest(problem.run)
    gradient = shortest(lambda: problem.value_and_grad([parameter, "y0"]))
    assert recorded < 5
    assert gradient < 4 * recorded
