"""Locate jumps and kinks of a curve, down to adjacent floating-point numbers.

A curve consists of an energy and the force along one coordinate. Each energy is predicted twice: from the
points to its left and to its right. On a smooth curve, the predictions' difference falls with the fourth
power of the spacing. At a kink, the difference falls only linearly. At a jump, it does not fall. The decrease
of the difference identifies the kind of singularity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from jaxtyping import Float

_SLOPE = np.array([-25.0, 48.0, -36.0, 16.0, -3.0]) / 12.0  # one-sided, error fourth power of the spacing
_CLOSER = (3e-9, 1e-7, 1e-6, 1e-5)  # relative spacings for scatter: float32 is constant over the first
_WIDTHS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # spacings of a one-sided slope; that of the smallest error is kept
_EXTRAPOLATE = np.array([-0.3125, 1.3125, -2.1875, 2.1875])  # half a spacing beyond four points (cubic)
_DIVISIONS, _NARROWER = 24, 6  # how much each zoom narrows: four of the divisions are kept
_LEVELS = 10
_OUTLIER = 4.0  # a mismatch this many times those around it is a suspect
#: The same for an eighth difference, which may consist of rounding errors only: the largest of about a
#: hundred is five times the median.
_STANDS_OUT = 10.0
_TOLD = 3.0  # a step so many times what stands out of a scan is also located, wherever it is in its interval
_EIGHTH = np.array([1.0, -8.0, 28.0, -56.0, 70.0, -56.0, 28.0, -8.0, 1.0])
_OF_A_STEP = 35.0  # a step of 1 makes the two eighth differences whose middle is beside it so large
_SQUARE = 0.15  # how near to 2 the power is with which a mismatch falls where a second derivative jumps
_ALONE = 6.0  # times the mismatch of the others at which one of them is alone
_SEEN = 3  # zooms at which it does so, at least; what cannot be resolved does for one or two
_FELT = 1e-13  # of a force a little before an end: below, its decay tells nothing
_STEEPEST = 8.0  # a power above which two places are enough to tell that no low derivative jumps
_SURE = 6.0  # a jump this many times what rounding and truncation could make of nothing is one

SMOOTH = 3  # order of a threshold at which neither energy, force nor curvature jumps, if no more is known


class Curve:
    """Energy and force along one coordinate. No point of the curve is evaluated twice.

    Args:
        at: function that returns (energy, force = -dE/dx) at a coordinate.
    """

    def __init__(self, at: Callable[[float], tuple[float, float]]):
        self._at = at
        self.known: dict[float, tuple[float, float]] = {}

    def __call__(self, x: float) -> tuple[float, float]:
        """Return (energy, force) at x."""
        x = float(x)
        if x not in self.known:
            self.known[x] = self._at(x)
        return self.known[x]

    def many(self, places: Sequence[float] | np.ndarray) -> Float[np.ndarray, "2 points"]:
        """Return the energies (first row) and forces (second row) at several points."""
        return np.array([self(float(x)) for x in places]).T


def bisect(question: Callable[[float], bool], low: float, high: float) -> tuple[float, float]:
    """Find adjacent doubles between which a condition changes."""
    before = question(low)
    while True:
        middle = low + 0.5 * (high - low)
        if not low < middle < high:
            return low, high
        if question(middle) == before:
            low = middle
        else:
            high = middle


def grid(low: float, high: float, step: float) -> Float[np.ndarray, "points"]:
    """Return evenly spaced coordinates, at most `step` apart, that `find_jumps` scans."""
    return np.linspace(low, high, max(int(np.ceil((high - low) / step)), 12) + 1)


def scatter(curve: Curve, low: float, high: float, room: float) -> Float[np.ndarray, "2 2"]:
    """Estimate the noise of energy and force (columns) below `low` and above `high` (rows).

    The largest of several estimates is returned, because close float32 values can be equal.
    """
    sides = []
    for start, sign in ((low, -1.0), (high, 1.0)):
        worst = np.zeros(2)
        for relative in _CLOSER:
            width = max(abs(start), 1.0) * relative
            if 9 * width > room:
                break
            values = curve.many(start + sign * width * np.arange(1, 9))
            worst = np.maximum(worst, np.abs(np.diff(values, 4, axis=1)).max(axis=1) / np.sqrt(70.0))
        sides.append(worst)
    return np.array(sides)


def slope(curve: Curve, start: float, sign: int, room: float, noise: float) -> tuple[float, float]:
    """Return the one-sided derivative dF/dx at `start`, and its error."""
    best = (0.0, np.inf)
    for relative in _WIDTHS:
        width = max(abs(start), 1.0) * relative
        if 8 * width > 2 * room and np.isfinite(best[1]):
            break
        fine = curve.many(start + sign * width * np.arange(5))[1] @ _SLOPE * sign / width
        coarse = curve.many(start + sign * 2 * width * np.arange(5))[1] @ _SLOPE * sign / (2 * width)
        error = abs(fine - coarse) + 12 * noise / width + 1e-14 * abs(fine)
        if error < best[1]:
            best = (float(fine), float(error))
    return best


def _bend(curve: Curve, start: float, sign: int, room: float) -> float:
    """Estimate the size of the force's second derivative on one side."""
    width = min(1e-3 * max(abs(start), 1.0), room / 4)
    force = curve.many(start + sign * width * np.arange(3))[1]
    return abs(float(force[0] - 2 * force[1] + force[2])) / width**2


def _close(curve: Curve, start: float, toward: float) -> Float[np.ndarray, "2 points"]:
    places = [start]
    for _ in range(3):
        places.append(float(np.nextafter(places[-1], toward)))
    return curve.many(places)


@dataclass(frozen=True)
class Jump:
    """A coordinate at which a curve or one of its derivatives jumps."""

    low: float  # the last coordinate before it
    high: float  # the first one after it; the next double after low where `exact`
    # energy, force, curvature: after minus before, of the energy, the force and the energy's second
    # derivative
    energy: float
    force: float
    curvature: float
    # 0 where the energy jumps, 1 the force, 2 the curvature; 3 where none of them does beyond doubt
    order: int
    exact: bool  # whether low and high are neighbors among the doubles
    # jump of the third derivative of the energy, where that is the lowest that jumps; else 0
    third: float = 0.0

    @property
    def at(self) -> float:
        """Coordinate at which the curve or one of its derivatives jumps."""
        return self.low if self.exact else 0.5 * (self.low + self.high)


def find_jumps(
    curve: Curve,
    low: float,
    high: float,
    step: float,
    most: int = 24,
    expected: Sequence[float] = (),
    calls: float = np.inf,
) -> tuple[list[Jump], int]:
    """Find jumps of the energy and its derivatives that exceed the noise.

    The smallest detectable jump depends on the curvature of the curve. The function `smallest_steps` returns
    the smallest detectable jump of the force. At a spacing of 0.025 Å, the scan finds 199 of 200 force jumps
    of 1e-6 eV/Å in five potentials. It finds all larger jumps. The scan finds energy jumps of 3e-6 eV on a
    repulsive wall of ε = 1 eV, and of 1e-8 eV on a soft wall.

    Args:
        curve: energy and force, which must be defined slightly beyond both ends.
        step: spacing of the scan. Two thresholds closer together than this spacing may be taken for one.
        most: largest number of intervals to zoom into, starting with the most prominent.
        expected: coordinates of known jumps, which are left out.
        calls: number of curve evaluations after which no further interval is examined; the first always is.

    Returns:
        (jumps in order of the coordinate, number of prominent intervals that were not examined).
    """
    suspects = [
        one
        for one in _outliers(curve, grid(low, high, step))[0]
        if not any(one[1] - 2.5 * step < place < one[2] + 2.5 * step for place in expected)
    ]
    found: list[Jump] = []
    done = 0

    def known(left: float, right: float, jump: Jump) -> bool:
        # a third derivative that jumps stands out of the intervals beside its own as well
        margin = 3 * step if jump.order == SMOOTH else 0.0
        return jump.low >= left - margin and jump.high <= right + margin

    for _, left, right in suspects[:most]:
        if done and len(curve.known) > calls:
            break
        done += 1
        if not any(known(left, right, jump) for jump in found):
            new = _zoom(curve, left, right)
            found += [one for one in new if not any(_same(one, other) for other in found)]
    return sorted(found, key=lambda jump: jump.at), len(suspects) - done


def measure(curve: Curve, low: float, high: float, room: float, exact: bool, curved: bool = True) -> Jump:
    """Measure the jumps between `low` and `high`, and the changes that a smooth curve would have.

    Energies and forces on either side are medians of four values, so that one rounding error has no effect.
    The curvature is computed from one-sided differences of the force.

    Args:
        room: length, on either side, within which the curve may be evaluated.
        exact: whether low and high are adjacent doubles.
        curved: whether the curvature is measured too; if not, it is nan.
    """
    left, right = _close(curve, low, -np.inf), _close(curve, high, np.inf)
    values = np.median(right, axis=1) - np.median(left, axis=1)
    floor = scatter(curve, low, high, room).max(axis=0)
    spread = np.maximum(np.ptp(left, axis=1), np.ptp(right, axis=1)) + 4 * floor
    curvature, doubt = np.nan, np.inf
    if curved or not exact:
        before, doubt_before = slope(curve, low, -1, room, floor[1])
        after, doubt_after = slope(curve, high, 1, room, floor[1])
        if not exact:  # between the two sides the curve goes its smooth way too
            force = abs(curve(low)[1]) + abs(curve(high)[1])
            spread = spread + (high - low) * np.array([force, max(abs(before), abs(after))])
        if curved:
            curvature, doubt = before - after, doubt_before + doubt_after  # E'' is -F'
            if not exact:
                doubt += (high - low) * (_bend(curve, low, -1, room) + _bend(curve, high, 1, room))
    jumps, doubts = np.array([*values, curvature]).tolist(), np.array([*spread, doubt]).tolist()
    order = next((k for k in range(3) if abs(jumps[k]) > _SURE * doubts[k]), SMOOTH)
    return Jump(low, high, jumps[0], jumps[1], jumps[2], order, exact)


def decay_power(curve: Curve, edge: float, room: float) -> float | None:
    """Return the power p of |F| ~ (edge - x)^p near `edge`. None if it is unclear.

    Args:
        edge: end of the interaction, approached from smaller distances; no other threshold is within `room`.
    """
    distances = room * 0.5 ** np.arange(2, 14)
    forces = np.abs(curve.many(edge - distances)[1])
    floor = max(float(scatter(curve, edge - room / 3, edge, room / 3)[0, 1]), 1e-300)
    # far below what is felt a law may fall to the smallest numbers there are, with no power at all
    good = forces > max(1e3 * floor, _FELT * float(forces.max()))
    if good.sum() < 2:
        return None
    slopes = np.diff(np.log(forces[good])) / np.diff(np.log(distances[good]))
    if good.sum() < 4:
        return float(slopes.min()) if slopes.min() > _STEEPEST else None
    return float(np.median(slopes[-4:]))


def smallest_steps(
    curve: Curve, low: float, high: float, step: float
) -> tuple[Float[np.ndarray, "intervals"], Float[np.ndarray, "intervals"]]:
    """Return the scanned intervals, and the smallest detectable force jump in each.

    Returns:
        (midpoints of the compared intervals, smallest detectable force step in each interval, eV/Å).

    Error:
        all 125 steps of this size, added to five potentials, are found; of steps a third as large, half are
        found.
    """
    places = grid(low, high, step)
    seen = _outliers(curve, places)[1]
    compared = np.isfinite(seen)
    return (0.5 * (places[:-1] + places[1:]))[compared], _TOLD * seen[compared]


def _outliers(
    curve: Curve, places: Float[np.ndarray, "points"]
) -> tuple[list[tuple[float, float, float]], Float[np.ndarray, "intervals"]]:
    """Find the intervals in which the predictions from left and right disagree.

    Returns:
        (relative difference, left, right) of each outlier, the largest first; and the smallest detectable
        force step of each interval, infinite near both ends, where there are no intervals to compare with.
    """
    middle = places[len(places) // 2]
    noise = scatter(curve, middle, middle, places[-1] - places[0]).min(axis=0)
    sums = np.array([*noise, 2 * noise[0] + (places[1] - places[0]) * noise[1]])
    # (row, interval of its first value, what rounding leaves of it, times the usual that stand out)
    rows = [(row, 3, 64 * least, _OUTLIER) for row, least in zip(_mismatch(curve, places), sums, strict=True)]
    # eighth differences of energy and force, the smaller of the two centered on an interval's endpoints: on a
    # repulsive wall they are a hundredth of the mismatch; a step and the rounding error are amplified alike
    eighth = np.abs(np.lib.stride_tricks.sliding_window_view(curve.many(places), 9, axis=1) @ _EIGHTH)
    eighth = np.minimum(eighth[:, :-1], eighth[:, 1:])
    rows += [(row, 4, 900 * least, _STANDS_OUT) for row, least in zip(eighth, noise, strict=True)]
    kept: dict[int, float] = {}
    smallest = np.full(len(places) - 1, np.inf)
    for number, (values, first, least, times) in enumerate(rows):
        # of so few numbers Python's own median takes a tenth of the time of numpy's
        row = values.tolist()
        for k, value in enumerate(row):
            around = row[max(k - 12, 0) : max(k - 3, 0)] + row[k + 4 : k + 13]
            usual = max(median(around) if around else 0.0, float(least), 1e-300)
            if number == len(rows) - 1:
                smallest[first + k] = times * usual / _OF_A_STEP
            if value >= max(row[max(k - 3, 0) : k + 4]) and value > times * usual:
                kept[first + k] = max(kept.get(first + k, 0.0), value / usual)
    ranked = sorted(((ratio, k) for k, ratio in kept.items()), reverse=True)
    return [(ratio, float(places[k]), float(places[k + 1])) for ratio, k in ranked], smallest


def _mismatch(curve: Curve, places: Float[np.ndarray, "points"]) -> Float[np.ndarray, "3 intervals"]:
    """Return three mismatches for each interval. Mismatches are small on a smooth curve.

    The first two mismatches are differences between predictions of the energy and of the force. The third
    mismatch, energy change plus work, falls with the fifth power of the spacing. The third mismatch detects
    the smallest jumps of the energy alone.
    """
    values = curve.many(places)
    windows = np.lib.stride_tricks.sliding_window_view(values, 4, axis=1)
    ends = np.abs((windows @ _EXTRAPOLATE)[:, :-4] - (windows @ _EXTRAPOLATE[::-1])[:, 4:])
    width = places[1] - places[0]
    work = width / 24 * (windows[1] @ np.array([-1.0, 13.0, 13.0, -1.0]))
    unexplained = np.abs(np.diff(values[0])[1:-1] + work)
    return np.vstack([ends, unexplained[2:-2]])


def _zoom(curve: Curve, left: float, right: float) -> list[Jump]:
    """Find the jumps between `left` and `right`, down to two adjacent doubles."""
    room = right - left
    left, right = left - 1.5 * room, right + 1.5 * room
    noise = np.maximum(scatter(curve, left, right, room).max(axis=0), 1e-300)
    history: list[np.ndarray] = []
    clear: list[np.ndarray] = []
    seconds, place = 0, (left, right)
    for _ in range(_LEVELS):
        width = (right - left) / _DIVISIONS
        mismatch = _mismatch(curve, np.linspace(left - 4 * width, right + 4 * width, _DIVISIONS + 9))
        floor = np.array([*noise, 2 * noise[0] + width * noise[1]])
        usual = np.maximum(floor, np.median(mismatch, axis=1))
        best = int(np.argmax((mismatch / usual[:, None]).max(axis=0)))
        history.append(mismatch[:, best])
        clear.append(mismatch[:, best] > 30 * floor)
        # a jump shows more in the intervals beside it than in its own
        left, right = left + (best - 2.5) * width, left + (best + 1.5) * width
        if not clear[-1].any():
            break
        if len(history) < 2:
            continue
        falls = history[-1] / np.maximum(history[-2], 1e-300)
        # a force whose second derivative jumps: its mismatch falls with the square of the spacing, exactly,
        # and there alone; at the points of a table it does so everywhere
        alone = mismatch[1, best] > _ALONE * usual[1]
        if clear[-1][1] and alone and abs(np.log(max(falls[1], 1e-300)) / np.log(_NARROWER) + 2) < _SQUARE:
            seconds, place = seconds + 1, (left, right)
        for row in (1, 0):
            jumped = abs(_level(curve, row, left, right)(right) - curve(left)[row])
            now = history[-1][row]
            if clear[-1][row] and 0.8 < falls[row] < 1.3 and 0.7 * jumped < now < 1.4 * jumped:
                jump = measure(curve, *locate(curve, row, left, right), room, exact=True)
                if jump.order < 2:
                    return [jump]
        if len(history) > 2 and (falls < _NARROWER**-2.5).all():
            break
    bends = [row[1] for row, yes in zip(history, clear, strict=True) if yes[1]]
    if len(bends) < 2 or bends[-1] < bends[-2] / _NARROWER**1.6:
        return _third(curve, *place, room, float(noise[1])) if seconds >= _SEEN else []
    return _kink(curve, left, right, room)


def locate(curve: Curve, row: int, left: float, right: float) -> tuple[float, float]:
    """Bisect to the adjacent doubles between which energy or force jumps.

    Args:
        row: 0 for the energy minus the work done since the left end, 1 for the force.
    """
    level = _level(curve, row, left, right)
    middle = 0.5 * (level(left) + level(right))
    rising = level(right) > level(left)
    return bisect(lambda x: (level(x) > middle) == rising, left, right)


def _level(curve: Curve, row: int, left: float, right: float) -> Callable[[float], float]:
    """Remove the smooth change from the energy or force. The remaining curve changes only at jumps."""
    if row == 1:
        back = left - (right - left)
        slope_before = (curve(left)[1] - curve(back)[1]) / (left - back)
        return lambda x: curve(x)[1] - slope_before * (x - left)
    return lambda x: curve(x)[0] + 0.5 * (x - left) * (curve(left)[1] + curve(x)[1])


def _kink(curve: Curve, left: float, right: float, room: float) -> list[Jump]:
    """Locate a kink of the force, where the extrapolations from both sides intersect."""
    width = min(room / 8, 1e-3)
    middle, reach = 0.5 * (left + right), max(0.5 * (right - left), width / 8)
    roots = np.roots(-_pieces(curve, middle, reach, width, 3))
    real = roots[np.abs(roots.imag) < 1e-9].real
    near = real[np.abs(real) <= 2 * reach]
    if len(near):
        middle, reach = middle + float(near[np.argmin(np.abs(near))]), min(reach, 1e-7)
    jump = measure(curve, middle - reach, middle + reach, room, exact=False)
    return [jump] if jump.order < SMOOTH else []


def _pieces(curve: Curve, middle: float, reach: float, width: float, degree: int) -> np.ndarray:
    """Difference of two polynomials, fitted to the force above and below `middle`."""
    steps = reach + width * np.arange(7)
    before = np.polyfit(-steps, curve.many(middle - steps)[1], degree)
    return np.polyfit(steps, curve.many(middle + steps)[1], degree) - before


def _third(curve: Curve, left: float, right: float, room: float, noise: float) -> list[Jump]:
    """Locate a jump of the energy's third derivative.

    The fit width is chosen so that half the width gives a similar result.
    """
    reach = 0.5 * (right - left)
    widths = [room / part for part in (6, 12, 24, 48) if room / part > 4 * reach]
    middle = 0.5 * (left + right)
    if widths:
        # both pieces touch where they meet
        square, line, _ = _pieces(curve, middle, reach, widths[-1], 4)[-3:]
        shift = -0.5 * line / square if square else np.inf
        if abs(shift) < 4 * reach:
            middle += float(shift)
    values = []
    for width in widths:
        whole, half = (2 * float(_pieces(curve, middle, reach, part, 4)[-3]) for part in (width, width / 2))
        values.append((whole, abs(whole - half) + 40 * noise / width**2))
    if not values:
        return []
    bent, error = min(values, key=lambda one: one[1])
    if abs(bent) <= _SURE * error:
        return []
    return [Jump(middle - reach, middle + reach, 0.0, 0.0, 0.0, SMOOTH, False, -bent)]


def _same(one: Jump, other: Jump) -> bool:
    near = 1e-9 * max(abs(one.at), 1.0) if one.exact and other.exact else 2e-4
    return abs(one.at - other.at) <= near
