"""Comparison of two frames of the same atoms: displacements, their growth, and velocities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mdnum.trajectories.frame import AtomIndices, Box, Frame
from mdnum.trajectories.lattice import shortest

# displacements over what velocities say above which they contradict; correlations above which velocities keep
# their directions from frame to frame, and displacements lie along them
_TOO_FAR, _KEPT, _ALONG = 1.1, 0.8, 0.9
# last digits that a displacement has to have for its size to say something
_STEPS = 3.0
# velocities that differ by less than this share of their root mean square may have been rounded otherwise
_SAME_SPEED = 1e-4
# the steepest power law that is told from an exponential; how much smaller squares are of what fits better
_STEEPEST, _BETTER = 4.0, 2.0


# ---- positions


@dataclass(frozen=True)
class Separation:
    """Summary of the displacements of atoms between two frames."""

    furthest: float  # largest displacement, length
    typical: float  # root mean square displacement, length
    atom: int  # the one that is displaced furthest
    # most lattice vectors of one kind between an atom and its nearest image: 0 where none was wrapped in one
    # of the frames only
    periods: int = 0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of all atoms alike, taken off before, length


def displacements(
    start: Frame, end: Frame, atoms: AtomIndices = None, shift: Float[np.ndarray, "3"] | float = 0.0
) -> tuple[Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]]:
    """Return displacements between two frames without `shift`, and the numbers of lattice vectors removed."""
    x, y = (one.positions if atoms is None else one.positions[atoms] for one in (start, end))
    shared = np.asarray(start.box.pbc, bool) & np.asarray(end.box.pbc, bool)
    return shortest(y - x - shift, Box(end.box.matrix, shared))


def same_lattice(one: Box, other: Box, tolerance: float) -> bool:
    """Return True if two boxes generate the same lattice. The lattice vectors may differ.

    Components of lattice vectors may differ by up to `tolerance`, in length units.
    """
    if (np.asarray(one.pbc, bool) != np.asarray(other.pbc, bool)).any():
        return False
    rows = np.asarray(one.pbc, bool)
    a, b = np.asarray(one.matrix, np.float64)[rows], np.asarray(other.matrix, np.float64)[rows]
    if np.array_equal(a, b):
        return True
    # the vectors of one are whole combinations of the other's, and as many to a cell
    whole = np.rint(np.linalg.lstsq(a.T, b.T, rcond=None)[0].T)
    return bool(np.abs(b - whole @ a).max() <= tolerance and abs(round(np.linalg.det(whole))) == 1)


def separation(
    one: Frame, other: Frame, atoms: AtomIndices = None, shift: Float[np.ndarray, "3"] | None = None
) -> Separation:
    """Return the largest and root mean square displacement between two frames, without a common shift."""
    moved, whole = displacements(one, other, atoms, 0.0 if shift is None else shift)
    square = np.sum(moved**2, axis=1)
    at = int(np.argmax(square))
    return Separation(
        float(np.sqrt(square[at])),
        float(np.sqrt(square.mean())),
        at if atoms is None else int(atoms[at]),
        int(np.abs(whole).max()),
        (0.0, 0.0, 0.0) if shift is None else tuple(shift.tolist()),
    )


def common_shift(one: Frame, other: Frame, atoms: AtomIndices = None) -> Float[np.ndarray, "3"]:
    """Return the displacement common to most atoms, modulo lattice vectors, in length units."""
    shift = displacements(one, other, atoms)[0][0]
    for _ in range(2):
        # nearest images about one atom lie on both sides of the box if that atom is on the other; about the
        # median they do not
        shift = shift + np.median(displacements(one, other, atoms, shift)[0], axis=0)
    return shift


# ---- velocities


def velocities_of(frame: Frame) -> Frame:
    """Return a frame with velocities in place of positions."""
    assert frame.velocities is not None
    return Frame(frame.index, frame.time, frame.velocities, Box())


def velocities_differ(a: Frame, b: Frame, atoms: AtomIndices, bound: float) -> dict[str, Any] | None:
    """Describe how the velocities of two frames differ, apart from a common velocity.

    Args:
        bound: error bound of the difference of two velocities, in length per time.

    Returns:
        None if the velocities agree or neither frame has any; kind "zero" and the side without velocities; or
            kind "other", the least-squares factor from A to B, and the correlation.
    """
    rows = slice(None) if atoms is None else atoms
    u, v = (np.zeros((1, 3)) if one.velocities is None else one.velocities[rows] for one in (a, b))
    if not (u.any() and v.any()):
        return {"kind": "zero", "side": "B" if u.any() else "A"} if u.any() or v.any() else None
    rest = v - u - np.median(v - u, axis=0) * (len(u) > 2)
    if np.sqrt((rest**2).sum(axis=1)).max() <= 2 * bound + _SAME_SPEED * np.sqrt((u**2).sum(axis=1).mean()):
        return None
    products = float(np.vdot(u, u)), float(np.vdot(u, v)), float(np.vdot(v, v))
    correlation = products[1] / math.sqrt(products[0] * products[2])
    return {"kind": "other", "factor": products[1] / products[0], "correlation": correlation}


class FreeFlight(NamedTuple):
    """Comparison of the displacements between two frames with displacements predicted from velocities."""

    moved: float  # root mean square displacement over that of velocities times time
    factor: float  # displacements over the mean of both velocities times time, by least squares
    parallel: float  # correlation of the two
    kept: float  # correlation of the velocities with those of the frame before


def flight_of(start: Frame, end: Frame, step: float = 0.0) -> FreeFlight | None:
    """Compare displacements with predictions from velocities. None without velocities or motion.

    `moved` is the ratio of measured to predicted displacements. The ratio is about 1, or less if atoms turn
    around. `factor` is the ratio by least squares. The factor is about 1 for the right unit and constant
    directions.
    """
    if start.velocities is None or end.velocities is None or not end.time > start.time:
        return None
    u, v, moved = start.velocities, end.velocities, displacements(start, end)[0]
    mean = (u + v) / 2 * (end.time - start.time)
    if len(u) > 3:
        # a file may have been centered since
        mean, moved = mean - np.median(mean, axis=0), moved - np.median(moved, axis=0)
    expected, size, uu, vv = (float(np.vdot(one, one)) for one in (mean, moved, u, v))
    if not min(expected, size, uu, vv) > 0:
        return None
    resolved = size > moved.size * (_STEPS * step) ** 2
    return FreeFlight(
        resolved * float(np.sqrt(size / uu)) / (end.time - start.time),
        float(np.vdot(mean, moved)) / expected,
        float(np.vdot(mean, moved)) / float(np.sqrt(expected * size)),
        float(np.vdot(u, v)) / float(np.sqrt(uu * vv)),
    )


def odd_flight(flights: Sequence[FreeFlight]) -> dict[str, Any] | None:
    """Describe any contradiction between displacements, velocities and times (medians over frames).

    If atoms turn around between two frames, small displacements are expected. Small displacements contradict
    the velocities only if velocities keep their directions, parallel to the displacements.

    Returns:
        the factor by which displacements are too large (or too small, below 1), and whether it is a lower
            bound; None if there is no inconsistency.
    """
    if not flights:
        return None
    moved, factor, parallel, kept = np.median(np.array(flights), axis=0).tolist()
    if kept > _KEPT and parallel > _ALONG:
        return None if 1 / _TOO_FAR < factor < _TOO_FAR else {"factor": factor, "at_least": False}
    return {"factor": moved, "at_least": True} if moved > _TOO_FAR else None


# ---- over time


@dataclass(frozen=True)
class GrowthLaw:
    """Fits of an exponential and of a power law to a growing distance of two trajectories."""

    frames: int  # used
    rate: float  # of an exponential, per time
    r2: float  # of its line
    exponent: float | None  # of the power law that fits best; None where none is slow enough
    power_r2: float
    law: str  # "exponential" or "power", whichever leaves much less of the spread; else "either"


def growth(
    time: Float[np.ndarray, "frames"],
    length: Float[np.ndarray, "frames"],
    limit: float,
    began: tuple[float, float],
) -> GrowthLaw | None:
    """Fit an exponential and a power law to the growing distance of two trajectories.

    A constant error of a force or velocity makes the distance grow as a low power of time. Chaos makes the
    distance grow exponentially. Fits exclude distances that are zero or above `limit`.

    Args:
        began: earliest and latest possible time at which the separation began, as the origin of a power law.

    Returns:
        the law; None for fewer than five frames.
    """
    use = (length > 0) & (length < limit) & np.isfinite(length)
    if np.count_nonzero(use) < 5 or np.ptp(time[use]) == 0:
        return None
    x, y = time[use], np.log(length[use])
    spread = max(float(np.sum((y - y.mean()) ** 2)), np.finfo(float).tiny)

    def line(x: np.ndarray) -> tuple[float, float]:
        slope, offset = np.polyfit(x, y, 1)
        return float(np.sum((y - slope * x - offset) ** 2)) / spread, float(slope)

    left, rate = line(x)
    # where a power law begins is not seen if a file has rounded it away
    longest = max(x[0] - began[0], np.finfo(float).tiny)
    ahead = longest * np.geomspace(min(max((x[0] - began[1]) / longest, 1e-3), 1.0), 1.0, 40)
    laws = [line(np.log(x - x[0] + one)) for one in ahead if x.min() == x[0] > began[0]]
    slow, exponent = min((one for one in laws if 0 < one[1] <= _STEEPEST), default=(1.0, None))
    law = "power" if slow * _BETTER < left else "either"
    law = "exponential" if exponent is None or left * _BETTER < slow else law
    return GrowthLaw(len(x), rate, 1.0 - left, exponent, 1.0 - slow, law)
