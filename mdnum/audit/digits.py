"""How many digits a calculator's answers carry: read off the numbers themselves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from ase import Atoms

from mdnum.audit.base import Subject
from mdnum.audit.noise import Noise, direction, displaced
from mdnum.references.findings import finding

#: Decimals of a number that are taken for rounding, at most: a double of more is too near to its own.
_MOST_DECIMALS = 9
_FEWEST = 4
"""Different answers, 0 aside, from which is judged."""

_POINTS = 8
_SPACING = 0.0137
"""Å between the points at which digits are read."""

_NOISY = 1e5
"""Noise, in units of the rounding of a double, above which fewer digits are told."""

#: Bits of a significand by the name of the format, the narrowest first.
_FORMATS = ((8, "bfloat16"), (11, "half precision"), (24, "single precision"))


@dataclass(frozen=True)
class Digits:
    """What all of some numbers share.

    Attributes:
        decimals: they are rounded to; None where to none.
        bits: of their significands, at most; 53 for a double that is used in full.
    """

    decimals: int | None
    bits: int

    @property
    def quantum(self) -> float:
        """Step between two numbers that are rounded to decimals; 0 for others."""
        return 0.0 if self.decimals is None else 10.0**-self.decimals


def digits(values: np.ndarray) -> Digits:
    """Decimals and bits of numbers; in full where there are too few different ones to tell."""
    found = np.unique(np.asarray(values, dtype=np.float64))
    found = found[np.isfinite(found) & (found != 0.0)]
    if len(found) < _FEWEST:
        return Digits(None, 53)
    whole = np.abs(np.ldexp(np.frexp(found)[0], 53)).astype(np.int64)
    trailing = np.log2((whole & -whole).astype(np.float64))
    bits = 53 - int(trailing.min())
    for decimals in range(_MOST_DECIMALS + 1):
        if all(float(f"{value:.{decimals}f}") == value for value in found):
            return Digits(decimals, bits)
    return Digits(None, bits)


def precision(
    subject: Subject, atoms: Atoms, noise: Noise, rng: np.random.Generator
) -> Iterator[dict[str, str]]:
    """A finding where answers carry fewer digits than a double: QUANTIZED, or LOW_PRECISION.

    Args:
        subject: the calculator.
        atoms: a line through this structure is walked.
        noise: of the answers there.
        rng: draws the line.
    """
    line = direction(len(atoms), rng)
    there = [displaced(atoms, k * _SPACING * line) for k in range(_POINTS)]
    energies = np.array([subject.energy(one) for one in there])
    forces = np.array([subject.forces(one) for one in there])
    energy, force = digits(energies), digits(forces)
    if energy.quantum or force.quantum:
        named = [
            f"{word} to {one.decimals} ({one.quantum:.0e} {unit})"
            for word, one, unit in (("the energy", energy, "eV"), ("forces", force, "eV/Å"))
            if one.quantum
        ]
        yield finding(
            "QUANTIZED",
            "warning",
            "answers are rounded to decimals",
            f"All answers are rounded to decimals: {', '.join(named)}. Along any path they go in steps of "
            "this size, at places that mean nothing; a smaller jump cannot be told from one of them.",
            "Hand over numbers as they were computed, and not through a text of few digits.",
        )
        return
    size, typical = float(np.max(np.abs(energies))), float(np.sqrt(np.mean(forces**2)))
    if not size or not typical:
        return
    ulps = noise.energy / np.spacing(size)
    whose, narrow = _narrowest(energy.bits, force.bits)
    share = noise.force / typical
    eps = np.finfo(np.float64).eps
    if narrow is None and not (ulps > _NOISY and share > _NOISY * eps):
        return
    carried = f"forces carry about {max(-np.log10(max(share, eps)), 0):.0f} digits"
    told = f"All {whose} are numbers of {narrow}" if narrow else "Answers scatter more than doubles do"
    yield finding(
        "LOW_PRECISION",
        "info",
        f"{whose} are of {narrow}" if narrow else "answers carry fewer digits than a double",
        f"{told}: along a line the energy scatters by {noise.energy:.1g} eV, {ulps:.1g} times the last bit "
        f"of a double of its size, and {carried}.",
        "Expect runs to part and energies to wander at this level; where it matters, compute in double "
        "precision.",
    )


def _narrowest(energy: int, force: int) -> tuple[str, str | None]:
    """(what carries few bits, the name of their format), None where neither energies nor forces do."""

    def named(bits: int) -> str | None:
        return next((name for most, name in _FORMATS if bits <= most), None)

    if both := named(max(energy, force)):
        return "answers", both
    return ("energies", found) if (found := named(energy)) else ("forces", named(force))
