"""Atoms further out, or further from one frame to the next, than any simulation takes them.

Formats that hold plain floats (dcd, trr, netcdf) take any bytes for coordinates: what damage leaves there is
often a number, and a huge one. It would count as a place, and would widen what rounding may have done to
every other pair of that frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from mdnum.trajectories.frame import Frame
from mdnum.trajectories.rules import Capped, Cutoff, Rule, SpeciesCutoffs

# Sizes of the system from its middle at which nothing is any more: unwrapped coordinates of a liquid get
# some thousand boxes far in a second; what flies off into empty space gets further.
_FAR_BOXES, _FAR_SIZES = 1e5, 1e6
# The same for what lies between two frames.
_LEAP_BOXES, _LEAP_SIZES = 100.0, 1e4
_UNIT = {32: 2.0**-24, 64: 2.0**-53}


def smallest_radius(rules: Sequence[Rule]) -> float:
    """The shortest length that any of the rules compares distances with; infinite where none does."""
    radii = [np.inf]
    for rule in rules:
        if isinstance(rule, SpeciesCutoffs):
            radii.extend(rule.radii.values())
        elif isinstance(rule, Cutoff | Capped):
            radii.append(rule.radius)
    return float(min(radii))


def far_out(
    frame: Frame,
    atoms: Int[np.ndarray, "chosen"] | None = None,
    radius: float = np.inf,
    bits: int = 64,
) -> tuple[int, int, str] | None:
    """The atom that is furthest out, where that is further than can be.

    Args:
        atoms: those that matter; None for all.
        radius: the length that distances are compared with.
        bits: width of a coordinate as it was read.

    Returns:
        (the atom, how many are too far out, why in words); None where none is.
    """
    x = frame.positions if atoms is None else frame.positions[atoms]
    if len(x) < 2:
        return None
    largest = np.abs(x).max(axis=1)
    top = float(largest.max())
    box = _box(frame)
    if ((box and top <= _FAR_BOXES * box / 2) or not top) and _apart(top, bits) <= radius:
        return None
    away = np.abs(x - np.median(x, axis=0)).max(axis=1)
    size = max(box, float(np.median(away)))
    limit = (_FAR_BOXES if box else _FAR_SIZES) * size
    if size and away.max() > limit:
        at = int(np.argmax(away))
        many = float(away[at]) / size
        what = "the box" if box >= size else "all the rest"
        why = f"{many:.2g} times the size of {what} away from the others"
        return _named(at, atoms), int(np.count_nonzero(away > limit)), why
    if _apart(top, bits) > radius:
        at = int(np.argmax(largest))
        why = f"so far out that float{bits} tells distances no better than to {_apart(top, bits):.2g}"
        return _named(at, atoms), int(np.count_nonzero(_apart(1.0, bits) * largest > radius)), why
    return None


def leap(
    before: Frame, now: Frame, atoms: Int[np.ndarray, "chosen"] | None = None
) -> tuple[int, float] | None:
    """The atom that is furthest from where it was a frame before, where that is further than can be.

    Wrapping an atom, or all of them at once after a long time, is none.

    Returns:
        (the atom, how far, length); None where there is no leap.
    """
    moved = now.positions - before.positions
    moved = moved if atoms is None else moved[atoms]
    box = _box(now)
    if len(moved) < 2 or (box and np.abs(moved).max() <= _LEAP_BOXES * box / 2):
        return None
    # all of them may be shifted together
    distance = np.abs(moved - np.median(moved, axis=0)).max(axis=1)
    x = now.positions if atoms is None else now.positions[atoms]
    size = max(box, float(np.median(np.abs(x - np.median(x, axis=0)).max(axis=1))))
    at = int(np.argmax(distance))
    if not size or distance[at] <= (_LEAP_BOXES if box else _LEAP_SIZES) * size:
        return None
    return _named(at, atoms), float(distance[at])


def _box(frame: Frame) -> float:
    """The longest lattice vector along which the frame repeats, length; 0 where it does not along each."""
    if not frame.box.pbc.all() or not np.isfinite(frame.box.matrix).all():
        return 0.0
    return float(np.linalg.norm(frame.box.matrix, axis=1).max())


def _apart(top: float, bits: int) -> float:
    """How far a distance is off between coordinates as large as this, twice over."""
    return 2 * 4 * float(np.sqrt(3)) * _UNIT[bits] * top


def _named(at: int, atoms: Int[np.ndarray, "chosen"] | None) -> int:
    return at if atoms is None else int(atoms[at])
