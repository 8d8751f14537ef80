"""Whether a delay is more than chance: a sequential sign test on repeats of a pair of runs.

A pair of runs is repeated from perturbed starts, each time free and under the first run's decisions. A
single delay tells little: in a liquid any perturbation moves a split. But whether the flips were worth more
than a given delay can be counted. Where half of such pairs or fewer are delayed by more than that, k or more
of n are with the probability of k heads or more in n tosses at most, however the delays are distributed and
however few they are: no scatter has to be estimated. docs/verdict-calibration.md has how often it is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import comb

import numpy as np
from jaxtyping import Float

#: Repeats of a pair at most, where nothing was said.
REPEATS = 15
#: Pairs that are added before the next look.
LOOK = 5
#: How often a word may be wrong: the chance of it where half of the pairs are delayed.
ERROR = 0.05


@dataclass(frozen=True)
class Delay:
    """When one pair splits, free and under the first run's decisions.

    Attributes:
        free, handed: steps of the two splits; None for one that was not seen.
        free_until, handed_until: last steps at which the separations are known.
    """

    free: int | None
    handed: int | None
    free_until: int
    handed_until: int

    @classmethod
    def of(cls, free: Float[np.ndarray, "steps"], handed: Float[np.ndarray, "steps"], tolerance: float):
        """From separations at each step, length; NaN after a run was ended."""
        found = []
        for separation in (free, handed):
            beyond = separation > tolerance
            seen = np.flatnonzero(np.isfinite(separation))
            found.append((int(beyond.argmax()) if beyond.any() else None, int(seen[-1]) if len(seen) else -1))
        (split, until), (other, other_until) = found
        return cls(split, other, until, other_until)

    def beyond(self, steps: float) -> bool | None:
        """Whether the split comes more than so many steps later without the flips; None if not seen."""
        if self.free is not None and self.handed is not None:
            return self.handed - self.free > steps
        if self.free is not None:
            return True if self.handed_until + 1 - self.free > steps else None
        if self.handed is not None:
            return False if self.handed - self.free_until - 1 <= steps else None
        return None


@cache
def looks(pairs: int, error: float = ERROR) -> tuple[tuple[int, int], ...]:
    """After how many pairs to look, and how many of them must agree: (pairs, agreeing) of each look.

    The error is spent in proportion to the pairs (Lan and DeMets, Biometrika 70, 659, 1983): up to each look
    the exact probability that fair coins have stopped on one given side is at most that share of it.

    Args:
        pairs: at most.
        error: chance of either word where each pair is as likely delayed as not.
    """
    ends = [*range(1 + LOOK, pairs, LOOK), pairs]
    going, before, spent, found = {0: 1.0}, 0, 0.0, []
    for end in ends:
        more = end - before
        reached: dict[int, float] = {}
        for heads, chance in going.items():
            for new in range(more + 1):
                at = heads + new
                reached[at] = reached.get(at, 0.0) + chance * comb(more, new) / 2.0**more
        need, above = end + 1, 0.0
        while 2 * (need - 1) > end and spent + above + reached.get(need - 1, 0.0) <= error * end / pairs:
            need -= 1
            above += reached.get(need, 0.0)
        spent += above
        if need <= end:
            found.append((end, need))
        # both sides stop
        going = {heads: chance for heads, chance in reached.items() if end - need < heads < need}
        before = end
    return tuple(found)


#: Fewer repeats than this can never be clear.
FEWEST = next(pairs for pairs in range(1, 2 + REPEATS) if looks(pairs)) - 1


@dataclass(frozen=True)
class Count:
    """How many pairs were delayed.

    Attributes:
        pairs: that were run, the pair itself among them.
        later: that were delayed by more than asked for.
        not_later: that were not; of the others it was not seen.
        most: pairs at most.
    """

    pairs: int
    later: int
    not_later: int
    most: int

    @property
    def needed(self) -> tuple[int, int] | None:
        """The look these pairs are at, or the next: pairs, and how many must agree; None for none."""
        return next((look for look in looks(self.most) if look[0] >= self.pairs), None)

    @property
    def delayed(self) -> bool | None:
        """Whether most pairs are delayed, at a look; None where these do not tell."""
        need = dict(looks(self.most)).get(self.pairs)
        if need is None:
            return None
        return True if self.later >= need else False if self.not_later >= need else None

    @property
    def wanted(self) -> int:
        """Pairs to be run before the next look; 0 where there is no further one or the word is clear."""
        if self.delayed is not None:
            return 0
        return next((end - self.pairs for end, _ in looks(self.most) if end > self.pairs), 0)


def count(delays: tuple[Delay, ...], steps: float, most: int) -> Count:
    """Counts the pairs that split more than so many steps later without the flips.

    Args:
        delays: of the pair itself and its repeats.
        steps: that count as a delay.
        most: pairs at most.
    """
    found = [delay.beyond(steps) for delay in delays]
    return Count(len(found), found.count(True), found.count(False), most)
