"""Whether what JAX differentiates is what was run: planted departures, and jax-md's own loop."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mdnum.gradients.primal import of_scan
from small_systems import LENNARD_JONES, crystal, make

from mdnum.systems import build


@jax.custom_vjp
def grown(x, k):
    return x * 2.0


def _forward(x, k):
    # what reverse mode runs instead has another last bit, from the seventh step on
    return jnp.where(k >= 6, jnp.nextafter(x * 2.0, jnp.inf), x * 2.0), None


grown.defvjp(_forward, lambda _, onto: (2.0 * onto, None))


def test_a_loop_that_reverse_mode_runs_otherwise_is_told_from_one_that_it_does_not():
    def planted(scale, state):
        x, k = state
        return grown(x * scale, k) * 0.5, k + 1

    def plain(scale, state):
        x, k = state
        return x * scale * 2.0 * 0.5, k + 1

    start = (jnp.asarray([1.0, 3.0]), jnp.asarray(0))
    found, none = (of_scan(step, jnp.asarray(1.0), start, 9, lambda s: s[0][1]) for step in (planted, plain))
    assert found.first == 7
    assert found.value == 3.0 and found.inside > 3.0
    assert list(found.separation[:6]) == [0.0] * 6 and found.separation[6] == np.spacing(3.0)
    assert none.first is None and none.inside == none.value


@pytest.mark.slow
@pytest.mark.jax_md
def test_jax_mds_own_loop_departs_from_itself_once_its_start_is_differentiated():
    """As it does with jax 0.10.1; where it no longer does, the sentence about it in the pages can go."""
    from mdnum.md.jaxmd import scalar, upstream

    space, energy, simulate = (getattr(upstream(), name) for name in ("space", "energy", "simulate"))
    simulation = build(make(crystal(), LENNARD_JONES, {"kind": "switched", "radius": 2.2, "onset": 1.76}))
    box = jnp.asarray(np.diag(np.asarray(simulation.cell.matrix)).copy())
    displacement, shift = space.periodic(box)
    lengths = {name: scalar(value) for name, value in (("sigma", 1.0), ("r_onset", 1.76), ("r_cutoff", 2.2))}
    total = energy.lennard_jones_pair(displacement, epsilon=scalar(1.0), **lengths)
    init, apply = simulate.nve(total, shift, 0.004)
    state = init(jax.random.key(0), jnp.mod(jnp.asarray(simulation.positions), box), 1.0)
    state = state.set(momentum=jnp.asarray(simulation.velocities))

    def step(heat, both):
        state, k = both
        # at the first step the velocities are those of the start, scaled
        return apply(state.set(momentum=jnp.where(k == 0, state.momentum * heat, state.momentum))), k + 1

    found = of_scan(step, jnp.asarray(1.0), (state, jnp.asarray(0)), 100, lambda s: jnp.sum(s[0].position))
    assert found.first is not None and found.first <= 10
    # rounding that grows as rounding does: exponentially
    assert found.separation[-1] > 10 * found.separation[found.first - 1]
