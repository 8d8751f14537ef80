"""How finely a file tells where atoms are, found from its numbers, and what that leaves undecided.

A file that keeps three decimals has moved every coordinate by up to half a unit of the third: whether a pair
is inside a cutoff cannot be told when its distance is closer to it than what that does to a distance. `infer`
looks for the decimal grid that all coordinates lie on, so that a precision nobody wrote down is found too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.frame import Frame

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


@dataclass(frozen=True)
class Resolution:
    """The resolution of the positions in a file.

    Attributes:
        kind: "grid" (decimals of a length), "fractions" (decimals of the box's vectors), "float32",
            "float64", or "unknown" where every coordinate looked at is 0 (bounds are then those of float32).
        step: of the grid: length for "grid", a pure number for "fractions"; 0 for floats. Where digits are
            counted, that of the largest coordinate it was found from.
        digits: significant digits of every number, where it is these that are fixed; else 0.
        bits: width of a coordinate as the reader hands it over, 32 or 64.
        frames: frames it was found from.
        moved: whether atoms moved between them. Where none did, the grid may be the structure's and not the
            file's.
        box: step of the box's lengths, length, and of its angles, degrees, where the format rounds them.
        told: whether the coordinates determine it. Where they are all 0, a grid is that which the format has
            as a rule.
    """

    kind: str
    step: float
    bits: int
    frames: int
    moved: bool = True
    box: tuple[float, float] = (0.0, 0.0)
    digits: int = 0
    told: bool = True

    def bound(self, frame: Frame, atoms: Int[np.ndarray, "chosen"] | None = None) -> float:
        """How far a distance in this frame can be from that of the positions before they were written.

        The worst case, length: both atoms moved by half a step along every axis, in opposite directions, and
        a pair across the boundary by what rounding did to the box. For float64 it is the distance's rounding.

        Args:
            frame: of the file.
            atoms: those whose distances are meant; None for all.

        A margin to a cutoff is off by as much, one among the nearest neighbors (the difference of two
        distances) by twice that.

        Error: for a pair through one period of the box; further images add as much of the box's part again.
        """
        frame = _of(frame, atoms)
        largest, lattice = _extent(frame)
        coordinate, box = self._half(frame), 0.0
        if self._narrow:
            # the box comes through the same reader
            coordinate += _ROUNDINGS * _UNIT[32] * largest
            box = _ROUNDINGS * _UNIT[32] * lattice
        if frame.box.periodic:
            box += np.sqrt(3) / 2 * self.box[0]
            # right angles are meant to be right
            if np.count_nonzero(frame.box.matrix[frame.box.pbc]) > frame.box.pbc.sum():
                box += np.sqrt(3) / 2 * np.radians(self.box[1]) * lattice
        arithmetic = 16 * _UNIT[64] * (largest + lattice)
        return float(2 * np.sqrt(3) * coordinate + box + arithmetic)

    def usual_step(self, frame: Frame) -> float:
        """Root mean square of what the last digit of a coordinate is worth, length."""
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
        """Half a step along an axis at worst, length."""
        if not self.step or not len(frame.positions):
            return 0.0
        if self.kind == "fractions":
            largest = np.abs(_fractions_of(frame)).max(axis=0) if self.digits else np.ones(3)
            steps = steps_of(largest, self.step, self.digits)
            return float((steps[:, None] * np.abs(frame.box.matrix)).sum(axis=0).max()) / 2
        largest = np.abs(frame.positions).max(keepdims=True)
        return float(steps_of(largest, self.step, self.digits).max()) / 2


def infer(sample: Sequence[Frame], bits: int = 64, format: str = "") -> Resolution:
    """The resolution of frames.

    Args:
        sample: frames of one file, at least one.
        bits: width of a coordinate as the reader hands it over.
        format: in the reader's word, for what formats are known to round.
    """
    moved = _moved(sample)
    values, fractions = _values(sample, moved), _fractions(sample, moved)
    box = _BOX_STEPS.get(format, (0.0, 0.0))
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


def _moved(sample: Sequence[Frame]) -> np.ndarray:
    """Which atoms are not at one place in all frames, shape (atoms,)."""
    first = sample[0].positions
    moved = np.zeros(len(first), bool)
    for frame in sample[1:]:
        moved |= (frame.positions != first).any(axis=1)
    return moved


def _values(sample: Sequence[Frame], moved: np.ndarray) -> Float[np.ndarray, "values"]:
    """Coordinates to look at: of atoms that move, the frames after the first first.

    A run that starts from a crystal has its first frame on the crystal's sites.
    """
    frames = sample[1:] if moved.any() and len(sample) > 1 else sample
    rows = moved if moved.any() else np.ones(len(moved), bool)
    values = np.concatenate([frame.positions[rows].ravel() for frame in frames])
    return _thinned(values)


def _fractions(sample: Sequence[Frame], moved: np.ndarray) -> Float[np.ndarray, "values"] | None:
    """As `_values`, in fractions of the box; None without a box of three vectors."""
    frames = sample[1:] if moved.any() and len(sample) > 1 else sample
    rows = moved if moved.any() else np.ones(len(moved), bool)
    if any(
        not np.isfinite(frame.box.matrix).all() or np.linalg.det(frame.box.matrix) == 0 for frame in frames
    ):
        return None
    return _thinned(np.concatenate([_fractions_of(frame)[rows].ravel() for frame in frames]))


def _fractions_of(frame: Frame) -> Float[np.ndarray, "atoms 3"]:
    """Positions in fractions of the box."""
    return np.linalg.solve(frame.box.matrix.T, frame.positions.T).T


def _thinned(values: Float[np.ndarray, "values"]) -> Float[np.ndarray, "fewer"]:
    values = values[np.isfinite(values)]
    return values[:: max(len(values) // _ENOUGH, 1)]


def _of(frame: Frame, atoms: Int[np.ndarray, "chosen"] | None) -> Frame:
    """The frame of these atoms, without those that are nowhere: they have no distances."""
    x = frame.positions if atoms is None else frame.positions[atoms]
    with np.errstate(over="ignore", invalid="ignore"):
        total = x.sum()
    if not np.isfinite(total):
        x = x[np.isfinite(x).all(axis=1)]
    return frame if x is frame.positions else replace(frame, positions=x, velocities=None)


def _extent(frame: Frame) -> tuple[float, float]:
    """Largest coordinate, and largest sum of the lattice's components along an axis, length."""
    largest = float(np.abs(frame.positions).max()) if len(frame.positions) else 0.0
    rows = frame.box.matrix[frame.box.pbc]
    return largest, float(np.abs(rows).sum(axis=0).max()) if len(rows) else 0.0


# ---- which decimals numbers were written with


def decimal_grid(
    values: Float[np.ndarray, "values"], slack: Float[np.ndarray, "values"]
) -> tuple[float, int]:
    """The decimals that all values keep to.

    Args:
        values: as read.
        slack: how far each may be off through the arithmetic behind it.

    Returns:
        the coarsest decimal step that all are multiples of, and 0; or the step of the largest and the number
        of significant digits that all have; or 0.0 and 0 where they are no decimals.
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
    """What the last digit of each value is worth: the step, or by the value's size where digits count."""
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
    """Logarithm of the probability that values at random all fall into these parts of a step."""
    return float(np.log(np.maximum(parts, 1e-300)).sum())


def _multiples(
    values: Float[np.ndarray, "values"],
    steps: Float[np.ndarray, "values"],
    slack: Float[np.ndarray, "values"],
) -> bool:
    ratio = values / steps
    return bool((np.abs(ratio - np.round(ratio)) * steps <= slack).all())
