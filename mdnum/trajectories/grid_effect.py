"""What the grid of a file does to flips: how many it hides, and how many it makes up.

Rounding every coordinate moves a crossing to another frame, hides a short visit, or lets a pair that hovers
at the cutoff hop across it. From one file nobody can tell which flips those are, but how many there must be
can be estimated: pairs are drawn at random near the cutoff, move as atoms of the file do between two frames,
and are decided with and without rounding. Among the nearest neighbors a flip is two atoms at about the same
distance from a third that change places, and what is drawn are three atoms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.resolution import Resolution

Places = tuple[Float[np.ndarray, "draws 3"], ...]

_DRAWS = 200_000
# Displacements are read off where they are this many steps of the grid long, if frames are so far apart.
_CLEAR = 2.0
# Displacements are taken as they are where rounding makes up no more than the rest of their variance.
_MOSTLY = 0.8
# Pairs are drawn this many standard deviations of a displacement around the cutoff.
_WIDE = 4.0


@dataclass(frozen=True)
class GridEffect:
    """Flips with and without the rounding of the file, estimated."""

    missed: float  # share of the flips that happened between two frames and are not in the file at that frame
    invented: float  # share of the flips in the file that did not happen at that frame
    ratio: float  # flips in the file over flips that happened
    move: float  # root mean square displacement of an atom between two frames, along an axis, length
    lag: int  # frames between the two that it was read from
    frames: int  # frames it was estimated from


def grid_effect(
    resolution: Resolution,
    sample: Sequence[Frame],
    radius: float,
    first: Int[np.ndarray, "first"] | None = None,
    second: Int[np.ndarray, "second"] | None = None,
    *,
    ranked: bool = False,
    draws: int = _DRAWS,
    seed: int = 0,
) -> GridEffect | None:
    """Estimates what rounding to the file's resolution does to flips at a cutoff, or among the nearest.

    Args:
        resolution: of the file.
        sample: consecutive frames as they are looked at, at the stride in question.
        radius: the cutoff, length; where `ranked`, about how far the last of the nearest is away.
        first: atoms on one side of a pair, the ones that have neighbors; None for all.
        second: atoms on the other side; None for the same.
        ranked: whether it is the order of distances that decides, and no length.
        draws: pairs drawn, or triples.
        seed: of the draws.

    Returns:
        None where the frames cannot tell: fewer than two, nothing moves, or every coordinate is 0.

    Error: the atoms of a pair are taken to move independently and straight on, and pairs to be spread
        evenly around the cutoff; the draws themselves scatter by about 1 % of the shares. In an LJ liquid
        whose float64 positions were known the shares were right to 0.01 at strides of 0.0002 to 0.1 τ, among
        the 4 nearest to 0.02 and the 12 nearest to 0.07 (tests/trajectories/test_resolution.py). Atoms bonded
        to one another move together, and less against each other than this takes them to.
    """
    if len(sample) < 2 or not len(sample[0].positions):
        return None
    steps = _steps(resolution, sample[0])
    size = float(np.abs(steps).max())
    if size == 0:
        # one atom at the origin: nothing says how it is rounded
        return None
    moves, lag = _moves(sample, size)
    everyone = np.arange(len(moves))
    one, other = moves[everyone if first is None else first], None
    other = one if second is None and first is not None else moves[everyone if second is None else second]
    if not one.any() and not other.any():
        return None
    random = np.random.default_rng(seed)
    before, after = (_triples if ranked else _pairs)(random, one, other, radius, steps, draws)

    def decided(places: Places) -> np.ndarray:
        return _closer(places) if ranked else _inside(places, radius)

    was, now = decided(before), decided(after)
    seen_was, seen_now = decided(_rounded(before, steps)), decided(_rounded(after, steps))
    happened, seen = was != now, seen_was != seen_now
    both = int((happened & seen & (now == seen_now)).sum())
    if not happened.any():
        return None
    return GridEffect(
        missed=1.0 - both / int(happened.sum()),
        invented=1.0 - both / int(seen.sum()) if seen.any() else 0.0,
        ratio=int(seen.sum()) / int(happened.sum()),
        move=float(np.sqrt((moves**2).mean())),
        lag=lag,
        frames=len(sample),
    )


def _pairs(
    random: np.random.Generator,
    one: Float[np.ndarray, "first 3"],
    other: Float[np.ndarray, "second 3"],
    radius: float,
    steps: Float[np.ndarray, "3 3"],
    draws: int,
) -> tuple[Places, Places]:
    """Pairs near the radius before and after they move.

    Args:
        one, other: displacements of atoms on either side.
    """
    a, b = one[random.integers(len(one), size=draws)], other[random.integers(len(other), size=draws)]
    spread = float(np.sqrt((one**2).mean() + (other**2).mean()))
    width = min(_WIDE * spread + 4 * float(np.abs(steps).max()), radius)
    distance = radius + width * random.uniform(-1.0, 1.0, draws)
    # anywhere on the grid
    start = random.uniform(0.0, 1.0, (draws, 3)) @ steps
    end = start + distance[:, None] * _directions(random, draws)
    return (start, end), (start + a, end + b)


def _triples(
    random: np.random.Generator,
    one: Float[np.ndarray, "first 3"],
    other: Float[np.ndarray, "second 3"],
    radius: float,
    steps: Float[np.ndarray, "3 3"],
    draws: int,
) -> tuple[Places, Places]:
    """An atom and two others at about the same distance from it, in any directions, before and after."""
    a = one[random.integers(len(one), size=draws)]
    b, c = (other[random.integers(len(other), size=draws)] for _ in range(2))
    # the distance of the middle one counts twice where the others are on opposite sides
    spread = float(np.sqrt(2 * (one**2).mean() + 2 * (other**2).mean()))
    width = min(_WIDE * spread + 6 * float(np.abs(steps).max()), radius)
    more = width * random.uniform(-0.5, 0.5, draws)
    start = random.uniform(0.0, 1.0, (draws, 3)) @ steps
    near = start + (radius - more)[:, None] * _directions(random, draws)
    far = start + (radius + more)[:, None] * _directions(random, draws)
    return (start, near, far), (start + a, near + b, far + c)


def _directions(random: np.random.Generator, draws: int) -> Float[np.ndarray, "draws 3"]:
    found = random.normal(size=(draws, 3))
    return found / np.linalg.norm(found, axis=1)[:, None]


def _steps(resolution: Resolution, frame: Frame) -> Float[np.ndarray, "3 3"]:
    """Vectors of the grid that positions lie on, as rows, length."""
    if resolution.kind == "fractions" and not resolution.digits:
        return resolution.step * frame.box.matrix
    return resolution.usual_step(frame) * np.eye(3)


def _moves(sample: Sequence[Frame], size: float) -> tuple[Float[np.ndarray, "atoms 3"], int]:
    """Displacements of every atom in one frame, without what rounding did to them, and the lag they are from.

    Over so many frames that a displacement is well above a step of the grid; what rounding adds to their
    variance is taken off again.
    """
    moves, lag, total = np.zeros_like(sample[0].positions), 0, np.zeros_like(sample[0].positions)
    for before, after in pairwise(sample):
        total = total + _shortest(after.positions - before.positions, after.box)
        lag += 1
        moves = total - total.mean(axis=0)
        if np.sqrt((moves**2).mean()) >= _CLEAR * size:
            break
    variance = float((moves**2).mean())
    true = _unrounded(variance, size)
    if true < _MOSTLY * variance:
        # most atoms seem to stand still and some to hop: what they do in truth has lost its shape
        moves = np.random.default_rng(0).normal(scale=np.sqrt(true), size=moves.shape)
        return moves / max(lag, 1), lag
    keep = np.sqrt(true / variance) if variance else 0.0
    return moves * (keep / max(lag, 1)), lag


def _unrounded(variance: float, size: float) -> float:
    """Variance of displacements whose ends, rounded to multiples of size, differ with this variance.

    A displacement of f steps beyond a whole number of them gains size² f (1 - f) on average over where it
    begins. Over displacements with variance v from a normal distribution that is (by its Fourier series)
    size² (1/6 - sum over k of exp(-2 π² k² v / size²) / (π k)²).
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


def _shortest(d: Float[np.ndarray, "atoms 3"], box: Box) -> Float[np.ndarray, "atoms 3"]:
    """Displacements without whole periods: atoms that were wrapped have not moved far."""
    matrix = np.where(box.pbc[:, None], box.matrix, np.eye(3))
    if not np.isfinite(matrix).all() or np.linalg.det(matrix) == 0:
        return d
    parts = np.linalg.solve(matrix.T, d.T).T
    return d - np.where(box.pbc, np.round(parts), 0.0) @ matrix


def _rounded(places: Places, steps: Float[np.ndarray, "3 3"]) -> Places:
    size = np.diag(steps)
    if np.count_nonzero(steps) == 3 and size.all():
        return tuple(np.rint(x / size) * size for x in places)
    inverse = np.linalg.inv(steps)
    return tuple(np.rint(x @ inverse) @ steps for x in places)


def _inside(places: Places, radius: float) -> np.ndarray:
    one, other = places
    return ((other - one) ** 2).sum(axis=1) < radius**2


def _closer(places: Places) -> np.ndarray:
    """Whether the second one is closer to the first than the third is."""
    middle, one, other = places
    return ((one - middle) ** 2).sum(axis=1) < ((other - middle) ** 2).sum(axis=1)
