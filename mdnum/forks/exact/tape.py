"""The pair decisions of a run as flips, and where two such tapes first differ."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from mdnum.program import Decision


@dataclass(frozen=True)
class DecisionTape:
    """Every pair decision of a run from step 0 on: the pairs inside at the start, and what changed later.

    Attributes:
        atoms: number of atoms.
        steps: the last step that was decided.
        first: keys i * atoms + j (i < j) of the pairs inside at step 0, sorted.
        step, key, entered: the flips, sorted by step and key.
    """

    atoms: int
    steps: int
    first: Int[np.ndarray, "pairs"]
    step: Int[np.ndarray, "flips"]
    key: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]

    @property
    def flips(self) -> int:
        """Number of flips."""
        return len(self.step)

    def pair(self, key: int) -> tuple[int, int]:
        """The atoms of a key, i < j."""
        i, j = divmod(int(key), self.atoms)
        return i, j

    def inside(self, step: int) -> Int[np.ndarray, "pairs"]:
        """Keys of the pairs inside at a step, sorted."""
        members = set(self.first.tolist())
        so_far = self.step <= step
        for key, entered in zip(self.key[so_far].tolist(), self.entered[so_far].tolist(), strict=True):
            (members.add if entered else members.discard)(key)
        return np.array(sorted(members), np.int64)

    def until(self, last: int) -> DecisionTape:
        """The same tape up to a step."""
        kept = self.step <= last
        return replace(
            self,
            steps=min(self.steps, last),
            step=self.step[kept],
            key=self.key[kept],
            entered=self.entered[kept],
        )


def first_difference(a: DecisionTape, b: DecisionTape) -> Decision | None:
    """The first step at which any pair is decided differently; None where there is none in both tapes.

    Raises:
        ValueError: tapes of different numbers of atoms.
    """
    if a.atoms != b.atoms:
        raise ValueError(f"tapes of {a.atoms} and {b.atoms} atoms")
    differing = np.setxor1d(a.first, b.first)
    step = 0
    if not len(differing):
        last = min(a.steps, b.steps)
        rows_a, rows_b = _rows(a.until(last)), _rows(b.until(last))
        apart = rows_a ^ rows_b
        if not apart:
            return None
        step = min(row[0] for row in apart)
        differing = np.unique([key for at, key, _ in apart if at == step])
    key = int(differing[0])
    first, second = (int(np.isin(key, tape.inside(step))) for tape in (a, b))
    return Decision(
        channel="pair",
        step=step,
        subject=a.pair(key),
        run="A" if first else "B",
        entered=True,
        a=first,
        b=second,
        margins={},
        bounds={},
        separation=float("nan"),
        also=len(differing) - 1,
    )


def _rows(tape: DecisionTape) -> set[tuple[int, int, bool]]:
    return set(zip(tape.step.tolist(), tape.key.tolist(), tape.entered.tolist(), strict=True))
