"""A distance at which the program behind a calculator's answers changes."""

from __future__ import annotations

from dataclasses import dataclass

from mdnum.audit.jumps import Jump
from mdnum.audit.probes import Pair

SMOOTHEST = 6
"""Orders above this are told as this one: that smooth or smoother."""


@dataclass(frozen=True)
class Threshold:
    """A distance at which the energy or one of its derivatives jumps, or beyond which nothing is left.

    Attributes:
        radius: the distance, length.
        species: of the two atoms (of the reference atoms of two molecules).
        order: the lowest derivative of the energy that jumps: 0 the energy, 1 the force, 2 the curvature, 3
            the third derivative, and so on; 6 stands for 6 or smoother.
        jumps: of energy (eV), force along the line (eV/Å) and curvature (eV/Å²): beyond minus before.
        doubt: how large each of them could look where nothing jumps.
        inside: the last distance before it that was told apart.
        outside: the first one beyond it; the next double where a value jumps.
        dies: whether the two do not interact beyond it.
        located: how far off radius can be, length.
        third: jump of the third derivative, eV/Å³, where that is the lowest and was measured; else 0.
    """

    radius: float
    species: tuple[str, str]
    order: int
    jumps: tuple[float, float, float]
    doubt: tuple[float, float, float]
    inside: float
    outside: float
    dies: bool
    located: float
    third: float = 0.0


def at_jump(pair: Pair, jump: Jump) -> Threshold:
    """The threshold that a jump on the way of a pair shows."""
    return Threshold(
        jump.high if jump.exact else jump.at, pair.species, jump.order,
        (jump.energy, jump.force, jump.curvature), jump.doubt, jump.low, jump.high, False,
        jump.high - jump.low, jump.third,
    )  # fmt: skip
