"""Ensembles: the same program from starts that differ by a little noise, measured at a few steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mdnum.forks.benign.features import Ruler, measure
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, first_state, resume_point
from mdnum.rollout.program import MdProgram
from mdnum.systems.build import Simulation

#: Displacement of the furthest atom of a start, in float32 ulps of the largest coordinate. An atom then
#: moves by more than ten: the rounding of a single precision run must drown in it.
NOISE = 40
#: A pair of members is followed no further than this, and looked at so often.
_LONGEST = 20_000
_GLANCE = 50


def noise_size(simulation: Simulation) -> float:
    """Displacement of the furthest atom of a start, length."""
    largest = np.abs(np.asarray(first_state(simulation).state.x)).max()
    return NOISE * float(np.spacing(np.float32(largest)))


def starts(simulation: Simulation, count: int, seed: int, start: Start | None = None) -> list[Start]:
    """Starts of an ensemble: the simulation's own, each with other noise."""
    programs = MdProgram(simulation, start).nudged(noise_size(simulation), count, seed)
    return [program.start for program in programs]


class Member:
    """One run, taken from one step to a later one.

    The start is carried along with the capacity of the list, so that every member uses one compiled program.
    """

    def __init__(self, simulation: Simulation, start: Start):
        self.simulation = simulation
        self.at = start

    def to(self, step: int) -> Segment | None:
        """The segment that ends with a step; None where the run blew up before."""
        engine = Engine(self.simulation, step, start=self.at, record=False)
        segment = None
        for segment in engine.segments():
            if segment.closes in FAILURES:
                return None
        assert segment is not None
        self.at = resume_point(segment)
        return segment


def ensemble(
    simulation: Simulation,
    begin: Sequence[Start],
    windows: Sequence[int],
    ruler: Ruler,
    note: Callable[[], None] | None = None,
) -> Float[np.ndarray, "windows runs features"]:
    """Features of every run at every window; not a number from where a run blew up.

    Args:
        simulation: the program.
        begin: a start for each run.
        windows: steps, ascending.
        ruler: of the comparison.
        note: called after each run.
    """
    out = np.full((len(windows), len(begin), len(ruler.names)), np.nan)
    slots = 0
    for run, start in enumerate(begin):
        member = Member(simulation, replace(start, slots=max(start.slots, slots)))
        for w, window in enumerate(windows):
            segment = member.to(window)
            if segment is None:
                break
            slots = segment.table.slots
            out[w, run] = measure(simulation, segment, ruler)
        if note is not None:
            note()
    return out


def parting(simulation: Simulation, start: Start | None, apart: float, seed: int) -> int | None:
    """The step at which two members of an ensemble are a given length apart.

    None where they are not within 20,000 steps, or blow up.
    """
    pair = [Member(simulation, one) for one in starts(simulation, 2, seed, start)]
    for step in range(_GLANCE, _LONGEST + 1, _GLANCE):
        segments = [member.to(step) for member in pair]
        if any(segment is None for segment in segments):
            return None
        a, b = (np.asarray(segment.state.x, np.float64) for segment in segments if segment is not None)
        d = simulation.cell.minimum_image(*(a - b))
        if float(np.sqrt(sum(np.asarray(c) ** 2 for c in d)).max()) > apart:
            return step
    return None
