"""The derivative by the state of every step, against products of the matrices of single steps."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum import ball
from mdnum.ball import Problem, profile
from mdnum.precision.policy import RolePrecision


def dropped(k: float, steps: int, h: float = 0.01, policy: RolePrecision | None = None, **options) -> Problem:
    world = ball.World.create(ball.Penalty(k, **options), ball.SemiImplicitEuler(h), policy=policy)
    return Problem(world, np.array([1.0, 0.7]), 0.0, steps)


@pytest.mark.parametrize(("k", "damping"), [(900.0, 0.0), (2500.0, 3.0)])
def test_it_is_the_product_of_the_steps_that_follow(k: float, damping: float):
    problem = dropped(k, 200, damping=damping)
    seen, run, h = profile(problem), problem.run(), 0.01
    for b in range(2):
        back = np.array([1 / 2, 0.0])  # the mean over two balls
        for step in range(199, -1, -1):
            kick = np.eye(2)
            if run.contact[step, b]:
                kick = np.array([[1, 0], [-h * k, 1 - h * damping]])
            back = back @ np.array([[1, h], [0, 1]]) @ kick
            ours = seen.by_height[step, b], seen.by_velocity[step, b]
            np.testing.assert_allclose(ours, back, rtol=1e-9, atol=1e-12)
    slope = problem.value_and_grad(["y0"])[1]["y0"]
    assert seen.by_height[0].sum() == pytest.approx(slope, rel=1e-12)
    assert seen.value == problem.value()
    assert seen.lost_at is None


def test_the_backward_pass_overflows_while_the_ball_looks_fine():
    single = RolePrecision.all("float32")
    problem = dropped(3600.0, 8000, policy=single)
    seen, run = profile(problem), problem.run()
    assert np.abs(run.y).max() < 10
    # finite at the end, growing backwards, lost somewhere between and not regained
    assert seen.lost_at is not None
    assert 0 < seen.lost_at < 7000
    assert np.all(np.isfinite(seen.size[seen.lost_at + 1 :]))
    assert not np.isfinite(seen.size[0])
    assert seen.size[seen.lost_at + 1] > 1e30


def test_a_clamp_passes_nothing_back_by_height():
    world = ball.World.create(ball.Projection(0.5, 0.5, ball.PerInstance(1e-6)), ball.SemiImplicitEuler(0.01))
    problem = Problem(world, 1.0, 0.0, 60)
    seen, first = profile(problem), int(problem.run().first_contact[0])
    assert np.all(seen.by_height[:first] == 0)
    np.testing.assert_allclose(seen.by_height[first:], 1.0)
    # the speed is not clamped but turned round: what is left to fly is flown at -0.8 of it
    np.testing.assert_allclose(seen.by_velocity[0], -0.8 * 0.01 * (60 - first), rtol=1e-12)
    assert seen.growth == pytest.approx(0.8 * 0.01 * (60 - first))
