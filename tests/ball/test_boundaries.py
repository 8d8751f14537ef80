"""Boundaries against every float there is, and against loops in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.boundaries import boundaries
from mdnum.ball.contacts import Impact, Projection
from mdnum.ball.integrators import SemiImplicitEuler
from mdnum.ball.problem import Problem, ResidualPenetration
from mdnum.ball.stopping import GlobalSum, PerInstance
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.precision.policy import RolePrecision


def relaxation(tol: float, p0, rule=GlobalSum, dtype: str = "float64") -> Problem:
    contact = Projection(0.5, 0.5, rule(tol, 200))
    world = World.create(contact, SemiImplicitEuler(1.0), gravity=0.0, policy=RolePrecision.all(dtype))
    return Problem(world, -np.asarray(p0), 0.0, 1, ResidualPenetration(1))


def project(k, p0: float, tol: float, kind=np.float64) -> tuple[int, float, float]:
    """Iterations, what is left, and its derivative by k, rounded after every operation."""
    gain, y, it, slope = kind(0.5) * kind(k), -kind(p0), 0, 0.0
    while -y >= kind(tol):
        slope = slope * (1 - float(gain)) - 0.5 * float(-y)
        y, it = y + gain * -y, it + 1
    return it, float(-y), slope


def test_the_known_boundary_is_found_to_adjacent_floats_with_its_cause() -> None:
    found = boundaries(relaxation(1e-4, [0.45]), "k", 0.5, 0.51, points=3)
    (one,) = found.boundaries
    assert (one.below.at, one.above.at) == (0.5035674359581246, 0.5035674359581247)
    assert one.above.at == np.nextafter(one.below.at, 1)
    assert (one.below.iterations, one.above.iterations) == (30, 29)
    assert (one.channel, one.step, one.iteration, one.ball) == ("stop", 1, 29, -1)
    for side in (one.below, one.above):
        it, left, slope = project(side.at, 0.45, 1e-4)
        assert (side.iterations, side.loss) == (it, left)
        np.testing.assert_allclose(side.gradient, slope, rtol=1e-12)
        assert side.margin == 1e-4 - side.residual
    # the decision that differs: after 29 iterations one goes on and the other stops
    assert one.below.margin <= 0 < one.above.margin
    assert one.above.residual == one.above.loss
    np.testing.assert_allclose([one.below.loss, one.above.loss], [7.48e-5, 1e-4], rtol=1e-3)
    np.testing.assert_allclose([one.below.gradient, one.above.gradient], [-1.50e-3, -1.94e-3], rtol=2e-3)
    assert one.evaluations == found.evaluations < 60
    assert one.words == ("from 0.5035674359581247 on the solver in step 1 makes 29 iterations instead of 30")
    # 2.5e-5 of loss between two floats 1.1e-16 apart
    np.testing.assert_allclose(one.jump, 2.518e-5, rtol=1e-3)


def test_every_boundary_among_all_float16_values_of_an_interval() -> None:
    tol = float(np.float16(1e-2))
    found = boundaries(relaxation(tol, [0.45], dtype="float16"), "k", 0.3, 0.9, points=65)
    values = np.arange(np.float16(0.3).view(np.int16), np.float16(0.9).view(np.int16) + 1, dtype=np.int16)
    every = values.view(np.float16)
    counts = [project(k, 0.45, tol, np.float16)[0] for k in every]
    jumps = [
        (float(every[n]), counts[n], counts[n + 1])
        for n in range(len(every) - 1)
        if counts[n] != counts[n + 1]
    ]
    assert len(jumps) > 10
    assert [(b.below.at, b.below.iterations, b.above.iterations) for b in found.boundaries] == jumps
    np.testing.assert_array_equal(found.iterations, [project(k, 0.45, tol, np.float16)[0] for k in found.at])


def test_a_rule_for_each_ball_names_the_ball() -> None:
    found = boundaries(relaxation(1e-3, [0.45, 0.3, 0.2], PerInstance), "k", 0.5, 0.52, points=17)
    for one in found.boundaries:
        p0 = [0.45, 0.3, 0.2][one.ball]
        counts = [project(side.at, p0, 1e-3)[0] for side in (one.below, one.above)]
        assert counts == [one.below.iterations, one.above.iterations]
        assert counts[0] == counts[1] + 1
        assert one.below.margin <= 0 < one.above.margin
        np.testing.assert_allclose(one.below.residual + one.below.margin, 1e-3, rtol=1e-15)
    assert len({one.ball for one in found.boundaries}) > 1


def test_a_contact_boundary_along_the_start() -> None:
    h, steps = 2.0**-6, 40
    world = World.create(Impact(0.75), SemiImplicitEuler(h), gravity=9.75)
    found = boundaries(Problem(world, 1.0, 0.0, steps), "y0", 1.02, 1.05, points=9)

    def first(y0: float) -> int:
        y, v = np.float64(y0), np.float64(0.0)
        for step in range(1, steps + 1):
            v = v + h * -9.75
            y = y + h * v
            if y < 0:
                return step
        return -1

    (one,) = found.boundaries
    assert one.channel == "contact"
    # a ball that starts lower arrives a step earlier
    assert (first(one.below.at), first(one.above.at)) == (one.step, one.step + 1)
    assert one.above.at == np.nextafter(one.below.at, 2)
    assert (one.below.contact, one.above.contact) == (True, False)
    assert one.below.margin > 0 >= one.above.margin
    assert "misses the floor" in one.words
    # the height at the end jumps by about a step's flight and never depends on the start between
    assert abs(one.jump) > 1e-3
    assert one.below.gradient == one.above.gradient == 0.0


def test_what_cannot_be_searched_is_refused() -> None:
    problem = relaxation(1e-4, [0.45])
    with pytest.raises(InputError, match="nothing between"):
        boundaries(problem, "k", 0.5, 0.5)
    with pytest.raises(InputError, match="more than 2 boundaries"):
        boundaries(problem, "k", 0.4, 0.6, points=33, most=2)
    with pytest.raises(InputError, match="no parameter"):
        boundaries(problem, "damping", 0.1, 0.2)
    assert not boundaries(problem, "k", 0.505, 0.506, points=3).boundaries
