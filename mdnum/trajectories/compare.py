"""Two trajectories of the same atoms: how far apart, and which pairs are inside in one of them only.

The sets are compared once, at the first frame; from there the flips of either say what becomes of the
difference, so that a frame costs what changed in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.lattice import lattice_of
from mdnum.trajectories.ledger import Flips, Members
from mdnum.trajectories.search import image_distances

Pair = tuple[int, int, int]


@dataclass(frozen=True)
class Apart:
    """How far two frames are apart, atom by atom.

    Attributes:
        furthest: largest displacement, length.
        typical: root mean square displacement, length.
        atom: the one that is displaced furthest.
        periods: most lattice vectors of one kind between an atom and its nearest image; 0 where none was
            wrapped in one of the frames only.
    """

    furthest: float
    typical: float
    atom: int
    periods: int = 0


def displacements(start: Frame, end: Frame) -> Float[np.ndarray, "atoms 3"]:
    """From one frame to another, up to lattice vectors of the second's box.

    The nearest image is found along reduced lattice vectors: for an atom that moved by less than half the
    width of the box it is the nearest of all. Where the frames repeat along different axes, only those along
    which both do have images.
    """
    return _displaced(start, end)[0]


def _displaced(start: Frame, end: Frame) -> tuple[Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]]:
    """(displacements, whole lattice vectors taken off)."""
    moved = end.positions - start.positions
    shared = Box(end.box.matrix, np.asarray(start.box.pbc, bool) & np.asarray(end.box.pbc, bool))
    if not shared.periodic:
        return moved, np.zeros_like(moved)
    lattice = lattice_of(shared)
    whole = np.where(lattice.periodic, np.rint(moved @ lattice.inverse), 0.0)
    return moved - whole @ lattice.vectors, whole


def same_lattice(one: Box, other: Box, tolerance: float) -> bool:
    """Whether two boxes tile space in the same way, whichever lattice vectors they name.

    Args:
        tolerance: how far a component of a lattice vector may be off, length.
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


def apart(one: Frame, other: Frame, atoms: Int[np.ndarray, "chosen"] | None = None) -> Apart:
    """How far two frames are apart.

    Args:
        atoms: only these; None for all.
    """
    moved, whole = _displaced(one, other)
    if atoms is not None:
        moved, whole = moved[atoms], whole[atoms]
    square = np.sum(moved**2, axis=1)
    at = int(np.argmax(square))
    return Apart(
        float(np.sqrt(square[at])),
        float(np.sqrt(square.mean())),
        at if atoms is None else int(atoms[at]),
        int(np.abs(whole).max()),
    )


@dataclass
class Difference:
    """Pairs that are inside in one trajectory only, carried along by the flips of both.

    Attributes:
        only_a, only_b: the pairs, as (i, j, rank).
        new: those that came to differ at the last frame.
    """

    only_a: set[Pair] = field(default_factory=set)
    only_b: set[Pair] = field(default_factory=set)
    new: list[Pair] = field(default_factory=list)

    @classmethod
    def of(cls, a: Members, b: Members) -> Difference:
        """At the first frame."""
        first, second = (_pairs(one.i, one.j, one.rank) for one in (a, b))
        both = first & second
        found = cls(first - both, second - both)
        found.new = sorted(found.only_a | found.only_b)
        return found

    def __len__(self) -> int:
        return len(self.only_a) + len(self.only_b)

    def step(self, a: Flips, b: Flips) -> None:
        """After the flips of the next frame in either."""
        differed: dict[Pair, bool] = {}
        for flips, mine, others in ((a, self.only_a, self.only_b), (b, self.only_b, self.only_a)):
            columns = (flips.i.tolist(), flips.j.tolist(), flips.rank.tolist(), flips.entered.tolist())
            for *ids, entered in zip(*columns, strict=True):
                pair: Pair = (ids[0], ids[1], ids[2])
                differed.setdefault(pair, pair in mine or pair in others)
                # entering ends a difference where the other has the pair inside, and begins one if not
                here, there = (mine, others) if entered else (others, mine)
                if pair in there:
                    there.remove(pair)
                else:
                    here.add(pair)
        now = (pair for pair, was in differed.items() if not was)
        self.new = sorted(pair for pair in now if pair in self.only_a or pair in self.only_b)


def _pairs(i: np.ndarray, j: np.ndarray, rank: np.ndarray) -> set[Pair]:
    return set(zip(i.tolist(), j.tolist(), rank.tolist(), strict=True))


def distances(frame: Frame, pairs: list[Pair], directed: bool = False) -> Float[np.ndarray, "pairs"]:
    """Distances of pairs in a frame, through the image that each names; inf where there is none, length."""
    if not pairs:
        return np.zeros(0)
    i, j, rank = np.array(pairs, np.int64).T
    # of a directed rule both of a ± pair of images of an atom itself are neighbors
    rank = np.where(i == j, rank // 2, rank) if directed else rank
    low, high = np.minimum(i, j), np.maximum(i, j)
    return image_distances(np.ascontiguousarray(frame.positions), lattice_of(frame.box), low, high, rank)


def growth(
    time: Float[np.ndarray, "frames"], separation: Float[np.ndarray, "frames"], limit: float
) -> tuple[float, float, int] | None:
    """Rate at which a separation grows, from a straight line through its logarithm.

    Args:
        time: of each frame.
        separation: above zero where it counts.
        limit: length above which it is no small difference any more, and is left out.

    Returns:
        (rate per time, r² of the line, frames used); None with fewer than five.
    """
    use = (separation > 0) & (separation < limit) & np.isfinite(separation)
    if np.count_nonzero(use) < 5 or np.ptp(time[use]) == 0:
        return None
    x, y = time[use], np.log(separation[use])
    slope, offset = np.polyfit(x, y, 1)
    spread = float(np.sum((y - y.mean()) ** 2))
    left = float(np.sum((y - slope * x - offset) ** 2))
    return float(slope), 1.0 - left / spread if spread > 0 else 1.0, int(np.count_nonzero(use))
