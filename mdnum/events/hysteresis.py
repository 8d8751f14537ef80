"""Two thresholds instead of one: a decision that stays what it was until the quantity has gone far enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdnum.errors import InputError
from mdnum.events.threshold import Threshold


@dataclass(frozen=True)
class Hysteresis:
    """A decision that turns yes at one threshold and no at another (a Schmitt trigger).

    A quantity that wavers about one threshold flips its decision each time. With a gap between the two it
    flips once; the gap is to be wider than the noise. A Verlet list does the same with its skin: it is
    built when the skin is used up, not whenever an atom moves.

    Attributes:
        enter: where a no turns yes.
        leave: where a yes stays yes; turning no needs this threshold to be passed. The same space, and at
            least as high as enter.
    """

    enter: Threshold
    leave: Threshold

    def __post_init__(self):
        if self.enter.space != self.leave.space:
            raise InputError(
                f"the two thresholds are in different spaces, {self.enter.space} and {self.leave.space}"
            )
        enter, leave = self.enter.value, self.leave.value
        # traced values are checked where they were made
        if isinstance(enter, float | int) and isinstance(leave, float | int) and leave < enter:
            raise InputError(
                f"a yes would end at {leave:g}, before it begins at {enter:g}",
                remedy="Put the threshold for leaving at or above the one for entering",
            )

    def margin(self, quantity, before):
        """Signed distance to the threshold that holds now: positive means yes.

        Args:
            quantity: computed value(s).
            before: the decision(s) of the step before.
        """
        return _where(before, self.leave.margin(quantity), self.enter.margin(quantity))

    def decide(self, quantity, before):
        """The decision, given the one before."""
        return _where(before, self.leave.decide(quantity), self.enter.decide(quantity))


def _where(condition, yes, no):
    if isinstance(yes, np.ndarray | np.generic | float | bool):
        return np.where(condition, yes, no)
    # jax's arrays are selected by jax, without the event core depending on being traced
    import jax.numpy as jnp

    return jnp.where(condition, yes, no)
