"""Repeated runs around a fork: nearby atoms, imposed decisions and minimal causes.

Decisions of run A can be imposed on run B. All other decisions are those of run B. The tool Verrou searches
in a similar way for instructions that cause an error.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mdnum.deadline import fewest
from mdnum.errors import InputError
from mdnum.forks.pair import Fork
from mdnum.forks.tape import taped
from mdnum.md.cell import HostCell
from mdnum.numerics.verdicts import split_of
from mdnum.rollout.compared import ReferenceFrame
from mdnum.rollout.engine import Engine, Segment
from mdnum.rollout.lockstep import beside
from mdnum.rollout.program import pair_bound, pair_margin
from mdnum.rollout.tracks import Track

#: Distance from the pair up to which atoms are shown, in cutoffs of the pair.
REACH = 1.25
#: Factor on the step of the split up to which a minimal cause must keep the runs together.
_BEYOND = 1.25
#: Number of steps of a search at which positions of A are stored.
_SAMPLES = 400


@dataclass(frozen=True)
class Neighborhood:
    """The atoms near the pair whose decision differs first, at the step of the fork."""

    # labels of A; the pair first, the others by their distance from its middle, shape (near,)
    atoms: Int[np.ndarray, "near"]
    positions: Float[np.ndarray, "near 3"]  # in A, from the middle of the pair, length, shape (near, 3)
    moved: Float[np.ndarray, "near 3"]  # B's positions minus A's, length, shape (near, 3)
    # of the deciding pair in A and in B, as each program computes it, in the quantity's space
    margins: tuple[float, float]
    bounds: tuple[float, float]  # on the rounding errors of these


def neighborhood(fork: Fork) -> Neighborhood | None:
    """Repeat both runs. Return the atoms near the pair at the fork, or None without a pair."""
    if fork.decision is None:
        return None
    program_a, program_b = fork.twin.a, fork.twin.b
    first, j = fork.decision.subject
    # without the channel of the decision
    i = first % program_a.simulation.atoms
    # to the same last step as the first time, so that no program is compiled again
    states = [program.state_at(fork.decision.step, fork.asked) for program in (program_a, program_b)]
    if states[0] is None or states[1] is None:
        return None
    (a, x_a), (b, x_b) = states
    cell = HostCell(a.cell)
    across = np.stack(cell.displacement(x_a[[i]], x_a[[j]]), axis=-1)[0]
    from_i = np.stack(cell.displacement(np.broadcast_to(x_a[i], x_a.shape), x_a), axis=-1)
    # the nearest image of i may be another than that of the middle, so both ends are tried
    from_j = np.stack(cell.displacement(np.broadcast_to(x_a[j], x_a.shape), x_a), axis=-1)
    from_middle = from_i - across / 2
    other = from_j + across / 2
    nearer = (other**2).sum(axis=1) < (from_middle**2).sum(axis=1)
    from_middle[nearer] = other[nearer]
    distance = np.sqrt((from_middle**2).sum(axis=1))
    distance[[i, j]] = -1.0
    order = np.argsort(distance, kind="stable")
    chosen = order[distance[order] <= REACH * a.r_cut]
    chosen = np.concatenate([[i, j], chosen[(chosen != i) & (chosen != j)]])
    moved = np.stack(cell.displacement(x_a[chosen], x_b[chosen]), axis=-1)
    margins = pair_margin(a, x_a, first, j), pair_margin(b, x_b, first, j, labels=a)
    frame = program_b.frame or ReferenceFrame.same(b.atoms)
    kind = int(a.type_of(np.array([first]), np.array([j]))[0])
    own = frame.inverse.positions(x_b.T[None])
    bounds = pair_bound(a, x_a, first, j), float(b.decider.bounds_at(own)[0, kind])
    return Neighborhood(chosen, from_middle[chosen], moved, margins, bounds)


# --- overridden decisions -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Pinned:
    """Result of run B with decisions of run A on some pairs of atoms."""

    pairs: tuple[tuple[int, int], ...]  # whose decisions were
    # first, last: steps of the window in which they were
    first: int
    last: int
    separation: Float[np.ndarray, "steps"]  # from A at each step, length; NaN where a run has ended
    split: int | None  # first step beyond the tolerance; None where there is none
    free: int | None  # split without the pins


def pinned(
    fork: Fork,
    pairs: Sequence[tuple[int, int]] | None = None,
    *,
    first: int | None = None,
    last: int | None = None,
    steps: int | None = None,
) -> Pinned:
    """Repeat run B with run A's decisions on some pairs. Compute the distance between the runs.

    Args:
        fork: a pair of runs with the same atom labels.
        pairs: pairs (i, j) of atoms; default the pair at the fork, during the first interval in which its
            decisions differ.
        first, last: first and last step of the window; default the whole run if pairs are given.
        steps: last step; default the last step of the fork's runs.

    Raises:
        InputError: neither a fork nor pairs are given, a pair does not exist, a potential is many-body, or
            the runs have different atom labels or axes.
    """
    check_pins(fork)
    a, b = fork.twin.a, fork.twin.b
    last_step = fork.steps if steps is None else steps
    if pairs is None:
        if fork.decision is None:
            raise InputError("runs A and B do not fork", remedy="Name the pairs whose decisions are imposed")
        i, j = fork.decision.subject
        pairs = [(i, j)]
        spell = disagreements(fork, i, j)[0]
        first = spell[0] if first is None else first
        last = (spell[1] or fork.steps) - 1 if last is None else last
    window = 0 if first is None else first, last_step if last is None else last
    keys = []
    for pair in pairs:
        channel, i = divmod(pair[0], a.size)
        _check_pair((i, pair[1]), a.size)
        keys.append((channel * a.size + min(i, pair[1])) * a.size + max(i, pair[1]))
    imposed = taped(a, last_step, lambda segment: None).pins(keys, *window)
    leader = Track(a.simulation, last_step, a.begin, flips=False)
    follower = Track(b.simulation, last_step, b.begin, flips=False, pins=imposed)
    separation = np.concatenate([rows for (rows,) in beside(leader, [follower])])
    named = tuple((int(key // a.size), int(key % a.size)) for key in keys)
    return Pinned(named, *window, separation, split_of(separation, fork.tolerance), fork.dates.split)


def _check_pair(pair: tuple[int, int], atoms: int) -> None:
    if not (0 <= min(pair) < max(pair) < atoms):
        raise InputError(f"the pair {pair[0]}-{pair[1]} does not exist among {atoms} atoms", where="pin")


def parse_pin(text: str, atoms: int) -> dict[str, Any]:
    """Parse a text that describes imposed decisions ("fork", "3-75", "3-75:600..700") for `pinned`.

    Raises:
        InputError: the text has none of these forms, or the pair of atoms does not exist.
    """
    if text.strip() == "fork":
        return {}
    named = re.fullmatch(r"(\d+)\s*[-–]\s*(\d+)(?::(\d+)\.\.(\d+))?", text.strip())
    if named is None:
        raise InputError(
            f"{text!r} is not a pair decision", where="pin", remedy="Write fork, 3-75 or 3-75:600..700"
        )
    pair = int(named[1]), int(named[2])
    _check_pair(pair, atoms)
    first, last = (None if part is None else int(part) for part in named.groups()[2:])
    if first is not None and last is not None and first > last:
        raise InputError(
            f"the range of steps {first} to {last} ends before it begins",
            where="pin",
            remedy="Give the smaller step first",
        )
    return {"pairs": [pair], "first": first, "last": last}


def check_pins(fork: Fork) -> None:
    """Raise an error if decisions of one run cannot be imposed on the other.

    Raises:
        InputError: a potential is many-body, or the runs have different atom labels or axes.
    """
    a, b = fork.twin.a, fork.twin.b
    if a.imposable or b.imposable:
        raise InputError(
            "pair decisions cannot be imposed on a many-body potential",
            remedy="Use a system with a pair potential",
        )
    if b.frame is not None and not b.frame.is_same:
        raise InputError(
            "runs A and B list the atoms in different orders or use different coordinate axes",
            remedy="Compare runs with the same order of atoms and the same coordinate axes",
        )


def disagreements(fork: Fork, i: int, j: int) -> list[tuple[int, int | None]]:
    """Return step intervals (first, end or None) in which the decisions on a pair differ.

    Only the stored differences between the decisions of the two runs are used.
    """
    spells: list[tuple[int, int | None]] = []
    for flip in fork.flips:
        if (flip.i, flip.j) != (i, j):
            continue
        if flip.differs:
            spells.append((flip.step, None))
        elif spells:
            spells[-1] = spells[-1][0], flip.step
    return spells


# --- minimal causes -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Minimal:
    """A minimal set of pairs. If run A's decisions on the set are imposed on run B, the runs stay close."""

    # pairs (i, j) whose pinning to A's decisions, from the start to the horizon, keeps B with A; None where
    # no set does
    pairs: tuple[tuple[int, int], ...] | None
    # "alone": pinning the pair at the fork alone is enough; "none": no set is; "proven": none of the pairs
    # can be left out; "unproven": the runs allowed did not suffice to show that
    code: str
    candidates: int  # pairs that the runs decided differently before the split
    tests: int  # runs that were made
    horizon: int  # up to which step B had to stay with A

    @property
    def proven(self) -> bool:
        """True if each pair of the set was shown to be necessary."""
        return self.code in ("alone", "proven")


def minimal_cause(
    fork: Fork, *, tests: int = 80, progress: Callable[[int, int], None] | None = None
) -> Minimal:
    """Find a minimal set of pairs on which run A's decisions keep run B close to run A.

    Args:
        fork: a pair of runs with the same atom labels that has forked and split.
        tests: largest number of runs of B.
        progress: called with the number of runs made and the largest number allowed.

    Raises:
        InputError: the runs did not split, have different atom labels or axes, or a many-body potential.

    Error: 1-minimal only: no single pair can be left out, but another, smaller set may exist.
    """
    split = fork.dates.split
    if fork.dates.fork is None or split is None or fork.decision is None:
        raise InputError("runs A and B stayed close together", remedy="Use more steps, or reduce `split`")
    check_pins(fork)
    atoms = fork.twin.a.size
    # pairs that differ before the split, in the order in which they first do
    differing = (flip for flip in fork.flips if flip.differs and flip.step < split)
    keys = list(dict.fromkeys(flip.i * atoms + flip.j for flip in differing))
    search = _Search(fork, int(_BEYOND * split) + 1, tests, progress)
    i, j = fork.decision.subject
    best, code = [i * atoms + j], "alone"
    if not search.holds(best):
        # bisection is quick where decisions do not depend on one another; what it leaves is thinned further
        best, code = (keys, "proven") if search.holds(keys) else ([], "none")
        required = _required(best, search, search.made + (tests - search.made) // 2)
        best = fewest(required if search.known.get(frozenset(required)) else best, search.holds, search.spent)
        code = "unproven" if best and search.spent() else code
    pairs = tuple(divmod(key, atoms) for key in sorted(best)) or None
    return Minimal(pairs, code, len(keys), search.made, search.horizon)


class _Search:
    """Search that repeats run B with A's decisions and tests whether B stays close to A."""

    def __init__(
        self,
        fork: Fork,
        horizon: int,
        allowed: int,
        progress: Callable[[int, int], None] | None,
    ):
        self.fork, self.horizon, self.allowed, self.progress = fork, horizon, allowed, progress
        self.made = 0
        self.known: dict[frozenset[int], bool] = {frozenset(): False}
        self._every = max(1, horizon // _SAMPLES)
        # by step, with the box
        self._positions: dict[int, tuple[HostCell, np.ndarray]] = {}
        self._tape = taped(fork.twin.a, horizon, self._keep)

    def spent(self) -> bool:
        """Return True if the allowed number of repeated runs has been reached."""
        return self.made >= self.allowed

    def _keep(self, segment: Segment) -> None:
        """Store the positions of run A at regular intervals."""
        for row in range(segment.rows):
            if (segment.first + row) % self._every == 0:
                x = segment.unsorted("x", row).astype(np.float64)
                self._positions[segment.first + row] = HostCell(segment.cell_of(row)), x

    def holds(self, keys: Sequence[int]) -> bool:
        """Repeat B with A's decisions on pairs. False if B splits from A, or no run is left."""
        name = frozenset(keys)
        if name not in self.known:
            if self.spent():
                return False
            self.known[name] = self._stays(keys)
            self.made += 1
            if self.progress is not None:
                self.progress(self.made, self.allowed)
        return self.known[name]

    def _stays(self, keys: Sequence[int]) -> bool:
        b, tolerance = self.fork.twin.b, self.fork.tolerance
        reached = -1
        pins = self._tape.pins(keys, 0, self.horizon)
        for segment in Engine(b.simulation, self.horizon, start=b.begin, pins=pins).segments():
            for row in range(segment.rows):
                step = segment.first + row
                if step in self._positions:
                    here = segment.unsorted("x", row).astype(np.float64)
                    cell, x = self._positions[step]
                    d = cell.displacement(x, here)
                    if not float(np.max(sum(c * c for c in d))) <= tolerance**2:
                        return False
            reached = segment.last
        return reached >= self.horizon


def _required(keys: list[int], search: _Search, until: int) -> list[int]:
    """Find a sufficient set of pairs by bisection, one necessary pair after another (QuickXplain).

    QuickXplain needs about log2(n) runs per necessary pair of n. Delta debugging needs about n² runs. The
    search assumes that imposing more decisions never splits runs. The search stops after `until` runs.

    Source: U. Junker, QuickXplain, AAAI 2004.
    """
    required: list[int] = []
    pool = keys
    while pool and search.made < until and not search.holds(required):
        low, high = 0, len(pool)
        while high - low > 1 and search.made < until:
            middle = (low + high) // 2
            if search.holds([*required, *pool[:middle]]):
                high = middle
            else:
                low = middle
        required.append(pool[high - 1])
        pool = pool[: high - 1]
    return required
