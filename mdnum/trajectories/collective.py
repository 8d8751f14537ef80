"""Where all atoms together do not move: damage that leaves finite numbers.

A counter that overflowed puts one coordinate of every atom at one value, a unit that changed shrinks them, an
offset that was misread shifts them. Planar and straight systems, drift, and wrapping are none of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# shares of their extent in every frame before, and in the one before, to which atoms do not shrink together
_COLLAPSED, _SQUEEZED = 0.02, 0.3
# a system that drifts goes about as far in every interval: how many times further it does not go at once, or
# than what is far between its first two frames
_SUDDEN = 10.0
# up to as many atoms may come to one place
_FEW = 3


@dataclass
class Collective:
    """What is known of some atoms in the frames before."""

    least: Float[np.ndarray, "3"] | None = None  # the smallest of `spreads` in any of them, length
    last: Float[np.ndarray, "some 3"] | None = None  # positions in the last one
    side: float = 0.0  # its shortest lattice vector, length; 0 without any
    drift: float | None = None  # the longest shift of all atoms between two of them, length

    def refuse(self, x: Float[np.ndarray, "some 3"], atoms: int, side: float, far: float) -> str | None:
        """Why the atoms cannot have moved to where they are now, in words; None where they may have.

        Args:
            x: positions of some of them, which stand for all.
            atoms: how many there are.
            side: the shortest lattice vector, length; 0 without any.
            far: what is far between two frames in this box, length; 0 without one.
        """
        now, least, last, before = spreads(x), self.least, self.last, self.side
        self.least, self.last, self.side = now if least is None else np.minimum(now, least), x.copy(), side
        if least is None or last is None:
            return None
        factor = _squeezed(last, x)
        if factor is None and least[2] > 0.2 * side > 0 and (shrunk := _squeezed(x, last)) is not None:
            # what fills a box cannot grow; what is in empty space may fly apart
            factor = 1 / shrunk
        if factor is not None and 0.5 * before <= side <= 2 * before:
            return f"all atoms are where they were a frame before, but {factor:.2g} times as far apart"
        constant = [f"{'xyz'[k]} = {x[0, k]:g}" for k in range(3) if (x[:, k] == x[0, k]).all()]
        # what was unwrapped may be wrapped
        if (place := _flat(now, np.minimum(least, side or np.inf), atoms, bool(constant))) is not None:
            return f"all atoms lie {', '.join([place, *constant])}, and in no frame before"
        far = far or 1e4 * float(now[2])
        shift = _shift(last, x, far)
        if shift > (_SUDDEN * far if self.drift is None else max(_SUDDEN * self.drift, far)):
            return f"all atoms are shifted by {shift:.3g} from where they were a frame before"
        self.drift = max(self.drift or 0.0, shift)
        return None


def spreads(x: Float[np.ndarray, "atoms 3"]) -> Float[np.ndarray, "3"]:
    """Standard deviations along the principal axes, length, the smallest first."""
    away = x - x.mean(axis=0)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(away.T @ away / len(x)), 0.0))


def _flat(now: np.ndarray, before: np.ndarray, atoms: int, constant: bool) -> str | None:
    """Where atoms of these spreads lie, in words, if that is a plane, a line or a point and never was before.

    Rippled sheets and bent chains may become flat and straight: across them atoms have to have been further
    apart than neighbors along them, or, where a coordinate is constant, a fifth of all of it.
    """
    thin, middle, long = now <= _COLLAPSED * before
    if before[2] > 0 and (long if atoms > _FEW else now[2] == 0):
        return "at one point"
    if middle and atoms * before[1] > 4 * before[2]:
        return "on a line"
    thick = atoms * before[0] ** 2 > 4 * before[1] * before[2]
    thick |= constant and atoms > _FEW and 5 * before[0] > before[2]
    return "in a plane" if thin and thick else None


def _squeezed(before: np.ndarray, now: np.ndarray) -> float | None:
    """The factor by which a picture of the frame before has shrunk; None where this is none of it."""
    a, b = before - before.mean(axis=0), now - now.mean(axis=0)
    # a picture has twelve numbers, which fit few atoms whatever they did
    if len(now) <= 4 * _FEW or np.sum(b**2) > _SQUEEZED**2 * np.sum(a**2):
        return None
    matrix = np.linalg.pinv(a.T @ a) @ (a.T @ b)
    factor = float(np.linalg.norm(matrix, 2))
    return factor if factor < _SQUEEZED and np.sum((b - a @ matrix) ** 2) < 0.2 * np.sum(b**2) else None


def _shift(before: np.ndarray, now: np.ndarray, far: float) -> float:
    """How far all atoms are shifted from where they were, length; 0 where not far, or not together."""
    moved = now - before
    if len(now) < 2 or not far or np.abs(moved).max() <= far / 2:
        return 0.0
    shift = np.median(moved, axis=0)
    size, apart = float(np.linalg.norm(shift)), float(np.median(np.abs(moved - shift).max(axis=1)))
    return size if size > 10 * apart else 0.0
