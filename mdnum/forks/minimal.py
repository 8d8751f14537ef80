"""The fewest pairs whose decisions have to be taken back for two runs to stay together.

Of the pairs that the two runs decide differently before they split, pin some in B to what A decided, at every
step up to the horizon, let B decide everything else, and see whether it still leaves A. Verrou does the same
for the instructions of a program, by delta debugging.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.pair import Fork
from mdnum.forks.take_back import check_pins, decided
from mdnum.md.cell import HostCell
from mdnum.rollout.engine import Engine, Segment

#: "Together" means up to so many times the step of the split.
_BEYOND = 1.25
#: Positions of A are kept at so many steps.
_SAMPLES = 400


@dataclass(frozen=True)
class Minimal:
    """A smallest set of pairs that restores agreement.

    Attributes:
        pairs: pairs (i, j) whose pinning to A's decisions, from the start to the horizon, keeps B with A;
            None where no set does.
        proven: whether none of them can be left out; False where the runs allowed did not suffice.
        fork_alone: whether pinning the pair at the fork alone is enough.
        candidates: pairs that the runs decided differently before the split.
        tests: runs that were made.
        horizon: up to which step B had to stay with A.
        reason: in words.
    """

    pairs: tuple[tuple[int, int], ...] | None
    proven: bool
    fork_alone: bool
    candidates: int
    tests: int
    horizon: int
    reason: str


def minimal_cause(
    found: Fork, *, tests: int = 80, progress: Callable[[int, int], None] | None = None
) -> Minimal:
    """A 1-minimal set of pairs whose pinning takes a split away.

    Args:
        found: a pair of runs that has forked and split, of one labeling.
        tests: runs of B at most.
        progress: called with the tests made and allowed.

    Raises:
        InputError: the runs did not split, are seen in other labels or axes, or have many-body potentials.

    Error: 1-minimal only: no single pair can be left out, but another, smaller set may exist.
    """
    if found.dates.fork is None or found.dates.split is None or found.decision is None:
        raise InputError("the runs did not split", remedy="Run longer, or with a smaller split tolerance")
    check_pins(found)
    horizon = int(_BEYOND * found.dates.split) + 1
    told = f"from the start to step {horizon:,} are A's"
    keys = _candidates(found)
    search = _Search(found, keys, horizon, tests, progress)
    first = found.decision.i * found.twin.a.atoms + found.decision.j
    alone = search.holds([first])
    if alone:
        text = f"the pair at the fork alone does it (its decisions {told}: {horizon + 1:,} decisions)"
        return search.answer([first], True, text)
    if not search.holds(keys):
        return search.answer(
            None, False, "with all of them pinned the runs part as well: no set of pairs is the cause"
        )
    # bisection is quick where the decisions do not depend on one another; what it leaves is thinned further
    best = _required(keys, search, search.made + (tests - search.made) // 2)
    best = _ddmin(best if search.known(best) else keys, search)
    if search.spent:
        text = f"{len(best)} pairs are enough; {search.made} runs did not show whether fewer are"
        return search.answer(best, False, f"{text} (their decisions {told})", proven=False)
    text = f"{len(best)} pairs are enough, and none of them can be left out (their decisions {told})"
    return search.answer(best, False, text)


def _candidates(found: Fork) -> list[int]:
    """Pairs that differ before the split, in the order in which they first do."""
    split = found.dates.split
    assert split is not None
    seen: dict[int, None] = {}
    for flip in found.flips:
        if flip.differs and flip.step < split:
            seen.setdefault(flip.i * found.twin.a.atoms + flip.j)
    return list(seen)


class _Search:
    """Runs of B with some pairs pinned to what A decided, and their answers."""

    def __init__(
        self,
        found: Fork,
        keys: Sequence[int],
        horizon: int,
        allowed: int,
        progress: Callable[[int, int], None] | None,
    ):
        self.found, self.horizon, self.allowed, self.progress = found, horizon, allowed, progress
        self.candidates = len(keys)
        self.made = 0
        self._known: dict[frozenset[int], bool] = {}
        self._cell = HostCell(found.twin.a.cell)
        self._every = max(1, horizon // _SAMPLES)
        self._positions: dict[int, np.ndarray] = {}
        twin = found.twin
        self._told = decided(twin.a, keys, horizon, twin.start_a, self._keep)

    @property
    def spent(self) -> bool:
        """Whether no more runs are allowed."""
        return self.made >= self.allowed

    def known(self, keys: Sequence[int]) -> bool:
        """Whether these pairs are known to be enough."""
        return self._known.get(frozenset(keys), False)

    def answer(self, keys: Sequence[int] | None, alone: bool, reason: str, *, proven: bool = True) -> Minimal:
        """The outcome."""
        atoms = self.found.twin.a.atoms
        pairs = None if keys is None else tuple(divmod(key, atoms) for key in sorted(keys))
        return Minimal(
            pairs, proven and pairs is not None, alone, self.candidates, self.made, self.horizon, reason
        )

    def _keep(self, segment: Segment) -> None:
        """A's positions now and then."""
        for row in range(segment.rows):
            if (segment.first + row) % self._every == 0:
                self._positions[segment.first + row] = segment.unsorted("x", row).astype(np.float64)

    def holds(self, keys: Sequence[int]) -> bool:
        """Whether B stays with A when these pairs are pinned; False once no more runs are allowed."""
        name = frozenset(keys)
        if name not in self._known:
            if self.spent:
                return False
            self._known[name] = self._stays(keys)
            self.made += 1
            if self.progress is not None:
                self.progress(self.made, self.allowed)
        return self._known[name]

    def _stays(self, keys: Sequence[int]) -> bool:
        twin, tolerance = self.found.twin, self.found.tolerance
        reached = -1
        pins = self._told.pins(keys, 0, self.horizon)
        for segment in Engine(twin.b, self.horizon, start=twin.start_b, pins=pins).segments():
            for row in range(segment.rows):
                step = segment.first + row
                if step in self._positions:
                    here = segment.unsorted("x", row).astype(np.float64)
                    d = self._cell.displacement(self._positions[step], here)
                    if not float(np.max(sum(c * c for c in d))) <= tolerance**2:
                        return False
            reached = segment.last
        return reached >= self.horizon


def _required(keys: list[int], search: _Search, until: int) -> list[int]:
    """A set that should be enough, by bisection for one required pair after the other (QuickXplain).

    About log2(n) runs for each pair, where delta debugging needs their square; but it takes for granted that
    more pins never do harm.

    Args:
        until: number of runs at which it gives up.

    Source: Junker, QuickXplain, AAAI 2004.
    """
    required: list[int] = []
    pool = keys
    while pool and search.made < until and not (required and search.holds(required)):
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


def _ddmin(keys: list[int], search: _Search) -> list[int]:
    """A subset that is enough, 1-minimal if the runs allowed suffice (Zeller and Hildebrandt 2002)."""
    parts = 2
    while len(keys) >= 2 and not search.spent:
        size = -(-len(keys) // parts)
        blocks = [keys[k : k + size] for k in range(0, len(keys), size)]
        smaller = next((block for block in blocks if search.holds(block)), None)
        if smaller is not None:
            keys, parts = smaller, 2
            continue
        rests = ([key for key in keys if key not in set(block)] for block in blocks)
        rest = next((rest for rest in rests if rest and search.holds(rest)), None)
        if rest is not None:
            keys, parts = rest, max(parts - 1, 2)
        elif parts >= len(keys):
            break
        else:
            parts = min(len(keys), 2 * parts)
    return keys
