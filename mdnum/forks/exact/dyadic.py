"""Exact arithmetic of numbers m 2^e: all that the steps of a bouncing ball need, without a gcd anywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import SupportsFloat


@dataclass(frozen=True, eq=False)
class Dyadic:
    """mantissa * 2**exponent, of any size. Sums, differences and products of these are these again."""

    mantissa: int
    exponent: int = 0

    @classmethod
    def of(cls, value: SupportsFloat) -> Dyadic:
        """A float of at most 64 bits, exactly.

        Raises:
            ValueError: it is not finite.
        """
        value = float(value)
        if not math.isfinite(value):
            raise ValueError(f"{value} is no number")
        numerator, denominator = value.as_integer_ratio()
        return cls(numerator, 1 - denominator.bit_length())

    def __add__(self, other: Dyadic) -> Dyadic:
        shift = self.exponent - other.exponent
        if shift >= 0:
            return Dyadic((self.mantissa << shift) + other.mantissa, other.exponent)
        return Dyadic(self.mantissa + (other.mantissa << -shift), self.exponent)

    def __neg__(self) -> Dyadic:
        return Dyadic(-self.mantissa, self.exponent)

    def __sub__(self, other: Dyadic) -> Dyadic:
        return self + -other

    def __mul__(self, other: Dyadic) -> Dyadic:
        return Dyadic(self.mantissa * other.mantissa, self.exponent + other.exponent)

    def __lt__(self, other: Dyadic) -> bool:
        return (self - other).mantissa < 0

    def __le__(self, other: Dyadic) -> bool:
        return (self - other).mantissa <= 0

    @property
    def negative(self) -> bool:
        """Whether it is below zero."""
        return self.mantissa < 0

    @property
    def zero(self) -> bool:
        """Whether it is zero."""
        return self.mantissa == 0

    def fraction(self) -> Fraction:
        """The same number."""
        return Fraction(self.mantissa) * Fraction(2) ** self.exponent

    def __float__(self) -> float:
        size = abs(self.mantissa)
        cut = max(0, size.bit_length() - 64)
        # the last of 64 bits says whether anything was cut: the rounding to 53 is then the correct one
        kept = size >> cut | bool(size & ((1 << cut) - 1))
        return math.ldexp(-kept if self.negative else kept, self.exponent + cut)


ZERO = Dyadic(0)
HALF = Dyadic(1, -1)
