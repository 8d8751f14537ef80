"""Mistakes that belong to a place in the list of atoms: the first, the last, every eighth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import CalculatorError
from mdnum.audit.noise import NoiseFloor, in_order
from mdnum.audit.subject import CalculatorSubject, differences

#: Places of a list that are tried, and other places that an ordinary one is looked for in.
_PLACES, _CANDIDATES = 48, 4


@dataclass(frozen=True)
class WrongPlaces:
    """Places in the list of atoms at which an answer is another one, whichever atom is there."""

    places: tuple[int, ...]
    count: int  # of atoms
    energy: float  # the largest change of the energy when an atom comes to such a place, eV
    force: float  # of a force component, eV/Å

    @property
    def pattern(self) -> str:
        """One of "first", "last", "every" (so many) and "some"."""
        if len(self.places) == 1:
            return {0: "first", self.count - 1: "last"}.get(self.places[0], "some")
        return "every" if len(set(np.diff(self.places).tolist())) == 1 else "some"

    @property
    def values(self) -> dict[str, Any]:
        """Of a finding."""
        shown = ", ".join(map(str, self.places[:8])) + (", …" if len(self.places) > 8 else "")
        every = int(np.diff(self.places)[0]) if self.pattern == "every" else 0
        return {"places": shown, "every": every, "wrong_places": len(self.places), "count": self.count}


def wrong_places(subject: CalculatorSubject, atoms: Atoms, allowed: NoiseFloor) -> WrongPlaces | None:
    """Find places by exchanging an atom with another of its species in an ordinary place, two at a time.

    In an ordinary pair of places nothing changes. A mistake that belongs to a place shows at that place in
    any order of the atoms; what depends on all of the order, such as neighbors that are dropped, shows
    nearly everywhere or elsewhere in another order.

    Args:
        allowed: what an answer may differ by.

    Returns:
        None where no place stands out, or nearly all do.
    """
    key = "places", atoms.positions.tobytes(), atoms.numbers.tobytes()
    if key not in subject.known:
        with subject.trying():
            try:
                subject.known[key] = _wrong_places(subject, atoms, allowed)
            except CalculatorError:
                subject.known[key] = None
    return subject.known[key]


def _wrong_places(subject: CalculatorSubject, atoms: Atoms, allowed: NoiseFloor) -> WrongPlaces | None:
    rng, count = np.random.default_rng(0), len(atoms)
    ends = [*range(min(count, 17)), *range(max(count - 8, 0), count)]
    places = list(dict.fromkeys([*ends, *rng.permutation(count)[: _PLACES - len(ends)].tolist()]))
    found: list[dict[int, tuple[float, float]]] = []
    for order in (np.arange(count), rng.permutation(count)):
        there = atoms[order]
        assert isinstance(there, Atoms)
        changes = _at_places(subject, there, places, allowed)
        if changes is None:
            return None
        found.append(changes)
    wrong = [{place for place, change in one.items() if _matters(change, allowed)} for one in found]
    # where both orders tried a place, they must agree on it
    tried = found[0].keys() & found[1].keys()
    if wrong[0] & tried != wrong[1] & tried or not wrong[0] & tried:
        return None
    right = sorted(wrong[0] & tried)
    energy, force = np.max([one[place] for one in found for place in right], axis=0)
    return WrongPlaces(tuple(right), count, energy if energy > allowed.energy else 0.0, force)


def _matters(change: tuple[float, float], allowed: NoiseFloor) -> bool:
    return change[0] > allowed.energy or change[1] > allowed.force


def _at_places(
    subject: CalculatorSubject, atoms: Atoms, places: Sequence[int], allowed: NoiseFloor
) -> dict[int, tuple[float, float]] | None:
    """What changes when the atom in a place is exchanged with one in an ordinary place of its species."""
    base, found = subject.fresh().both(atoms), {}

    def exchanged(one: int, other: int) -> tuple[float, float]:
        order = np.arange(len(atoms))
        order[[one, other]] = other, one
        return differences(base, in_order(subject.fresh(), atoms, order))

    for number in set(atoms.numbers.tolist()):
        same = [place for place in places if atoms.numbers[place] == number]
        if len(same) < 3:
            continue
        for ordinary in same[:: max(len(same) // _CANDIDATES, 1)][::-1]:
            others = [place for place in same if place != ordinary]
            few = others[:: max(len(others) // 4, 1)]
            # between ordinary places an exchange changes nothing, and most places are ordinary
            if 2 * sum(_matters(exchanged(place, ordinary), allowed) for place in few) <= len(few):
                changes = {place: exchanged(place, ordinary) for place in others}
                if 2 * sum(_matters(change, allowed) for change in changes.values()) <= len(others):
                    found |= {ordinary: (0.0, 0.0), **changes}
                    break
        else:
            return None
    return found
