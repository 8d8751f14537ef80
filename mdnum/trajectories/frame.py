"""One frame of a trajectory in float64, and checks for impossible values.

Formats with plain floats (dcd, trr, netcdf) accept any bytes as coordinates. File damage often produces a
huge coordinate. A huge coordinate increases the rounding bound of every pair.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.reading import EarlierFramesError, FrameError
from mdnum.reading import UnreadableFrame as UnreadableFrame
from mdnum.trajectories.collective import Collective

# Sizes of the system from its middle at which nothing is any more: unwrapped coordinates of a liquid get
# some thousand boxes far in a second; what flies off into empty space gets further.
_FAR_BOXES, _FAR_SIZES = 1e5, 1e6
# The same for the way between two frames.
_LEAP_BOXES, _LEAP_SIZES = 100.0, 1e4
# At least as many atoms, or all, stand for all of them in what they have in common.
_SOME = 500
_UNIT = {32: 2.0**-24, 64: 2.0**-53}

#: Indices of selected atoms of a file; None for all.
AtomIndices = Int[np.ndarray, "chosen"] | None


@dataclass(frozen=True)
class Box:
    """Lattice vectors of a box, and its periodic directions."""

    # rows, length; those of directions that do not repeat do not matter
    matrix: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))
    pbc: Bool[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3, bool))
    # the corner from which the file gives fractions of the vectors, length
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    step: float = 0.0  # what the last digit of a box that is written as text is worth, length; 0 if unknown

    @property
    def periodic(self) -> bool:
        """True if the box is periodic along at least one direction."""
        return bool(self.pbc.any())

    @cached_property
    def longest(self) -> float:
        """Length of the longest lattice vector. 0 if the box is not finite or not fully periodic."""
        if not np.all(self.pbc) or not np.isfinite(self.matrix).all():
            return 0.0
        return float(np.linalg.norm(self.matrix, axis=1).max())

    @cached_property
    def shortest(self) -> float:
        """Length of the shortest periodic lattice vector. 0 if there is none."""
        return float(np.linalg.norm(self.matrix[self.pbc], axis=1).min()) if self.periodic else 0.0

    @cached_property
    def broken(self) -> Int[np.ndarray, "axes"]:
        """Indices of the periodic axes whose lattice vector is zero or not finite."""
        vectors = self.matrix.any(axis=1) & np.isfinite(self.matrix).all(axis=1)
        return np.flatnonzero(self.pbc & ~vectors)

    def plain(self) -> dict[str, Any]:
        """Return lattice vectors and periodicity as plain Python values."""
        return {"matrix": np.asarray(self.matrix, float).tolist(), "pbc": np.asarray(self.pbc, bool).tolist()}


@dataclass(frozen=True)
class Frame:
    """Positions of all atoms at one time, with the box."""

    index: int  # number of the frame in its file, from 0
    time: float  # in the file's unit; the index where the file has no times
    positions: Float[np.ndarray, "atoms 3"]  # of all atoms of the file, length
    box: Box
    velocities: Float[np.ndarray, "atoms 3"] | None = None  # length per time, where the file has them
    labels: np.ndarray | None = None  # names, elements or types, where the file has them in every frame
    identified: bool = False  # whether ids in the file say which atom is which, so that a label may change

    @cached_property
    def furthest(self) -> float:
        """Largest absolute coordinate of all atoms (a length). It may be infinite or NaN."""
        return furthest(self.positions)

    def furthest_of(self, atoms: AtomIndices) -> float:
        """Return the largest absolute coordinate of the given atoms, in length units."""
        return self.furthest if atoms is None else furthest(self.positions[atoms])


@dataclass
class FrameCheck:
    """Check that rejects impossible frames, and frames inconsistent with the first.

    Raises:
        FrameError: a coordinate is not finite; an atom is impossibly far away, or so far away that floats do
            not resolve distances of length `radius`; several atoms are at exactly 0, 0, 0; the common motion
            of all atoms is impossible; the periodic axes differ from the first frame (most often, the box is
            missing), or one has no lattice vector; or the label of an atom differs from the first frame, and
            the file has no ids or a rule needs species.
    """

    atoms: AtomIndices = None  # those that matter, ascending; None for all
    where: str | None = None  # the file, for messages
    radius: float = np.inf  # the shortest length that distances are compared with
    bits: int = 64  # width of a coordinate as it was read
    pbc: Bool[np.ndarray, "3"] | None = None  # of the first frame, once there was one
    labels: np.ndarray | None = None
    species: bool = True  # whether a rule asks for them
    retyped: tuple[int, int] | None = None  # (frame, atom) of the first label that changed and may
    collective: Collective = field(default_factory=Collective)

    def __call__(self, frame: Frame) -> Frame:
        for what, remedy in self._wrong(frame):
            raise FrameError(f"frame {frame.index}{what}", frame=frame.index, remedy=remedy, where=self.where)
        return frame

    def _wrong(self, frame: Frame) -> Iterator[tuple[str, str]]:
        """Yield (problem, remedy) for each failed check of a frame."""
        atoms = self.atoms
        self.pbc = pbc = frame.box.pbc if self.pbc is None else self.pbc
        self.labels = labels = frame.labels if self.labels is None else self.labels
        failed = (
            f"there; stop before that frame (@:{frame.index})" if frame.index else "from the first frame on"
        )
        failed = f"The simulation or the writing of it failed {failed}"

        def place(atom: int) -> str:
            return f"atom {atom} is at ({', '.join(f'{value:g}' for value in frame.positions[atom])})"

        if labels is not None and frame.labels is not None:
            others = np.flatnonzero(labels != frame.labels)
            others = others if atoms is None else np.intersect1d(others, atoms)
            if others.size and (self.species or not frame.identified):
                atom = int(others[0])
                remedy = "Write all frames in one order of atoms, or leave out those that differ with"
                remedy += " @START:STOP: pairs are followed by the place of their atoms in the file"
                if frame.identified:
                    remedy = "Use --cutoff or --nearest, which need no species, or leave out others"
                    remedy += " with @START:STOP: by its id it is the same atom, of another type there"
                what = f": atom {atom} is {frame.labels[atom]}, and {labels[atom]} in the first one looked at"
                yield f"{what}{_and_others(others.size)}", remedy
            if others.size:
                self.retyped = self.retyped or (frame.index, int(others[0]))
        if (frame.box.pbc != pbc).any():
            what = f" {_repeats(frame.box.pbc)}, and the first one looked at {_repeats(pbc)}"
            remedy = "Leave out the frames that differ with @START:STOP: distances in the two do not compare"
            yield what, remedy
        x = frame.positions if atoms is None else frame.positions[atoms]
        for axis in frame.box.broken:
            vector = frame.box.matrix[axis].tolist()
            what = f": the box repeats along {'abc'[axis]}, but its vector there is {vector}"
            yield what, "Give the frames a box, or make this direction non-periodic"
        if not np.isfinite(frame.furthest_of(atoms)):
            bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
            yield f": {place(_named(bad[0], atoms))}{_and_others(bad.size)}", failed
        if (found := far_out(frame, atoms, self.radius, self.bits, self.collective.last)) is not None:
            what = f": {place(found[0])}, {found[2]}{_and_others(found[1])}"
            yield what, f"{failed}; an atom that did fly off is left out with --between"
        # one atom may well be at the origin; two cannot be at one place
        zero = np.flatnonzero(x[:, 0] == 0)
        zero = zero[~x[zero].any(axis=1)]
        if zero.size > 1:
            some = f"atom {_named(zero[0], atoms)} is at exactly 0, 0, 0{_and_others(zero.size)}"
            some = "all coordinates are 0" if zero.size == len(x) else some
            what = f": {some}, as where coordinates were never written"
            yield what, "Leave the frame out with @START:STOP, or the atoms with --between"
        some, far = x[:: max(1, len(x) // _SOME)], _LEAP_BOXES * frame.box.longest
        if lay := self.collective.left(some, len(x)):
            what = f" is the first in which not all atoms have {lay}: the frames before it cannot be right"
            remedy = f"Leave out the earlier frames: begin with this frame (@{frame.index}:)"
            message = f"frame {frame.index}{what}"
            raise EarlierFramesError(message, frame=frame.index, remedy=remedy, where=self.where)
        if (why := self.collective.refuse(some, len(x), frame.box.shortest, far)) is not None:
            yield f": {why}", failed


def _repeats(pbc: np.ndarray) -> str:
    if pbc.any() and not pbc.all():
        axes = ", ".join(name for name, yes in zip("abc", pbc, strict=True) if yes)
        return f"has a box that repeats along {axes}"
    return "has a box" if pbc.any() else "has no box"


def _and_others(count: int) -> str:
    return "" if count == 1 else f", and {count - 1:,} other{'s' if count > 2 else ''} likewise"


# ---- further out, or further from one frame to the next, than any simulation takes an atom


def far_out(
    frame: Frame,
    atoms: AtomIndices = None,
    radius: float = np.inf,
    bits: int = 64,
    before: Float[np.ndarray, "some 3"] | None = None,
) -> tuple[int, int, str] | None:
    """Return the atom that is impossibly far from the others (arguments as in `FrameCheck`).

    The previous frame also gives the system size, since the current frame may be damaged.

    Returns:
        (the atom, the number of impossibly distant atoms, the reason in words), or None.
    """
    x = frame.positions if atoms is None else frame.positions[atoms]
    if len(x) < 2:
        return None
    # how far a distance is off between coordinates of size 1, twice over
    unit = 2 * 4 * float(np.sqrt(3)) * _UNIT[bits]
    top, box = frame.furthest_of(atoms), frame.box.longest
    if ((box and top <= _FAR_BOXES * box / 2) or not top) and unit * top <= radius:
        return None
    away = np.abs(x - np.median(x, axis=0)).max(axis=1)
    size = max(box, float(np.median(away)))
    if before is not None and len(before) > 1:
        there = np.median(before, axis=0)
        usual = max(box, float(np.median(np.abs(before - there).max(axis=1))))
        if usual and away.max() > (_FAR_BOXES if box else _FAR_SIZES) * usual:
            size, away = usual, np.abs(x - there).max(axis=1)
    limit = (_FAR_BOXES if box else _FAR_SIZES) * size
    if size and away.max() > limit:
        at, what = np.argmax(away), "the box" if box >= size else "all the rest"
        why = f"{float(away[at]) / size:.2g} times the size of {what} away from the others"
        return _named(at, atoms), int(np.count_nonzero(away > limit)), why
    if unit * top > radius:
        largest = np.abs(x).max(axis=1)
        why = f"so far out that float{bits} resolves distances only to {unit * top:.2g}"
        return _named(np.argmax(largest), atoms), int(np.count_nonzero(unit * largest > radius)), why
    return None


def leap(before: Frame, now: Frame, atoms: AtomIndices = None) -> tuple[int, float] | None:
    """Return the atom that moved farthest if its displacement is impossibly large.

    A jump by a lattice vector does not count as a displacement.

    Returns:
        (the atom, the length of its displacement); None if no displacement is impossible.
    """
    x = now.positions if atoms is None else now.positions[atoms]
    moved = x - (before.positions if atoms is None else before.positions[atoms])
    box = now.box.longest
    if len(moved) < 2 or (box and furthest(moved) <= _LEAP_BOXES * box / 2):
        return None
    # all of them may be shifted together
    distance = np.abs(moved - np.median(moved, axis=0)).max(axis=1)
    size = max(box, float(np.median(np.abs(x - np.median(x, axis=0)).max(axis=1))))
    at = np.argmax(distance)
    if not size or distance[at] <= (_LEAP_BOXES if box else _LEAP_SIZES) * size:
        return None
    return _named(at, atoms), float(distance[at])


def furthest(x: Float[np.ndarray, "atoms 3"]) -> float:
    """Return the largest absolute value of an array; 0 for an empty array."""
    # twice as fast as through their absolute values, and six times as by atom
    return float(max(x.max(initial=0.0), -x.min(initial=0.0)))


def _named(at: Any, atoms: AtomIndices) -> int:
    """Convert the index of a selected atom to its number in the file."""
    return int(at if atoms is None else atoms[at])
