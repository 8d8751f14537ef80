"""Two simulations that differ in one numerical choice."""

from __future__ import annotations

from dataclasses import dataclass

from mdnum.rollout.engine import Start
from mdnum.rollout.frame import Frame
from mdnum.systems.build import Simulation


@dataclass(frozen=True)
class Twin:
    """The two programs of a comparison.

    Attributes:
        a, b: the simulations.
        difference: what differs, in words.
        start_a, start_b: where they begin; None for their systems' own starts.
        frame: how B's atoms and axes are A's; None where they are the same.
    """

    a: Simulation
    b: Simulation
    difference: str
    start_a: Start | None = None
    start_b: Start | None = None
    frame: Frame | None = None
