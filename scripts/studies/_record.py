"""A recorded rollout kept in memory: for studies that make many short ones and need no run folder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdnum.md.ledger import FlipTable
from mdnum.rollout import Engine, ListHealth, PairRecorder
from mdnum.systems import Simulation

Columns = dict[str, np.ndarray]

_NUMBERS = ("potential", "kinetic", "heat", "moved")


@dataclass(frozen=True)
class Recorded:
    """What a rollout left behind.

    Attributes:
        time: of each step, user's unit.
        potential: potential energy at each step.
        conserved: total energy at each step, less what a thermostat put in.
        displacement: largest at each step since the list in use was built, length.
        flips: a row per flip.
        health: rebuilds, dangerous builds and lost pairs.
    """

    time: np.ndarray
    potential: np.ndarray
    conserved: np.ndarray
    displacement: np.ndarray
    flips: FlipTable
    health: ListHealth


def record(simulation: Simulation, steps: int) -> Recorded:
    """Roll a simulation out to a last step and keep energies, flips and the health of its lists."""
    recorder, health = PairRecorder(simulation), ListHealth(simulation)
    series: list[Columns] = []
    flips: list[FlipTable] = []
    for segment in Engine(simulation, steps).segments():
        # copied: the engine takes a segment's record back after the next one
        series.append({name: segment.rows_of(name).copy() for name in _NUMBERS})
        flips.append(recorder.flips(segment))
        health.take(segment, recorder.missed)
    numbers = _joined(series)
    return Recorded(
        simulation.timestep * np.arange(len(numbers["potential"])),
        numbers["potential"],
        numbers["potential"] + numbers["kinetic"] - numbers["heat"],
        numbers["moved"],
        FlipTable.concatenate(flips),
        health,
    )


def _joined(parts: list[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
