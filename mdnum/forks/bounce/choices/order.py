"""The order of the balls in their batch: something that only a sum over them can hear of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.bounce.choices.base import ORDERLESS, check, program, sums, varied
from mdnum.forks.bounce.pair import reordered
from mdnum.forks.bounce.twin import BallTwin
from mdnum.systems import ball
from mdnum.systems.ball_system import BallSystem

#: What both runs may be given so that the order cannot be heard: an exact sum, or no sum at all.
BOTH = ("exact", "alone")


@dataclass(frozen=True)
class BatchOrder:
    """The same balls in another order.

    Attributes:
        seed: of the permutation.
        both: "exact": both runs sum residuals exactly; "alone": both stop each ball by itself; None: as the
            system does.
    """

    seed: int = 1
    both: str | None = None

    def __post_init__(self):
        if self.both is not None and self.both not in BOTH:
            raise InputError(
                f"@{self.both} says nothing here", where="order", remedy="Write order@exact or order@alone"
            )
        if self.seed < 0:
            raise InputError(f"seed {self.seed} is negative", where="order")

    @property
    def name(self) -> str:
        """Such as "order", "order=3" or "order@alone"."""
        base = "order" if self.seed == 1 else f"order={self.seed}"
        return base if self.both is None else f"{base}@{self.both}"

    @property
    def about(self) -> str:
        """One line."""
        how = {
            None: "",
            "exact": ", both runs with exact sums of residuals",
            "alone": ", each ball stopped by itself in both runs",
        }[self.both]
        return f"the balls of the batch in another order{how}"

    @property
    def must_hold(self) -> bool:
        """Balls that hear nothing of each other cannot tell in which order they are."""
        return self.both is not None

    def why_not(self, system: BallSystem) -> str | None:
        """One ball has one order; without a sum the order must hold, and with one it need not."""
        if system.balls == 1:
            return "there is one ball"
        summed = sums(system.spec)
        if self.both == "alone":
            return _not_alone(system.spec)
        if summed is not None:
            return f"{summed}: order@alone must hold" if self.both is None else summed
        if self.both is None and system.spec.precision.reduction.partition(":")[0] in ORDERLESS:
            return f"sums are {system.spec.precision.reduction}, which have no order: order@exact must hold"
        return None

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and with its balls in another order."""
        check(self, system)
        words = "the balls in another order"
        if self.both == "exact" and system.spec.precision.reduction != "exact":
            system = varied(system, {"precision.reduction": "exact"}, self.name)
            words += " (both with exact sums)"
        elif self.both == "alone" and isinstance(system.spec.stop, ball.SumRule | ball.MaximumRule):
            system = varied(system, {"stop.rule": "per-instance"}, self.name)
            words += " (both with each ball stopped by itself)"
        a = program(system)
        count = system.balls
        rng = np.random.default_rng(self.seed)
        order = rng.permutation(count)
        while np.array_equal(order, np.arange(count)):
            order = rng.permutation(count)
        turned = tuple(int(one) for one in order)
        return BallTwin(a, reordered(a, turned), words, order=turned)


def _not_alone(spec: ball.BallSpec) -> str | None:
    if isinstance(spec.stop, ball.RelativeRule):
        return "its tolerance is a share of the first residual of all balls"
    return None
