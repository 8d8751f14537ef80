"""Losses for tests of gradients."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from mdnum.gradients.losses import Custom


def everything(atoms: int, seed: int = 0) -> Custom:
    """A loss that looks at all that a frame holds, with weights that no symmetry cancels."""
    rng = np.random.default_rng(seed)
    way, turn = (jnp.asarray(rng.standard_normal((3, atoms))) for _ in range(2))

    def see(frame, origin, around):
        moved = jnp.sum(way * (frame.x - origin.x)) + jnp.sum(turn * frame.v * jnp.square(origin.v))
        return moved + 1e-2 * frame.potential + 1e-2 * frame.virial / around.volume

    return Custom(see=see, every=7, first=5)
