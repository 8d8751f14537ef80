"""The same ulp on either side of the stability limit, and the stretch of a rollout in all directions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum import ball


def held(z: float) -> ball.World:
    """A spring that holds on to its ball (h √k = z, h = 1), so that the motion is linear."""
    return ball.World.create(ball.Penalty(z * z), ball.SemiImplicitEuler(1.0), gravity=0.0, hysteresis=1e300)


@pytest.mark.parametrize(("z", "bounded"), [(0.5, True), (1.9, True), (2.1, False)])
def test_whether_an_ulp_stays_an_ulp_is_decided_by_the_discretization(z, bounded):
    world = held(z)
    low, high = (ball.simulate(world, world.start(y), 150) for y in (-1.0, np.nextafter(-1.0, 0)))
    apart = np.abs(low.y - high.y).max()
    assert apart < 1e-13 if bounded else apart > 1.0


def test_singular_values_of_a_symplectic_rollout_multiply_to_one():
    """One is stretched as much as the other is shrunk, contacts included (semi-implicit Euler keeps area)."""
    world = ball.World.create(ball.Penalty(1e3), ball.SemiImplicitEuler(5e-3))

    def end(start):
        state = world.start(start[:1], start[1:])
        for_each = lambda state, _: (world.advance(state)[0], None)  # noqa: E731
        state, _ = jax.lax.scan(for_each, state, None, length=400)
        return jnp.concatenate([state.y, state.v])

    jacobian = np.asarray(jax.jacfwd(end)(jnp.asarray([0.5, 0.0])))
    large, small = np.linalg.svd(jacobian, compute_uv=False)
    assert large > 3
    assert large * small == pytest.approx(1.0, rel=1e-9)
