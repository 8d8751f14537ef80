"""How many digits a calculator's answers carry: read off the numbers themselves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from ase import Atoms

from mdnum.audit.base import Subject
from mdnum.audit.noise import Noise, Steps, steps
from mdnum.references.findings import finding

#: Decimals of a number that are taken for rounding, at most: a double of more is too near to its own.
_MOST_DECIMALS = 9
#: Different answers, 0 aside, from which is judged.
_FEWEST = 4
#: Noise, in units of the rounding of a double, above which fewer digits are told.
_NOISY = 1e5
#: Of the root mean square force: half a step of forces above is one that a run and a derivative feel.
_SMALL = 1e-4
#: Of kT: what an energy in single precision may be rounded to.
_SMALL_ENERGY = 1e-2

#: Bits of a significand by the name of the format, the narrowest first.
_HALF = 11
_FORMATS = ((8, "bfloat16"), (_HALF, "half precision"), (24, "single precision"))


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


def precision(subject: Subject, atoms: Atoms, noise: Noise) -> Iterator[dict[str, str]]:
    """A finding where answers carry fewer digits than a double: QUANTIZED, or LOW_PRECISION.

    Whether answers go in steps is measured along a line, whatever the numbers look like: forces that were
    rounded before they were multiplied by a unit, or that come from rounded positions, are doubles in full.

    Args:
        subject: the calculator.
        atoms: a line through this structure is walked.
        noise: of the answers there.
    """
    stairs = steps(subject, atoms)
    energy, force = digits(stairs.energies), digits(stairs.forces)
    size, typical = float(np.max(np.abs(stairs.energies))), float(np.sqrt(np.mean(stairs.forces**2)))
    if not size or not typical:
        return
    sizes = {"the energy": energy.quantum or stairs.energy, "forces": force.quantum or stairs.force}
    single = {"the energy": _single(energy), "forces": _single(force)}
    coarse = [word for word, one in sizes.items() if one and not single[word]]
    # few bits show where a value has no room for steps on the line
    coarse += [
        word
        for word, one in (("the energy", energy), ("forces", force))
        if word not in coarse and one.bits <= _HALF
    ]
    if coarse:
        yield _quantized(coarse, sizes, {"the energy": energy, "forces": force}, stairs, typical)
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
        "warning" if noise.energy > _SMALL_ENERGY * subject.kT > 0 else "info",
        f"{whose} are of {narrow}" if narrow else "answers carry fewer digits than a double",
        f"{told}: along a line the energy scatters by {noise.energy:.1g} eV, {ulps:.1g} times the last bit "
        f"of a double of its size, and {carried}.",
        "Expect runs to part and energies to wander at this level; where it matters, compute in double "
        "precision.",
    )


def _single(one: Digits) -> bool:
    return _HALF < one.bits <= 24 and not one.quantum


def _quantized(
    coarse: list[str], sizes: dict[str, float], read: dict[str, Digits], stairs: Steps, typical: float
) -> dict[str, str]:
    units = {"the energy": "eV", "forces": "eV/Å"}
    said = []
    for word in coarse:
        one, size = read[word], sizes[word]
        how = next((name for most, name in _FORMATS if one.bits <= most), "")
        how = f"to {one.decimals} decimals" if one.quantum else f"to {how}" if how else ""
        step = f"in steps of {size:.2g} {units[word]}" if size else ""
        if size and word == "forces":
            step += f", {size / typical:.1g} of the typical force"
        said.append(", ".join(part for part in (f"{word} {how}".rstrip(), step) if part))
    bound = 0.5 * sizes["forces"] if "forces" in coarse else 0.0
    if "forces" in coarse and not bound:
        bound = 2.0 ** -read["forces"].bits * typical
    return finding(
        "QUANTIZED",
        "error" if bound > _SMALL * typical else "warning",
        "answers go in steps",
        f"Answers are rounded: {'; '.join(said)}. On a line of {stairs.length:.2g} Å, {len(stairs.energies)} "
        f"points gave {len(np.unique(stairs.energies))} different energies, and {stairs.share:.0%} of the "
        "force components that change at all stay the same between some of the points, where a smooth "
        "function changes at each. The steps are at places that mean nothing; a smaller jump cannot be told "
        "from one of them.",
        "Hand over numbers as they were computed: not through a text of few digits, a narrow format or a "
        "grid.",
    )


def _narrowest(energy: int, force: int) -> tuple[str, str | None]:
    """(what carries few bits, the name of their format), None where neither energies nor forces do."""

    def named(bits: int) -> str | None:
        return next((name for most, name in _FORMATS if bits <= most), None)

    if both := named(max(energy, force)):
        return "answers", both
    return ("energies", found) if (found := named(energy)) else ("forces", named(force))
