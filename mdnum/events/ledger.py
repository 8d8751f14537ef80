"""The ledger: every flip of a channel of decisions, and the algebra that proves it complete.

A ledger knows subjects (integer labels of what the decision is about: a pair of atoms, a ball, a list),
not what they mean.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class Ledger:
    """The flips of one channel in time; row order is step, then subject.

    Step s means that the decision at s differs from the one at s - 1.

    Attributes:
        channel: name of the stream of decisions, for example "pair".
        step: step of each flip.
        subject: labels of what was decided, shape (flips, labels).
        entered: True where the decision turned yes.
        margin: signed distance to the threshold at the step of the flip, in the quantity's space.
        bound: rounding bound on the quantity, in the same space.
        jump: what the flip does to the conserved quantity (energy), signed.
        extra: further columns by name, each of shape (flips,).
    """

    channel: str
    step: Int[np.ndarray, "flips"]
    subject: Int[np.ndarray, "flips labels"]
    entered: Bool[np.ndarray, "flips"]
    margin: Float[np.ndarray, "flips"]
    bound: Float[np.ndarray, "flips"]
    jump: Float[np.ndarray, "flips"]
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.step)

    @property
    def ambiguous(self) -> Bool[np.ndarray, "flips"]:
        """Flips whose date another legitimate rounding could have moved: |margin| within the bound."""
        return np.abs(self.margin) <= self.bound

    def counts(self, steps: int) -> tuple[Int[np.ndarray, "steps"], Int[np.ndarray, "steps"]]:
        """How many decisions turned yes and no at each step 0..steps."""
        entered = np.bincount(self.step[self.entered], minlength=steps + 1)
        left = np.bincount(self.step[~self.entered], minlength=steps + 1)
        return entered, left

    def inside(self, first: int, steps: int) -> Int[np.ndarray, "steps"]:
        """Number of yes decisions at each step 0..steps by the event algebra: first + entered - left."""
        entered, left = self.counts(steps)
        return first + np.cumsum(entered - left)

    def jumps(self, steps: int) -> Float[np.ndarray, "steps"]:
        """Sum of the jumps of the flips of each step 0..steps."""
        # bincount of nothing is a row of integers, whatever its weights
        return np.bincount(self.step, weights=self.jump, minlength=steps + 1).astype(np.float64)


def sort_rows(step, subject) -> Int[np.ndarray, "rows"]:
    """Order of rows by step, then by the labels of the subject, first label first."""
    sizes = [int(column.max(initial=0)) + 1 for column in subject.T]
    key = step - step.min(initial=0)
    if float(key.max(initial=0) + 1) * float(np.prod(np.array(sizes, float))) >= 2**63:
        return np.lexsort((*subject.T[::-1], step))
    # one integer sorts several times faster than three keys; rows are distinct, so the order is unique
    for column, size in zip(subject.T, sizes, strict=True):
        key = key * size + column
    return np.argsort(key)


def broken_alternations(ledger: Ledger) -> int:
    """Rows that repeat the direction of the same subject's flip before: 0 for a complete ledger.

    A decision that turned yes can only turn no next, so a missed flip of a subject that flips again
    leaves two equal directions in a row.
    """
    if not len(ledger):
        return 0
    keys = tuple(ledger.subject[:, k] for k in range(ledger.subject.shape[1]))
    order = np.lexsort((ledger.step, *keys))
    subject, entered = ledger.subject[order], ledger.entered[order]
    same = np.all(subject[1:] == subject[:-1], axis=1)
    return int(np.sum(same & (entered[1:] == entered[:-1])))
