"""A threshold, the margin of a quantity to it, and the decision that follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnum.errors import InputError

INCLUSIVE = {"<": False, "<=": True}


@dataclass(frozen=True)
class Threshold:
    """A number that a computed quantity is compared with, and how.

    The comparison is part of the physics: codes that agree on a cutoff still disagree on `<` against `<=`
    and on comparing r or r², and then on pairs that sit at the cutoff.

    Attributes:
        value: the threshold in the quantity's own space, exactly as the program compares it: a number, or an
            array that a compiled program is given.
        comparison: "<" or "<=": the decision is yes when `quantity comparison value`.
        space: name of the quantity's space, for example "r", "r2" or "height".
    """

    value: Any
    comparison: str = "<"
    space: str = "r"

    def __post_init__(self):
        if self.comparison not in INCLUSIVE:
            raise InputError(f"unknown comparison {self.comparison!r}; known are {', '.join(INCLUSIVE)}")

    def margin(self, quantity):
        """threshold - quantity: positive means yes.

        Error: exact when the quantity is within a factor two of the threshold (Sterbenz' lemma), and of the
        right sign always, because IEEE subtraction of unequal numbers never gives zero (gradual underflow).
        """
        return self.value - quantity

    def decide(self, quantity):
        """The decision itself, of the shape of the quantity; NaN decides no."""
        return quantity <= self.value if INCLUSIVE[self.comparison] else quantity < self.value

    def ambiguous(self, quantity, bound):
        """Whether another legitimate rounding of the quantity could have decided otherwise.

        Args:
            quantity: computed value(s).
            bound: bound(s) on |computed - exact| in the quantity's space.
        """
        return np.abs(self.margin(quantity)) <= bound
