"""Detect errors at certain places in the list of atoms, such as the last atom."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import CalculatorError
from mdnum.audit.noise import NoiseFloor, in_order
from mdnum.audit.subject import CalculatorSubject, differences

_PLACES, _CANDIDATES = 48, 4  # places that are tried, and of them for an ordinary one


@dataclass(frozen=True)
class WrongPlaces:
    """Places in the list of atoms at which energy or forces are wrong for any atom."""

    places: tuple[int, ...]
    count: int  # of atoms
    energy: bool  # whether the energy is another one there, or forces alone

    @property
    def pattern(self) -> str:
        """Pattern of the wrong places: "first", "last", "every" (every nth atom) or "some"."""
        if len(self.places) == 1:
            return {0: "first", self.count - 1: "last"}.get(self.places[0], "some")
        return "every" if len(set(np.diff(self.places).tolist())) == 1 else "some"

    @property
    def values(self) -> dict[str, Any]:
        """Values for the text of a finding about wrong places in the list of atoms."""
        shown = ", ".join(map(str, self.places[:8])) + (", …" if len(self.places) > 8 else "")
        every = int(np.diff(self.places)[0]) if self.pattern == "every" else 0
        return {"places": shown, "every": every, "wrong_places": len(self.places), "count": self.count}


def wrong_places(subject: CalculatorSubject, atoms: Atoms, allowed: NoiseFloor) -> WrongPlaces | None:
    """Exchange like atoms to find places in the list of atoms with wrong results.

    Exchanging two like atoms between correct places changes neither energy nor forces. An error tied to a
    place appears there for any order of the atoms. Other errors depend on the order of all atoms, such as a
    neglected neighbor. Such errors appear at nearly all places, or move if atoms are reordered.

    Returns:
        None if energy and forces are correct at all places, or if they are wrong at nearly all places.
    """
    key = "places", atoms.positions.tobytes(), atoms.numbers.tobytes()
    if key not in subject.known:
        subject.known[key] = None
        with suppress(CalculatorError), subject.trying():
            subject.known[key] = _wrong_places(subject, atoms, allowed)
    return subject.known[key]


def _wrong_places(subject: CalculatorSubject, atoms: Atoms, allowed: NoiseFloor) -> WrongPlaces | None:
    rng, count = np.random.default_rng(0), len(atoms)
    ends = [*range(min(count, 17)), *range(max(count - 8, 0), count)]
    places = list(dict.fromkeys([*ends, *rng.permutation(count)[: _PLACES - len(ends)].tolist()]))
    orders = np.arange(count), rng.permutation(count)
    found = [_at_places(subject, atoms, order, places, allowed) for order in orders]
    # where both orders tried a place, they must agree on it
    tried = found[0].keys() & found[1].keys()
    wrong = [sorted(place for place in tried if any(one[place])) for one in found]
    if wrong[0] != wrong[1] or not wrong[0]:
        return None
    return WrongPlaces(tuple(wrong[0]), count, any(one[place][0] for one in found for place in wrong[0]))


def _at_places(
    subject: CalculatorSubject, atoms: Atoms, order: np.ndarray, places: Sequence[int], allowed: NoiseFloor
) -> dict[int, tuple[bool, bool]]:
    """Test whether energy and forces change if an atom is exchanged with one at a correct place.

    Returns:
        for each tested place, whether energy and forces change; empty if most places of a species are wrong.
    """
    numbers, found = atoms.numbers[order], {}
    base = in_order(subject.fresh(), atoms, order)

    def exchanged(one: int, other: int) -> tuple[bool, bool]:
        there = order.copy()
        there[[one, other]] = order[[other, one]]
        energy, force = differences(base, in_order(subject.fresh(), atoms, there))
        return energy > allowed.energy, force > allowed.force

    for number in set(numbers.tolist()):
        same = [place for place in places if numbers[place] == number]
        for ordinary in same[:: max(len(same) // _CANDIDATES, 1)][::-1] if len(same) > 2 else ():
            others = [place for place in same if place != ordinary]
            few = others[:: max(len(others) // 4, 1)]
            # between ordinary places an exchange changes nothing, and most places are ordinary
            if 2 * sum(any(exchanged(place, ordinary)) for place in few) <= len(few):
                changes = {place: exchanged(place, ordinary) for place in others}
                if 2 * sum(map(any, changes.values())) <= len(others):
                    found |= {ordinary: (False, False), **changes}
                    break
        else:
            if len(same) > 2:
                return {}
    return found
