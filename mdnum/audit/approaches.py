"""Two atoms that come into one another's reach in the ways that a neighbor list can miss."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from ase import Atoms

from mdnum.audit.probes import Pair

#: Å beyond the cutoff at which two atoms start. A list with a skin s that lets each of them move by all of s
#: misses the pair where this lies between s and 2 s: with steps below a factor 2 no skin slips through.
_BEYOND = tuple(0.15 * 1.5**n for n in range(8))
_STEPS = 8
#: Å inside the cutoff at which they are looked at.
_INSIDE = (0.02, 0.1, 0.25)


@dataclass(frozen=True)
class Asked:
    """A structure in a sequence that one calculator object is asked about.

    Attributes:
        what: how it differs from the one before, in words.
        atoms: the structure.
        compared: whether the answer is held against that of a new object.
    """

    what: str
    atoms: Atoms
    compared: bool = True


def approaches(pair: Pair, radius: float) -> Iterator[tuple[str, list[Asked]]]:
    """Sequences by name, each for an object of its own.

    Args:
        pair: two particles that the calculator answers for.
        radius: beyond which they do not feel one another, Å.
    """
    for beyond in _BEYOND:
        yield f"two atoms from {beyond:.2g} Å beyond the cutoff", list(_head_on(pair, radius, beyond))
    if len(pair.first) == len(pair.second) == 1:
        yield "a cell that shrinks around two atoms", list(_shrinking(pair, radius))
        yield "one atom that jumps", list(_jumping(pair, radius))


def _head_on(pair: Pair, radius: float, beyond: float) -> Iterator[Asked]:
    """Both move, in small steps: neither further than half of what the distance changes by."""
    start = pair.at(radius + beyond)
    count = len(pair.first)
    yield Asked("the two apart", start, compared=False)
    for moved in (*np.linspace(0, beyond, _STEPS + 1)[1:], *(beyond + inside for inside in _INSIDE)):
        there = start.copy()
        there.positions[:count, 0] += 0.5 * moved
        there.positions[count:, 0] -= 0.5 * moved
        inside = moved > beyond
        yield Asked(f"each moved by {0.5 * moved:.3g} Å toward the other", there, compared=bool(inside))


def _shrinking(pair: Pair, radius: float) -> Iterator[Asked]:
    """Atoms stand still while the cell brings an image of one into the other's reach."""
    length = 3.0 * radius
    for step, moved in enumerate((0.0, 0.03, 0.06, 0.09, 0.12, 0.16)):
        # across the face they are 0.05 Å beyond the cutoff at first
        there = pair.at(length - radius - 0.05)
        there.set_cell([length - moved] * 3)
        there.pbc = True
        what = f"the cell shrank by {moved:.2g} Å" if step else "the two apart"
        yield Asked(what, there, compared=moved > 0.05)


def _jumping(pair: Pair, radius: float) -> Iterator[Asked]:
    """From far away into reach in a single call."""
    yield Asked("the two apart", pair.at(3.0 * radius), compared=False)
    yield Asked("one atom jumped next to the other", pair.at(0.95 * radius))
