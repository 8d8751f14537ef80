"""Losses for tests of gradients."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.gradients.losses import Loss


class Everything(Loss):
    """A loss that looks at all that a frame holds, with weights that no symmetry cancels."""

    name = "everything"
    way: Float[Array, "3 atoms"] = eqx.field(kw_only=True)
    turn: Float[Array, "3 atoms"] = eqx.field(kw_only=True)
    energies: Float[Array, ""] = eqx.field(kw_only=True)

    def observe(self, frame, origin, around):
        moved = jnp.sum(self.way * (frame.x - origin.x)) + jnp.sum(self.turn * frame.v * jnp.square(origin.v))
        return moved + self.energies * (frame.potential + frame.virial / around.volume)


def everything(atoms: int) -> Everything:
    """Of so many atoms."""
    way, turn = (jnp.asarray(part) for part in np.random.default_rng(0).standard_normal((2, 3, atoms)))
    return Everything(every=7, first=5, way=way, turn=turn, energies=jnp.asarray(1e-2))
