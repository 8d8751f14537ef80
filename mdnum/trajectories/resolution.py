"""Resolution of the positions in a file, and its effect on pair decisions.

Rounding to three decimals changes every coordinate by up to 0.0005. Rounding can change the decision whether
a pair near the cutoff is inside. `infer` finds the decimal grid from the coordinates.

Rounding can move a cutoff crossing to another frame, hide a short contact, or create a crossing. A rounded
file does not show which flips rounding changed. `grid_effect` estimates the number of these flips. Random
pairs near the cutoff are moved by displacements found in the file. Flips are then counted with and without
rounding. In a nearest-neighbor rule, a flip exchanges two neighbors at similar distances. For
nearest-neighbor rules, random triples of atoms are moved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.frame import AtomIndices, Frame
from mdnum.trajectories.lattice import shortest

# Coordinates looked at: chance hits decide nothing long before.
_ENOUGH = 6000
# Roundings that a number in the file may have seen beside those to its grid (a product in the writer,
# reading, nm to Å), for finding the grid; and those that a coordinate in float32 has seen, nm to Å included.
_SLACK, _ROUNDINGS = 3.0, 2.0
_UNIT = {32: 2.0**-24, 64: 2.0**-53}
# Formats whose box is written with fewer digits than a float has: lengths in Å, angles in degrees.
_BOX_STEPS = {"PDB": (1e-3, 1e-2), "ENT": (1e-3, 1e-2), "GRO": (1e-4, 0.0)}
# Steps of coordinates that formats have as a rule, Å.
_USUAL_STEPS = {"PDB": 1e-3, "ENT": 1e-3, "GRO": 1e-2, "XTC": 1e-2}

# decimal steps tried, in Å or in fractions of the box: from 1 down
_STEPS = tuple(one * 10.0**-k for k in range(13) for one in (1.0, 0.5, 0.2))
# significant digits tried; LAMMPS writes 6 unless told otherwise
_DIGITS = range(4, 13)
# what chance would do with no more than this probability is taken for meant
_CHANCE = np.log(1e-6)

_DRAWS = 200_000
# Displacements are read off where they are this many steps of the grid long, if frames are so far apart.
_CLEAR = 2.0
# Displacements are taken as they are where rounding makes up no more than the rest of their variance.
_MOSTLY = 0.8
# Pairs are drawn this many standard deviations of a displacement around the cutoff.
_WIDE = 4.0


@dataclass(frozen=True)
class Resolution:
    """Resolution of the positions in a file."""

    # "grid" (decimals of a length), "fractions" (decimals of the box's vectors), "float32", "float64", or
    # "unknown" where every coordinate looked at is 0 (bounds are then those of float32)
    kind: str
    # of the grid: length for "grid", a pure number for "fractions"; 0 for floats. Where digits are counted,
    # that of the largest coordinate it was found from
    step: float
    bits: int  # width of a coordinate as the reader hands it over, 32 or 64
    frames: int  # that it was found from
    moved: bool = True  # whether atoms moved between them; else the grid may be the structure's
    box: tuple[float, float] = (0.0, 0.0)  # step of the box's lengths, and of its angles, degrees
    digits: int = 0  # significant digits of every number, where it is these that are fixed
    told: bool = True  # whether the coordinates determine it; where all are 0, it is the format's usual one

    def bound(self, frame: Frame, atoms: AtomIndices = None) -> float:
        """Return the largest rounding error of a distance in a frame.

        The bound is a length. In the worst case, both atoms move in opposite directions by half a grid
        spacing along every axis. For pairs across a periodic boundary, the rounding error of the box is
        added. For float64 positions, the bound is the rounding error of the distance. The difference between
        a distance and the cutoff has the same bound. The difference between two neighbors' distances has
        twice the bound. If `atoms` are given, the bound holds for distances between these atoms.

        The bound holds within one period of the box. Each further period adds the rounding error of the box.
        """
        if atoms is not None or not np.isfinite(frame.furthest):
            x = frame.positions if atoms is None else frame.positions[atoms]
            # atoms that are nowhere have no distances
            frame = replace(frame, positions=x[np.isfinite(x).all(axis=1)], velocities=None)
        largest, rows = frame.furthest, frame.box.matrix[frame.box.pbc]
        # the largest sum of the lattice's components along an axis
        lattice = float(np.abs(rows).sum(axis=0).max()) if len(rows) else 0.0
        coordinate, box = self._half(frame), 0.0
        if self._narrow:
            # the box comes through the same reader
            coordinate += _ROUNDINGS * _UNIT[32] * largest
            box = _ROUNDINGS * _UNIT[32] * lattice
        if frame.box.periodic:
            box += np.sqrt(3) / 2 * self.box[0]
            # right angles are meant to be right
            if np.count_nonzero(rows) > len(rows):
                box += np.sqrt(3) / 2 * np.radians(self.box[1]) * lattice
        arithmetic = 16 * _UNIT[64] * (largest + lattice)
        return float(2 * np.sqrt(3) * coordinate + box + arithmetic)

    def usual_step(self, frame: Frame) -> float:
        """Return the root mean square size of the last digit, in length units."""
        if not len(frame.positions):
            return 0.0
        if not self.step:
            # of a float, twice the unit roundoff; its mantissas are spread from 1/2 to 1
            return 2 * _UNIT[32 if self._narrow else 64] * float(np.sqrt((frame.positions**2).mean()))
        if self.kind == "fractions":
            steps = steps_of(_fractions_of(frame), self.step, self.digits)
            # a step along each lattice vector, and the mean over the axes
            return float(np.sqrt((((steps**2).mean(axis=0)[:, None]) * frame.box.matrix**2).sum() / 3))
        return float(np.sqrt((steps_of(frame.positions, self.step, self.digits) ** 2).mean()))

    @property
    def _narrow(self) -> bool:
        return self.kind in ("float32", "unknown") or self.bits == 32

    def _half(self, frame: Frame) -> float:
        """Return half the largest grid spacing of an axis, in length units."""
        if not self.step or not len(frame.positions):
            return 0.0
        if self.kind == "fractions":
            largest = np.abs(_fractions_of(frame)).max(axis=0) if self.digits else np.ones(3)
            steps = steps_of(largest, self.step, self.digits)
            return float((steps[:, None] * np.abs(frame.box.matrix)).sum(axis=0).max()) / 2
        return float(steps_of(np.array(frame.furthest), self.step, self.digits)) / 2


#: Resolution of coordinates that are rounded only to float32.
FLOAT32 = Resolution("float32", 0.0, 32, 0)


def infer(sample: Sequence[Frame], bits: int = 64, format: str = "") -> Resolution:
    """Infer the resolution of positions from a sample of frames.

    Args:
        sample: frames of one file, at least one.
        bits: width of the coordinates that the reader returns, in bits.
        format: name of the file format in the reader, used for formats with known rounding.
    """
    moved = np.zeros(len(sample[0].positions), bool)
    for frame in sample[1:]:
        moved |= (frame.positions != sample[0].positions).any(axis=1)
    # of atoms that move, the frames after the first: a run that starts from a crystal has that on its sites
    frames = sample[1:] if moved.any() else sample
    rows = moved if moved.any() else ~moved

    def numbers(of: Callable[[Frame], np.ndarray]) -> Float[np.ndarray, "values"]:
        values = np.concatenate([of(frame)[rows].ravel() for frame in frames])
        values = values[np.isfinite(values)]
        return values[:: max(len(values) // _ENOUGH, 1)]

    values, fractions = numbers(lambda frame: frame.positions), None
    if all(np.isfinite(one.box.matrix).all() and np.linalg.det(one.box.matrix) != 0 for one in frames):
        fractions = numbers(_fractions_of)
    box = _BOX_STEPS.get(format, (max(one.box.step for one in sample), 0.0))
    if not values.any():
        usual = _USUAL_STEPS.get(format, 0.0)
        kind = "grid" if usual else "unknown"
        return Resolution(kind, usual, bits, len(sample), bool(moved.any()), box, told=False)
    unit = _SLACK * _UNIT[bits]
    step, digits = decimal_grid(values, unit * np.abs(values))
    kind = "float32" if bits == 32 or bool((values == values.astype(np.float32)).all()) else "float64"
    kind = "grid" if step else kind
    if fractions is not None and len(values):
        size = max(float(np.abs(frame.box.matrix).max()) for frame in sample)
        # a product of three and a solution of three equations lie between
        slack = 8 * unit * (np.abs(fractions) + np.abs(values).max() / size)
        part, part_digits = decimal_grid(fractions, slack)
        # decimals of a box with few decimals are decimals too, of a finer grid
        if part * size > 2 * step:
            kind, step, digits = "fractions", part, part_digits
    return Resolution(kind, step, bits, len(sample), bool(moved.any()), box, digits)


def _fractions_of(frame: Frame) -> Float[np.ndarray, "atoms 3"]:
    """Return positions as fractional coordinates of the box."""
    return np.linalg.solve(frame.box.matrix.T, (frame.positions - frame.box.origin).T).T


# ---- which decimals numbers were written with


def decimal_grid(
    values: Float[np.ndarray, "values"], slack: Float[np.ndarray, "values"]
) -> tuple[float, int]:
    """Find the decimal grid on which all values lie within the tolerance `slack`.

    Returns:
        (the coarsest decimal step of which all values are multiples, 0); or (the step of the largest value,
            the common number of significant digits); or (0.0, 0) if the values are not decimals.
    """
    values, index = np.unique(values, return_index=True)
    slack = slack[index]
    some = values != 0
    values, slack = values[some], slack[some]
    if not len(values):
        return 0.0, 0
    fixed = _fixed(values, slack)
    floor = np.maximum(2 * slack, fixed)
    for digits in _DIGITS:
        steps = steps_of(values, 0.0, digits)
        # where they are finer than what is known already they say nothing
        coarse = steps > floor
        if not coarse.any():
            continue
        if _chance(floor[coarse] / steps[coarse]) > _CHANCE:
            break
        if _multiples(values[coarse], steps[coarse], slack[coarse]):
            return float(steps.max()), digits
    return fixed, 0


def steps_of(values: Float[np.ndarray, "*shape"], step: float, digits: int) -> Float[np.ndarray, "*shape"]:
    """Return the size of the last digit of each number."""
    if digits == 0:
        return np.full_like(values, step)
    size = np.where(values == 0, 1.0, np.abs(values))
    # just below a power of ten rounds up to it
    exponent = np.floor(np.log10(size * (1 + 1e-12)))
    return np.where(values == 0, 0.0, 10.0 ** (exponent + 1 - digits))


def _fixed(values: Float[np.ndarray, "values"], slack: Float[np.ndarray, "values"]) -> float:
    for step in _STEPS:
        if _chance(np.minimum(2 * slack / step, 1.0)) > _CHANCE:
            # finer steps are told from chance less well still
            return 0.0
        if _multiples(values, np.full_like(values, step), slack):
            return step
    return 0.0


def _chance(parts: Float[np.ndarray, "values"]) -> float:
    """Return the log probability that random values are as close to a grid as `parts`."""
    return float(np.log(np.maximum(parts, 1e-300)).sum())


def _multiples(values: np.ndarray, steps: np.ndarray, slack: np.ndarray) -> bool:
    ratio = values / steps
    return bool((np.abs(ratio - np.round(ratio)) * steps <= slack).all())


# ---- what rounding does to flips

Places = tuple[Float[np.ndarray, "draws 3"], ...]


@dataclass(frozen=True)
class GridEffect:
    """Estimated fractions of flips that rounding hides or creates."""

    missed: float  # share of the flips that happened between two frames and are not in the file at that frame
    invented: float  # share of the flips in the file that did not happen at that frame
    move: float  # root mean square displacement of an atom between two frames, along an axis, length


def grid_effect(
    resolution: Resolution,
    sample: Sequence[Frame],
    radius: float,
    first: Int[np.ndarray, "first"] | None = None,
    second: Int[np.ndarray, "second"] | None = None,
    *,
    ranked: bool = False,
    draws: int = _DRAWS,
) -> GridEffect | None:
    """Estimate how many flips rounding hides and creates.

    Args:
        resolution: resolution of the file.
        sample: consecutive frames at the stride of the analysis.
        radius: the cutoff length; if `ranked`, the approximate distance of the farthest neighbor.
        first: atoms on one side of a pair, whose neighbors are counted; None for all.
        second: atoms on the other side; None for the same atoms.
        ranked: True if neighbors are defined by the order of distances instead of a cutoff.
        draws: number of pairs or triples drawn.

    Returns:
        the fractions; None for fewer than two frames, no motion, all coordinates 0, or no radius.

    Error: both atoms of a pair are assumed to move independently and straight, and pairs to be uniformly
        distributed around the cutoff; the statistical error is about 1 % of the fractions. In an LJ liquid
        with known float64 positions, the fractions were correct to 0.01 at strides of 0.0002 to 0.1 τ; for
        the 4 nearest neighbors to 0.02, and for the 12 nearest to 0.07
        (tests/trajectories/test_resolution.py). Bonded atoms have less relative motion than assumed.
    """
    if len(sample) < 2 or not len(sample[0].positions) or not radius > 0:
        return None
    steps = _steps(resolution, sample[0])
    size = float(np.abs(steps).max())
    if size == 0:
        # one atom at the origin: nothing says how it is rounded
        return None
    moves = _moves(sample, size)
    everyone = np.arange(len(moves))
    one, other = moves[everyone if first is None else first], None
    other = one if second is None and first is not None else moves[everyone if second is None else second]
    if not one.any() and not other.any():
        return None
    random = np.random.default_rng(0)
    before, after = _drawn(random, one, other, radius, steps, draws, ranked)

    def decided(places: Places) -> np.ndarray:
        """True if a pair is inside the cutoff, or if atom 2 of a triple is nearer to atom 1 than atom 3."""
        squares = [((place - places[0]) ** 2).sum(axis=1) for place in places[1:]]
        return squares[0] < (squares[1] if ranked else radius**2)

    was, now = decided(before), decided(after)
    seen_was, seen_now = decided(_rounded(before, steps)), decided(_rounded(after, steps))
    happened, seen = was != now, seen_was != seen_now
    both = int((happened & seen & (now == seen_now)).sum())
    if not happened.any():
        return None
    invented = 1.0 - both / int(seen.sum()) if seen.any() else 0.0
    return GridEffect(1.0 - both / int(happened.sum()), invented, float(np.sqrt((moves**2).mean())))


def _drawn(
    random: np.random.Generator,
    one: Float[np.ndarray, "first 3"],
    other: Float[np.ndarray, "second 3"],
    radius: float,
    steps: Float[np.ndarray, "3 3"],
    draws: int,
    ranked: bool,
) -> tuple[Places, Places]:
    """Draw random pairs near the cutoff, or triples with equal distances. Return old and new positions."""
    moved = [moves[random.integers(len(moves), size=draws)] for moves in (one, other, other)[: 2 + ranked]]
    # the distance of the middle one of three counts twice where the others are on opposite sides
    spread = float(np.sqrt((1 + ranked) * (one**2).mean() + (1 + ranked) * (other**2).mean()))
    width = min(_WIDE * spread + (4 + 2 * ranked) * float(np.abs(steps).max()), radius)
    more = width * random.uniform(*((-0.5, 0.5) if ranked else (-1.0, 1.0)), draws)
    # anywhere on the grid
    places = [random.uniform(0.0, 1.0, (draws, 3)) @ steps]
    for sign in (-1.0, 1.0) if ranked else (1.0,):
        way = random.normal(size=(draws, 3))
        places.append(places[0] + ((radius + sign * more) / np.linalg.norm(way, axis=1))[:, None] * way)
    return tuple(places), tuple(place + move for place, move in zip(places, moved, strict=True))


def _steps(resolution: Resolution, frame: Frame) -> Float[np.ndarray, "3 3"]:
    """Return the grid vectors (rows, in length units) of rounded positions."""
    if resolution.kind == "fractions" and not resolution.digits:
        return resolution.step * frame.box.matrix
    return resolution.usual_step(frame) * np.eye(3)


def _moves(sample: Sequence[Frame], size: float) -> Float[np.ndarray, "atoms 3"]:
    """Return the displacements of all atoms between frames, corrected for rounding.

    Displacements span several frames, so that they exceed the spacing of the coordinate grid. The variance
    due to rounding is subtracted.
    """
    moves, lag, total = np.zeros_like(sample[0].positions), 0, 0.0
    for before, after in pairwise(sample):
        total = total + shortest(after.positions - before.positions, after.box)[0]
        moves, lag = total - total.mean(axis=0), lag + 1
        if np.sqrt((moves**2).mean()) >= _CLEAR * size:
            break
    variance = float((moves**2).mean())
    true = unrounded(variance, size)
    if true < _MOSTLY * variance:
        # most atoms seem to stand still and some to hop: what they do in truth has lost its shape
        return np.random.default_rng(0).normal(scale=np.sqrt(true), size=moves.shape) / lag
    return moves * ((np.sqrt(true / variance) if variance else 0.0) / lag)


def unrounded(variance: float, size: float) -> float:
    """Return the variance of displacements before rounding to multiples of `size`.

    Rounding increases the mean square of a displacement of n + f grid spacings by size² f (1 - f) (0 <= f <
    1). For normal displacements of variance v, the mean increase is size² (1/6 - sum over k of exp(-2 π² k² v
    / size²) / (π k)²).
    """
    low, high, k = 0.0, variance, np.arange(1, 200)
    for _ in range(60):
        middle = (low + high) / 2
        waves = np.exp(-2 * (np.pi * k) ** 2 * middle / size**2) / (np.pi * k) ** 2
        if middle + size**2 * (1 / 6 - waves.sum()) > variance:
            high = middle
        else:
            low = middle
    return low


def _rounded(places: Places, steps: Float[np.ndarray, "3 3"]) -> Places:
    size = np.diag(steps)
    if np.count_nonzero(steps) == 3 and size.all():
        return tuple(np.rint(x / size) * size for x in places)
    inverse = np.linalg.inv(steps)
    return tuple(np.rint(x @ inverse) @ steps for x in places)
