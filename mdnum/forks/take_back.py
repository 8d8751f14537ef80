"""A decision taken back: B with some pairs told what A decided, and everything else left to itself."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.events.forks import split_of
from mdnum.forks.pair import Fork
from mdnum.rollout.compared import Apart
from mdnum.rollout.engine import Engine, Segment, Start
from mdnum.rollout.flips import PairRecorder, decided_pairs
from mdnum.rollout.lockstep import apart
from mdnum.rollout.pins import Pin, Pins
from mdnum.rollout.tracks import Track
from mdnum.systems.build import Simulation


@dataclass(frozen=True)
class Told:
    """What a run decided about some pairs.

    Attributes:
        atoms: of the run.
        first: keys of those inside at its first step.
        changes: steps at which each of them flipped, by key, ascending.
    """

    atoms: int
    first: frozenset[int]
    changes: dict[int, tuple[int, ...]]

    def pins(self, keys: Iterable[int], first: int, last: int) -> Pins:
        """These pairs, told over a window of steps."""
        return Pins(
            [Pin(*divmod(key, self.atoms), first, last, self.changes[key], key in self.first) for key in keys]
        )


def decided(
    simulation: Simulation,
    keys: Iterable[int],
    last: int,
    start: Start | None = None,
    watch: Callable[[Segment], None] | None = None,
) -> Told:
    """Follow a run and keep what it decides about some pairs.

    Args:
        simulation: the run.
        keys: of the pairs, i * atoms + j with i < j.
        last: last step.
        start: where it begins.
        watch: called with every segment.
    """
    recorder = PairRecorder(simulation)
    changes: dict[int, list[int]] = {key: [] for key in keys}
    first: frozenset[int] | None = None
    for segment in Engine(simulation, last, start=start).segments():
        if first is None:
            inside = decided_pairs(simulation, segment, 0)
            first = frozenset(key for key in changes if _holds(inside, key))
        ledger = recorder.flips(segment)
        named = ledger.subject[:, 0].astype(np.int64) * simulation.atoms + ledger.subject[:, 1]
        for step, key in zip(ledger.step.tolist(), named.tolist(), strict=True):
            if key in changes:
                changes[key].append(step)
        if watch is not None:
            watch(segment)
    return Told(simulation.atoms, first or frozenset(), {key: tuple(steps) for key, steps in changes.items()})


def _holds(ordered: np.ndarray, key: int) -> bool:
    at = int(np.searchsorted(ordered, key))
    return at < len(ordered) and int(ordered[at]) == key


@dataclass(frozen=True)
class Pinned:
    """B with some decisions taken back.

    Attributes:
        pairs: that were told what A decided.
        first, last: steps of the window in which they were.
        separation: from A at each step, length; NaN where a run has ended.
        split: first step beyond the tolerance; None where there is none.
        free: split without the pins.
    """

    pairs: tuple[tuple[int, int], ...]
    first: int
    last: int
    separation: Float[np.ndarray, "steps"]
    split: int | None
    free: int | None


def pinned(
    found: Fork,
    pairs: Sequence[tuple[int, int]] | None = None,
    *,
    first: int | None = None,
    last: int | None = None,
    steps: int | None = None,
) -> Pinned:
    """Run B again, told what A decided about some pairs, and see how it parts from A.

    Args:
        found: a pair of runs of one labeling.
        pairs: (i, j); default the pair at the fork, for as long as the two runs first disagreed about it.
        first, last: the steps at which B is told; default the whole run where pairs are named.
        steps: last step; default as far as the runs were followed.

    Raises:
        InputError: no fork and no pairs, pairs that there are not, many-body potentials, or runs seen in
            other labels or axes.
    """
    check_pins(found)
    last_step = found.steps if steps is None else steps
    if pairs is None:
        if found.decision is None:
            raise InputError("the runs do not fork", remedy="Name the pairs to pin")
        pairs = [(found.decision.i, found.decision.j)]
        spell = disagreements(found, *pairs[0])[0]
        first = spell[0] if first is None else first
        last = (spell[1] or found.steps) - 1 if last is None else last
    window = 0 if first is None else first, last_step if last is None else last
    atoms = found.twin.a.atoms
    for pair in pairs:
        _check_pair(pair, atoms)
    keys = [min(pair) * atoms + max(pair) for pair in pairs]
    twin = found.twin
    told = decided(twin.a, keys, last_step, twin.start_a)
    a = Track(twin.a, last_step, twin.start_a, flips=False)
    b = Track(twin.b, last_step, twin.start_b, flips=False, pins=told.pins(keys, *window))
    cell = Apart(twin.a.cell)
    parts = []
    while a.segment() is not None:
        end = a.ready
        rows, _ = a.until(end)
        parts.append(apart(cell, rows, b.until(end)[0]))
    separation = np.concatenate(parts)
    return Pinned(
        tuple((int(key // atoms), int(key % atoms)) for key in keys),
        *window,
        separation,
        split_of(separation, found.tolerance),
        found.dates.split,
    )


def _check_pair(pair: tuple[int, int], atoms: int) -> None:
    if not (0 <= min(pair) < max(pair) < atoms):
        raise InputError(f"no pair {pair[0]}-{pair[1]} of {atoms} atoms", where="pin")


def parse_pin(text: str, atoms: int) -> dict[str, Any]:
    """What `pinned` is to pin, from words: "fork", "3-75", "3-75:600..700".

    Raises:
        InputError: none of these, or a pair that there is not.
    """
    if text.strip() == "fork":
        return {}
    named = re.fullmatch(r"(\d+)\s*[-–]\s*(\d+)(?::(\d+)\.\.(\d+))?", text.strip())
    if named is None:
        raise InputError(
            f"{text!r} names no decision", where="pin", remedy="Write fork, 3-75 or 3-75:600..700"
        )
    pair = int(named[1]), int(named[2])
    _check_pair(pair, atoms)
    first, last = (None if part is None else int(part) for part in named.groups()[2:])
    if first is not None and last is not None and first > last:
        raise InputError(f"steps {first} to {last} are none", where="pin", remedy="Give the first step first")
    return {"pairs": [pair], "first": first, "last": last}


def check_pins(found: Fork) -> None:
    """Refuses a pair of runs whose decisions cannot be pinned.

    Raises:
        InputError: many-body potentials, or runs seen in other labels or axes.
    """
    twin = found.twin
    if not (twin.a.pairwise and twin.b.pairwise):
        raise InputError(
            "a many-body potential cannot be told its pairs", remedy="Use a system with a pair potential"
        )
    if twin.frame is not None and not twin.frame.is_same:
        raise InputError("the runs have other labels or axes", remedy="Choose a variation without")


def disagreements(found: Fork, i: int, j: int) -> list[tuple[int, int | None]]:
    """The steps from which on a pair was decided differently, and at which no longer; None where it stayed.

    Of the cross-run flips that were kept.
    """
    spells: list[tuple[int, int | None]] = []
    for flip in found.flips:
        if (flip.i, flip.j) != (i, j):
            continue
        if flip.differs:
            spells.append((flip.step, None))
        elif spells:
            spells[-1] = spells[-1][0], flip.step
    return spells
