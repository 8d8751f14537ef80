"""What processes found in their parts of a trajectory, joined into what one process would have found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.ledger import Flips, Members
from mdnum.trajectories.rules import Rule


@dataclass(frozen=True)
class RuleResult:
    """What one membership rule gave.

    Attributes:
        rule: the rule.
        flips: a row per decision that differs from the frame before.
        pairs: pairs inside, per frame.
        near: pairs whose margin is within the bound, per frame: the file cannot tell them.
        min_margin: smallest |margin|, per frame, length.
        initial: the pairs inside at the first frame.
        last: and at the last.
    """

    rule: Rule
    flips: Flips
    pairs: Int[np.ndarray, "frames"]
    near: Int[np.ndarray, "frames"]
    min_margin: Float[np.ndarray, "frames"]
    initial: Members
    last: Members

    @property
    def ambiguous(self) -> float:
        """Share of the flips that the file cannot tell; nan without flips."""
        return float(self.flips.ambiguous.mean()) if len(self.flips) else float("nan")

    def entered(self) -> Int[np.ndarray, "frames"]:
        """Pairs that entered, per frame."""
        return self._per_frame(self.flips.entered)

    def left(self) -> Int[np.ndarray, "frames"]:
        """Pairs that left, per frame."""
        return self._per_frame(~self.flips.entered)

    def _per_frame(self, rows: Bool[np.ndarray, "flips"]) -> Int[np.ndarray, "frames"]:
        return np.bincount(self.flips.frame[rows], minlength=len(self.pairs)).astype(np.int64)


@dataclass
class Part:
    """What one process found with one rule.

    Attributes:
        flips: of its frames that have any, frames counted from the first that it looked at.
        pairs: inside, per frame of its own.
        near: per frame.
        min_margin: per frame, length.
        before: the pairs inside at the frame before its first; None for the first part.
        initial: the pairs inside at its first frame, kept by the first part alone.
        last: the pairs inside at its last frame; None where it has none.
    """

    flips: list[Flips] = field(default_factory=list)
    pairs: list[int] = field(default_factory=list)
    near: list[int] = field(default_factory=list)
    min_margin: list[float] = field(default_factory=list)
    before: Members | None = None
    initial: Members | None = None
    last: Members | None = None


def joined(rule: Rule, parts: Sequence[Part]) -> RuleResult:
    """The parts one after the other, frames counted from the first of all.

    Raises:
        InputError: two processes found other pairs at the frame between them: the file changed meanwhile.
    """
    flips: list[Flips] = []
    done, last = 0, None
    for part in parts:
        if last is not None and part.before is not None and not same(last, part.before):
            raise InputError(
                f"two processes found other pairs at the frame between them (number {done - 1} of those "
                "looked at)",
                remedy="The file was changed while it was read; run again",
            )
        # a part that looked at the frame before its first has counted that one too
        shift = done - (part.before is not None)
        flips += [replace(rows, frame=rows.frame + shift) for rows in part.flips]
        done += len(part.pairs)
        last = part.last if part.last is not None else last
    initial = parts[0].initial if parts else None
    return RuleResult(
        rule,
        Flips.concatenate(flips) if flips else Flips.none(),
        np.array([count for part in parts for count in part.pairs], np.int64),
        np.array([count for part in parts for count in part.near], np.int64),
        np.array([margin for part in parts for margin in part.min_margin], np.float64),
        initial if initial is not None else _nobody(),
        last if last is not None else _nobody(),
    )


def same(one: Members, other: Members) -> bool:
    """Whether two sets of pairs are one, distances to the last bit included."""
    return all(np.array_equal(getattr(one, each.name), getattr(other, each.name)) for each in fields(Members))


def _nobody() -> Members:
    none = np.zeros(0, np.int64)
    return Members(none, none, none, np.zeros(0))
