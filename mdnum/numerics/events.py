"""Decisions that compare a quantity with a threshold, and tables of their changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError

INCLUSIVE = {"<": False, "<=": True}


@dataclass(frozen=True)
class Threshold:
    """A threshold, and the operator that compares a quantity with the threshold.

    The comparison is part of the physical model. Programs that compare r or r², by `<` or `<=`, can differ
    for pairs exactly at the cutoff.
    """

    # the threshold in the quantity's own space, exactly as the program compares it: a number, or an array
    # that a compiled program is given
    value: Any
    comparison: str = "<"  # "<" or "<=": the decision is yes when `quantity comparison value`
    space: str = "r"  # name of the quantity's space, for example "r", "r2" or "height"

    def __post_init__(self):
        if self.comparison not in INCLUSIVE:
            raise InputError(f"comparison = {self.comparison!r}; expected one of {', '.join(INCLUSIVE)}")

    def margin(self, quantity):
        """Return threshold minus quantity. The margin is positive if the decision is "yes".

        The margin is exact for quantities within a factor of 2 of the threshold (Sterbenz lemma). The
        margin's sign is always correct, as the difference of unequal numbers is never zero.
        """
        return self.value - quantity

    def decide(self, quantity):
        """Return whether the comparison is true. False for NaN."""
        return quantity <= self.value if INCLUSIVE[self.comparison] else quantity < self.value


@dataclass(frozen=True)
class Hysteresis:
    """A decision with hysteresis: two thresholds turn the decision on and off.

    With one threshold, a fluctuating quantity flips the decision at each crossing. If the thresholds differ
    by more than the fluctuation, the decision flips only once. Similarly, a Verlet list with a skin is not
    rebuilt at every move.
    """

    enter: Threshold  # where a no turns yes
    # where a yes stays yes; turning no needs this threshold to be passed. The same space, and at least as
    # high as enter
    leave: Threshold

    def __post_init__(self):
        if self.enter.space != self.leave.space:
            raise InputError(
                f"enter and leave apply to different quantities, {self.enter.space} and {self.leave.space}"
            )
        enter, leave = self.enter.value, self.leave.value
        # traced values are checked where they were made
        if isinstance(enter, float | int) and isinstance(leave, float | int) and leave < enter:
            raise InputError(
                f"the threshold leave = {leave:g} is below the threshold enter = {enter:g}",
                remedy="Set leave to at least the value of enter",
            )

    def margin(self, quantity, before):
        """Return the signed distance to the current threshold, positive if the decision is "yes".

        Args:
            quantity: computed value(s).
            before: the decision(s) at the previous step.
        """
        return _where(before, self.leave.margin(quantity), self.enter.margin(quantity))

    def decide(self, quantity, before):
        """Return the decision for a quantity, given the decision at the previous step."""
        return _where(before, self.leave.decide(quantity), self.enter.decide(quantity))


def _where(condition, yes, no):
    if isinstance(yes, np.ndarray | np.generic | float | bool):
        return np.where(condition, yes, no)
    # jax's arrays are selected by jax, without the event core depending on being traced
    import jax.numpy as jnp

    return jnp.where(condition, yes, no)


@dataclass(frozen=True)
class Ledger:
    """Table of all flips of one kind of decision, sorted by step and labels.

    A flip at step s means that the decisions at s - 1 and s differ.

    Attributes:
        channel: name of the stream of decisions, for example "pair".
        step: step of each flip.
        subject: labels of the object of the decision, such as the two atoms of a pair, shape (flips, labels).
        entered: whether the decision changed from no to yes.
        margin: threshold minus quantity at the step of the flip, in the unit of the quantity.
        bound: bound of the rounding error of the quantity, in the same unit.
        jump: signed change of the conserved quantity (energy) by the flip.
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
        """True for flips that rounding could move: |margin| is within the error bound."""
        return np.abs(self.margin) <= self.bound

    def counts(self, steps: int) -> tuple[Int[np.ndarray, "steps"], Int[np.ndarray, "steps"]]:
        """Return the numbers of changes to yes and to no at each step."""
        entered = np.bincount(self.step[self.entered], minlength=steps + 1)
        left = np.bincount(self.step[~self.entered], minlength=steps + 1)
        return entered, left

    def jumps(self, steps: int) -> Float[np.ndarray, "steps"]:
        """Return the sum of the energy jumps of all flips at each step."""
        # bincount of nothing is a row of integers, whatever its weights
        return np.bincount(self.step, weights=self.jump, minlength=steps + 1).astype(np.float64)
