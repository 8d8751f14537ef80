"""The event model: thresholds, margins, decisions, and the ledger of flips."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError

INCLUSIVE = {"<": False, "<=": True}


@dataclass(frozen=True)
class Threshold:
    """A number that a computed quantity is compared with, and the comparison operator.

    The comparison is part of the physics: codes with the same cutoff may still differ in `<` against `<=` and
    in comparing r or r², and then they differ for pairs exactly at the cutoff.
    """

    # the threshold in the quantity's own space, exactly as the program compares it: a number, or an array
    # that a compiled program is given
    value: Any
    comparison: str = "<"  # "<" or "<=": the decision is yes when `quantity comparison value`
    space: str = "r"  # name of the quantity's space, for example "r", "r2" or "height"

    def __post_init__(self):
        if self.comparison not in INCLUSIVE:
            raise InputError(f"comparison {self.comparison!r}; expected one of {', '.join(INCLUSIVE)}")

    def margin(self, quantity):
        """Return threshold - quantity: positive means that the decision is "yes".

        Error: exact if the quantity is within a factor two of the threshold (Sterbenz' lemma); the sign is
        always right, because IEEE subtraction of unequal numbers never gives zero (gradual underflow).
        """
        return self.value - quantity

    def decide(self, quantity):
        """Return the decision, in the shape of the quantity; for NaN the decision is no."""
        return quantity <= self.value if INCLUSIVE[self.comparison] else quantity < self.value


@dataclass(frozen=True)
class Hysteresis:
    """A decision that turns yes at one threshold and no at another (a Schmitt trigger).

    A quantity that fluctuates about one threshold flips its decision each time. With a gap between two
    thresholds the decision flips once; choose a gap wider than the noise. The skin of a Verlet list is such a
    gap: the list is built when the skin is used up, not whenever an atom moves.
    """

    enter: Threshold  # where a no turns yes
    # where a yes stays yes; turning no needs this threshold to be passed. The same space, and at least as
    # high as enter
    leave: Threshold

    def __post_init__(self):
        if self.enter.space != self.leave.space:
            raise InputError(
                f"the two thresholds are for different quantities, {self.enter.space} and {self.leave.space}"
            )
        enter, leave = self.enter.value, self.leave.value
        # traced values are checked where they were made
        if isinstance(enter, float | int) and isinstance(leave, float | int) and leave < enter:
            raise InputError(
                f"the threshold for leaving, {leave:g}, is below the one for entering, {enter:g}",
                remedy="Set the threshold for leaving to at least the one for entering",
            )

    def margin(self, quantity, before):
        """Return the signed distance to the current threshold: positive means that the decision is "yes".

        Args:
            quantity: computed value(s).
            before: the decision(s) of the previous step.
        """
        return _where(before, self.leave.margin(quantity), self.enter.margin(quantity))

    def decide(self, quantity, before):
        """Return the decision for a quantity, given the previous decision."""
        return _where(before, self.leave.decide(quantity), self.enter.decide(quantity))


def _where(condition, yes, no):
    if isinstance(yes, np.ndarray | np.generic | float | bool):
        return np.where(condition, yes, no)
    # jax's arrays are selected by jax, without the event core depending on being traced
    import jax.numpy as jnp

    return jnp.where(condition, yes, no)


@dataclass(frozen=True)
class Ledger:
    """The flips of one channel in time, in the order of steps, then subjects.

    A flip at step s means that the decision at s differs from the decision at s - 1.

    Attributes:
        channel: name of the stream of decisions, for example "pair".
        step: step of each flip.
        subject: labels of what was decided, shape (flips, labels).
        entered: whether the decision turned yes.
        margin: signed distance to the threshold at the step of the flip, in the quantity's space.
        bound: rounding bound on the quantity, in the same space.
        jump: change of the conserved quantity (energy) by the flip, signed.
        extra: further columns by name, each of shape (flips,).
    """

    channel: str
    step: Int[np.ndarray, "flips"]
    subject: Int[np.ndarray, "flips labels"]
    entered: Bool[np.ndarray, "flips"]
    margin: Float[np.ndarray, "flips"]
    bound: Float[np.ndarray, "flips"]
    jump: Float[np.ndarray, "flips"]
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.step)

    @property
    def ambiguous(self) -> Bool[np.ndarray, "flips"]:
        """Whether another valid rounding could change the step of each flip: |margin| is within the bound."""
        return np.abs(self.margin) <= self.bound

    def counts(self, steps: int) -> tuple[Int[np.ndarray, "steps"], Int[np.ndarray, "steps"]]:
        """Return the numbers of decisions that turned yes and that turned no, at each step 0..steps."""
        entered = np.bincount(self.step[self.entered], minlength=steps + 1)
        left = np.bincount(self.step[~self.entered], minlength=steps + 1)
        return entered, left

    def jumps(self, steps: int) -> Float[np.ndarray, "steps"]:
        """Return the sum of the jumps of all flips at each step 0..steps."""
        # bincount of nothing is a row of integers, whatever its weights
        return np.bincount(self.step, weights=self.jump, minlength=steps + 1).astype(np.float64)
