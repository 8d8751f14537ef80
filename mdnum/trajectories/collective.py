"""Detection of damaged files by an impossible motion of all atoms.

A counter overflow makes a coordinate equal for all atoms. A misread offset shifts all atoms. Planar systems,
linear systems, drift and wrapping are not reported as damage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

# share of their extent in every frame before to which atoms do not shrink together
_COLLAPSED = 0.02
# share of the atoms that do not come to one coordinate at once, and how many times those of any frame before
_ALIKE, _MORE = 0.2, 3.0
# a system that drifts goes about as far in every interval: how many times further it does not go at once, or
# than what is far between its first two frames
_SUDDEN = 10.0
# up to as many atoms may come to one place
_FEW = 3
# sizes of a system without a box that are far between two frames; a few atoms may be wrapped in a large box
_FAR, _FAR_FEW = 300.0, 1e4


@dataclass
class Collective:
    """Extents and positions of sampled atoms in the frames examined so far."""

    least: Float[np.ndarray, "3"] | None = None  # the smallest of `spreads` in any of them, length
    last: Float[np.ndarray, "some 3"] | None = None  # positions in the last one
    alike: float = 0.0  # the largest share of atoms that had one coordinate
    drift: float | None = None  # the longest shift of all atoms between two of them, length
    level: Bool[np.ndarray, "3"] | None = None  # coordinates that all atoms had in common in each of them

    def refuse(self, x: Float[np.ndarray, "some 3"], atoms: int, side: float, far: float) -> str | None:
        """Return why the motion of all atoms is impossible, or None.

        Args:
            x: positions of a sample of the atoms, which represents all atoms.
            atoms: number of all atoms.
            side: length of the shortest lattice vector; 0 without a periodic direction.
            far: smallest displacement between two frames that counts as large, length; 0 without a box.
        """
        now, least, last, alike = spreads(x), self.least, self.last, self.alike
        share, axis, value = _most_alike(x)
        self.least, self.last = now if least is None else np.minimum(now, least), x.copy()
        self.alike = max(alike, share)
        if least is None or last is None:
            return None
        constant = [f"{'xyz'[k]} = {x[0, k]:g}" for k in range(3) if (x[:, k] == x[0, k]).all()]
        # what was unwrapped may be wrapped
        if (place := _flat(now, np.minimum(least, side or np.inf), atoms, bool(constant))) is not None:
            return f"all atoms lie {', '.join([place, *constant])}, and in no frame before"
        if share > max(_ALIKE, _MORE * alike):
            there = x[:, axis] == value
            # of a sheet that becomes flat the digits of the file may be left
            thick = atoms * np.var(last[there, axis]) > 4 * least[1] * least[2]
            if thick and np.count_nonzero(there) > _FEW:
                return (
                    f"{there.mean():.0%} of all atoms have {'xyz'[axis]} = {value:g}, as in no frame before"
                )
        far = far or (_FAR if atoms > _FEW else _FAR_FEW) * float(now[2])
        shift = _shift(last, x, far)
        if shift > (_SUDDEN * far if self.drift is None else max(_SUDDEN * self.drift, far)):
            return f"all atoms are shifted by {shift:.3g} from where they were a frame before"
        self.drift = max(self.drift or 0.0, shift)
        return None

    def left(self, x: Float[np.ndarray, "some 3"], atoms: int) -> str:
        """Describe coordinates that were equal for all atoms until this frame. Otherwise ""."""
        last, was, level = self.last, self.level, (x == x[0]).all(axis=0)
        self.level = level if was is None else was & level
        if last is None or was is None or atoms <= _FEW or not was.any() or np.any(self.level):
            return ""
        shift, now = np.median(x - last, axis=0), spreads(x)
        apart = np.median(np.abs(x - last - shift), axis=0)
        # what starts flat leaves its plane no faster than it moves along it
        sudden = apart[was].max() > _SUDDEN * apart[~was].max(initial=0.0)
        sudden |= np.abs(shift[was]).max() > _FAR * now[2]
        gone = sudden and _flat(spreads(last), now, atoms, True) is not None
        return ", ".join(f"{'xyz'[k]} = {last[0, k]:g}" for k in np.flatnonzero(was)) if gone else ""


def spreads(x: Float[np.ndarray, "atoms 3"]) -> Float[np.ndarray, "3"]:
    """Return standard deviations of positions (lengths) along the principal axes, ascending."""
    away = x - x.mean(axis=0)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(away.T @ away / len(x)), 0.0))


def _flat(now: np.ndarray, before: np.ndarray, atoms: int, constant: bool) -> str | None:
    """Describe the plane, line or point into which all atoms collapsed, or None.

    In a correct file, rippled sheets may become flat. A collapse is reported only if the earlier thickness
    exceeded the distance between neighbors. If all atoms share a coordinate, a thickness of a fifth of the
    extent is enough.
    """
    thin, middle, long = now <= _COLLAPSED * before
    if before[2] > 0 and (long if atoms > _FEW else now[2] == 0):
        return "at one point"
    if middle and atoms * before[1] > 4 * before[2]:
        return "on a line"
    thick = atoms * before[0] ** 2 > 4 * before[1] * before[2]
    thick |= constant and atoms > _FEW and 5 * before[0] > before[2]
    return "in a plane" if thin and thick else None


def _most_alike(x: Float[np.ndarray, "some 3"]) -> tuple[float, int, float]:
    """Return the largest fraction of equal coordinates, their axis and their value.

    The second largest fraction is subtracted, as crystals have many equal coordinates.
    """
    ordered = np.sort(x, axis=0)
    repeated = np.count_nonzero(ordered[1:] == ordered[:-1], axis=0)
    axis = int(np.argmax(repeated))
    if repeated[axis] < _FEW:
        return 0.0, axis, 0.0
    values, counts = np.unique(x[:, axis], return_counts=True)
    *_, second, first = np.sort(np.append(counts, 0))
    return float(first - second) / len(x), axis, float(values[np.argmax(counts)])


def _shift(before: np.ndarray, now: np.ndarray, far: float) -> float:
    """Return the length of a displacement common to all atoms. 0 if there is none."""
    moved = now - before
    if len(now) < 2 or not far or np.abs(moved).max() <= far / (2 * _SUDDEN):
        return 0.0
    shift = np.median(moved, axis=0)
    size, apart = float(np.linalg.norm(shift)), float(np.median(np.abs(moved - shift).max(axis=1)))
    return size if size > 10 * apart else 0.0
