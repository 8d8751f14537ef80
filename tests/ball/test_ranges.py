"""Ranges of a rollout, against numbers that are known beforehand."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.contacts import Penalty, Projection
from mdnum.ball.integrators import SemiImplicitEuler
from mdnum.ball.ranges import ranges
from mdnum.ball.rollout import simulate
from mdnum.ball.stopping import GlobalSum
from mdnum.ball.world import World
from mdnum.errors import InputError


def test_a_stiff_spring_would_overflow_float16():
    world = World.create(Penalty(1e9), SemiImplicitEuler(1e-5))
    run = simulate(world, world.start([0.01, 0.02], -4.0), 700)
    own, half = ranges(run), ranges(run, "float16")
    assert own.findings() == ()
    pushed = 1e9 * np.maximum(0.0, -run.height.min(axis=1))
    force = half.ranges["spring force"]
    # 4 m/s stopped by a spring of sqrt(1e9)/s: about 4 * 3.2e4
    assert float(force.largest.max()) == pytest.approx(1.26e5, rel=0.05)
    assert force.first("out of range") == int(np.argmax(pushed > 65504)) > 0
    assert any("spring force in float16 reaches" in said for said in half.findings())
    # the square of a penetration of 1e-4 m is among float16's subnormals
    assert half.ranges["penetration squared"].first("subnormal") >= 0
    assert set(half.ranges) == {
        "height", "velocity", "penetration", "penetration squared", "energy", "spring force"
    }  # fmt: skip


def test_a_solver_shows_its_residuals():
    world = World.create(Projection(0.5, 0.5, GlobalSum(1e-3, 25)), SemiImplicitEuler(0.01))
    run = simulate(world, world.start([0.3]), 60)
    seen = ranges(run, "bfloat16").ranges["residual"]
    assert float(seen.largest.max()) == np.nanmax(run.residual)
    assert "spring force" not in ranges(run).ranges


def test_states_are_needed():
    world = World.create(Penalty(100.0), SemiImplicitEuler(0.01))
    with pytest.raises(InputError, match="kept no states"):
        ranges(simulate(world, world.start([1.0]), 5, keep=False))
