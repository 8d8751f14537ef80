"""What a run decided, step by step, in 64 bits a step."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt64

from mdnum.md.cell import HostCell
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, unwrapped
from mdnum.rollout.flips import decided_pairs, fingerprint_of_bits
from mdnum.systems.build import Simulation

Loss = Callable[[Simulation, Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]], float]


@dataclass(frozen=True)
class History:
    """The decisions of a run, and where it ended.

    Attributes:
        marks: of each step from 0 on, a number that all sets of pairs inside but the same one have different
            (up to collisions of 64 bits); shorter where the run failed, shape (steps + 1,).
        x, v: at the last step, unwrapped length, and length per internal time, shape (atoms, 3).
        energy: potential and kinetic, at the last step.
        failed: "blow-up" or "runaway" where it ended that way, else "".
    """

    marks: UInt64[np.ndarray, "rows"]
    x: Float[np.ndarray, "atoms 3"]
    v: Float[np.ndarray, "atoms 3"]
    energy: float
    failed: str

    @property
    def digest(self) -> str:
        """All decisions in one word of 32 hexadecimal digits; the order of pairs and lists is not in it."""
        return hashlib.blake2b(self.marks.tobytes() + self.failed.encode(), digest_size=16).hexdigest()

    def first_difference(self, other: History) -> int | None:
        """The first step at which two runs decide differently; None where they decide alike."""
        common = min(len(self.marks), len(other.marks))
        differ = np.flatnonzero(self.marks[:common] != other.marks[:common])
        if len(differ):
            return int(differ[0])
        return None if len(self.marks) == len(other.marks) else common


def marks_of(segment: Segment) -> UInt64[np.ndarray, "rows"]:
    """The marks of the steps of a segment."""
    table = segment.table
    rows = segment.rows_of("bits")
    return np.array([fingerprint_of_bits(bits, table.index, table.order)[1] for bits in rows], np.uint64)


def history(simulation: Simulation, steps: int, start: Start | None = None) -> History:
    """Run, and keep what was decided."""
    marks = []
    segment = None
    for segment in Engine(simulation, steps, start=start).segments():
        marks.append(marks_of(segment))
    assert segment is not None
    row = segment.rows - 1
    x = unwrapped(
        np.asarray(simulation.cell.matrix), segment.unsorted("x", row), segment.unsorted("images", row)
    )
    energy = float(segment.rows_of("potential")[row] + segment.rows_of("kinetic")[row])
    failed = segment.closes if segment.closes in FAILURES else ""
    v = segment.unsorted("v", row)
    return History(np.concatenate(marks), x, v.astype(np.float64), energy, failed or "")


@dataclass(frozen=True)
class Look:
    """What a run decided at one step, and from where.

    Attributes:
        pairs: keys i * atoms + j of the pairs inside, sorted.
        x: wrapped positions, shape (atoms, 3).
    """

    pairs: np.ndarray
    x: np.ndarray


def look(simulation: Simulation, steps: int, at: int, start: Start | None = None) -> Look:
    """One step of a run, by the program that makes all its steps."""
    # another last step would be another program: records of another size
    for segment in Engine(simulation, steps, start=start).segments():
        if segment.last >= at:
            row = at - segment.first
            return Look(decided_pairs(simulation, segment, row), segment.unsorted("x", row))
    raise IndexError(f"the run has no step {at}")


def margin(simulation: Simulation, x: np.ndarray, i: int, j: int) -> float:
    """Threshold minus quantity of a pair, with the bits that the program decides by."""
    decider = simulation.decider
    kind = int(simulation.type_of(np.array([i]), np.array([j]))[0])
    d = HostCell(simulation.cell, decider.dtype).displacement(x[[i]], x[[j]])
    return decider.thresholds[kind].value - float(decider.host_quantity(*d)[0])


def squared_displacement(simulation: Simulation, x: np.ndarray, v: np.ndarray) -> float:
    """Mean squared displacement from the start, length squared: the loss unless another is asked for."""
    return float(np.mean(np.sum((x - simulation.positions) ** 2, axis=1)))
