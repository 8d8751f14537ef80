"""Runs of one system along one number, each made once."""

from __future__ import annotations

from dataclasses import dataclass

from mdnum.forks.dials import Dial
from mdnum.forks.histories import History, Look, Loss, history, look
from mdnum.precision.ulp import neighbor
from mdnum.systems.build import Simulation


@dataclass(frozen=True)
class Point:
    """What is remembered of a run: a digest of its decisions, loss and energy at its last step, a failure.

    Loss and energy of a run that failed are NaN.
    """

    digest: str
    loss: float
    energy: float
    failed: str


class Line:
    """Runs of one system along one number, addressed by the ordinal of a float."""

    def __init__(self, simulation: Simulation, one: Dial, steps: int, loss: Loss):
        self.simulation, self.dial, self.steps, self.loss = simulation, one, steps, loss
        self.known: dict[int, Point] = {}

    def value(self, place: int) -> float:
        """The float of an ordinal."""
        return float(neighbor(0.0, place))

    def at(self, place: int) -> Simulation:
        """The simulation at a float."""
        return self.dial.turn(self.simulation, self.value(place))

    def run(self, place: int) -> History:
        """The run at a float; what it decided is remembered."""
        simulation = self.at(place)
        made = history(simulation, self.steps)
        # a run that failed has no last step for a loss to be of
        loss = float("nan") if made.failed else float(self.loss(simulation, made.x, made.v))
        energy = float("nan") if made.failed else made.energy
        self.known[place] = Point(made.digest, loss, energy, made.failed)
        return made

    def digest(self, place: int) -> str:
        """What the run at a float decided."""
        if place not in self.known:
            self.run(place)
        return self.known[place].digest

    def look(self, place: int, step: int) -> Look:
        """One step of the run at a float."""
        return look(self.at(place), self.steps, step)
