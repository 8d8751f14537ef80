"""The fork demonstration: the pair of starts is where exact arithmetic and a plain loop put it."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from mdnum.ball.contacts import Impact
from mdnum.ball.demos import Demo, run
from mdnum.ball.demos.fork import STEPS, adjacent
from mdnum.ball.integrators import SemiImplicitEuler
from mdnum.ball.world import World

# the whole demonstration is run
pytestmark = pytest.mark.slow

G, H, E = 9.81, 0.01, 0.8


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("fork")


def bounce(y: float, steps: int) -> tuple[np.ndarray, int]:
    """The ball with a velocity reset, an operation at a time; heights and the step of the first contact."""
    v, a, rows, first = 0.0, -G, [y], -1
    for step in range(1, steps + 1):
        v = v + H * a
        y = y + H * v
        if y < 0:
            first = step if first < 0 else first
            y, v = 0.0, -E * min(v, 0.0)
        rows.append(y)
    return np.array(rows), first


def test_every_check_holds(demo: Demo):
    assert [check.what for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 7


def test_the_pair_is_where_a_plain_loop_puts_it(demo: Demo):
    low = demo.numbers["y0"]
    high = np.nextafter(low, 2.0)
    (lower, first), (upper, second) = bounce(low, STEPS), bounce(high, STEPS)
    assert [first, second] == demo.numbers["first_contact"] == [45, 46]
    assert np.abs(lower - upper).tolist() == demo.data["separation"].tolist()
    assert demo.numbers["separation_before"] == np.abs(lower - upper)[:45].max() < 1e-15
    assert demo.numbers["separation_after"] == np.abs(lower - upper).max() > 0.1


def test_the_boundary_is_the_exact_one_to_some_ulps(demo: Demo):
    # without rounding the height after n steps is y0 - g h² n (n + 1) / 2
    exact = Fraction(G) * Fraction(H) ** 2 * 45 * 46 / 2
    assert abs(Fraction(demo.numbers["y0"]) - exact) < 45 * Fraction(np.spacing(1.0))


def test_the_bisection_ends_at_neighbors_whatever_it_starts_from():
    world = World.create(Impact(E, rest_speed=0.0), SemiImplicitEuler(H))
    low, high, runs = adjacent(world, 0.5, 0.52, 60)
    assert high == np.nextafter(low, 1.0)
    assert bounce(high, 60)[1] == bounce(low, 60)[1] + 1
    assert runs < 70
