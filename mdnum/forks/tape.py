"""Cutoff decisions on all pairs in a run, to compare or impose them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Int

from mdnum.program import Decision
from mdnum.rollout.engine import Engine, Segment
from mdnum.rollout.epoch import Pin, Pins
from mdnum.rollout.flips import PairRecorder, decided_pairs
from mdnum.rollout.program import MdProgram


@dataclass(frozen=True)
class DecisionTape:
    """All pair decisions of a run: the pairs inside at step 0, and all later changes."""

    atoms: int  # number of atoms
    steps: int  # the last step that was decided
    first: Int[np.ndarray, "pairs"]  # keys i * atoms + j (i < j) of the pairs inside at step 0, sorted
    # step, key, entered: the flips, sorted by step and key
    step: Int[np.ndarray, "flips"]
    key: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]

    @property
    def flips(self) -> int:
        """Number of stored flips."""
        return len(self.step)

    @cached_property
    def changes(self) -> dict[int, tuple[int, ...]]:
        """Map from the key of each pair to the ascending steps at which it flips."""
        order = np.argsort(self.key, kind="stable")
        keys, begins = np.unique(self.key[order], return_index=True)
        steps = np.split(self.step[order], begins[1:])
        return {key: tuple(own.tolist()) for key, own in zip(keys.tolist(), steps, strict=True)}

    def pins(self, keys: Iterable[int], first: int, last: int) -> Pins:
        """Return the decisions on given pairs between two steps, for another run."""
        begins = set(self.first.tolist())
        return Pins(
            [
                Pin(*divmod(key, self.atoms), first, last, self.changes.get(key, ()), key in begins)
                for key in keys
            ]
        )

    def inside(self, step: int) -> Int[np.ndarray, "pairs"]:
        """Return the sorted keys of the pairs inside the cutoff at a step."""
        members = set(self.first.tolist())
        for _, key, entered in self.rows(step):
            (members.add if entered else members.discard)(key)
        return np.array(sorted(members), np.int64)

    def rows(self, last: int) -> list[tuple[int, int, bool]]:
        """Return step, pair key and direction of every flip up to a given step."""
        columns = (column[self.step <= last].tolist() for column in (self.step, self.key, self.entered))
        return list(zip(*columns, strict=True))


def first_difference(a: DecisionTape, b: DecisionTape) -> Decision | None:
    """Find the first step at which the decisions of two runs differ. None if all agree.

    Raises:
        ValueError: the tapes have different numbers of atoms.
    """
    if a.atoms != b.atoms:
        raise ValueError(f"the two recorded runs have {a.atoms} and {b.atoms} atoms; expected equal numbers")
    step, differing = 0, np.setxor1d(a.first, b.first)
    if not len(differing):
        last = min(a.steps, b.steps)
        rows = set(a.rows(last)) ^ set(b.rows(last))
        if not rows:
            return None
        step = min(row[0] for row in rows)
        differing = np.unique([key for at, key, _ in rows if at == step])
    first, second = (int(np.isin(differing[0], tape.inside(step))) for tape in (a, b))
    return Decision(
        channel="pair", step=step, subject=divmod(int(differing[0]), a.atoms), run="A" if first else "B",
        entered=True, a=first, b=second, margins={}, bounds={}, separation=float("nan"),
        also=len(differing) - 1,
    )  # fmt: skip


def taped(program: MdProgram, last: int, watch: Callable[[Segment], None]) -> DecisionTape:
    """Record every decision of a run up to a last step. `watch` is called with each segment."""
    simulation = program.simulation
    recorder, first, ledgers, end = PairRecorder(simulation), np.empty(0, np.int64), [], 0
    for segment in Engine(simulation, last, start=program.begin).segments():
        if not ledgers:
            first = decided_pairs(simulation, segment, 0)
        ledgers.append(recorder.flips(segment))
        end = segment.last
        watch(segment)
    step, i, j, entered = (
        np.concatenate([getattr(ledger, name) for ledger in ledgers])
        for name in ("step", "i", "j", "entered")
    )
    key = i * simulation.atoms + j
    order = np.lexsort((key, step))
    return DecisionTape(simulation.atoms, end, first, step[order], key[order], entered[order])
