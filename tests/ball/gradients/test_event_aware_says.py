"""What the event-aware derivative says of itself depends on whether a contact has a saltation at all."""

from __future__ import annotations

import pytest

from mdnum import ball
from mdnum.ball.gradients import EventAware, Unrolled


@pytest.mark.parametrize(
    ("damping", "word"), [(0.0, "derivative of the steps"), (2.0, "derivative of the motion")]
)
def test_a_spring_has_no_saltation_and_says_so(damping: float, word: str) -> None:
    world = ball.World.create(ball.Penalty(900.0, damping), ball.SemiImplicitEuler(0.01))
    problem = ball.Problem(world, 1.0, 0.0, 120)
    aware, plain = EventAware()(problem, ["y0"]), Unrolled()(problem, ["y0"])
    assert word in aware.says
    same = aware.gradient["y0"] == pytest.approx(plain.gradient["y0"], rel=1e-12)
    assert same == (damping == 0.0)
