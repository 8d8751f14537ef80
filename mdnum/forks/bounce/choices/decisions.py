"""One decision taken otherwise: a contact a step earlier or later, a solver that goes on once more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdnum.ball.rollout import BallRun
from mdnum.errors import InputError
from mdnum.forks.bounce.choices.base import check, program
from mdnum.forks.bounce.twin import BallTwin, Pin
from mdnum.systems.ball_system import BallSystem


@dataclass(frozen=True)
class ContactStep:
    """One contact of one ball begins a step earlier or later; everything else is decided as ever.

    Attributes:
        shift: -1 for a step earlier, 1 for a step later.
        number: which of all contacts that begin in the run, from 1.
    """

    shift: int = -1
    number: int = 1

    def __post_init__(self):
        if self.shift not in (-1, 1):
            raise InputError(f"a shift of {self.shift} steps", where="contact", remedy="Give -1 or 1")
        if self.number < 1:
            raise InputError(f"contact {self.number}; they count from 1", where=self.name)

    @property
    def name(self) -> str:
        """Such as "contact=earlier" or "contact=later:2"."""
        base = f"contact={self._word}"
        return base if self.number == 1 else f"{base}:{self.number}"

    @property
    def _word(self) -> str:
        return "earlier" if self.shift < 0 else "later"

    @property
    def about(self) -> str:
        """One line."""
        which = "the first contact" if self.number == 1 else f"contact {self.number}"
        return f"{which} one step {self._word}, everything else as it comes"

    @property
    def must_hold(self) -> bool:
        """A planted flip is a fork."""
        return False

    def why_not(self, system: BallSystem) -> str | None:
        """There may be no such contact, or no step before it."""
        found = self._find(program(system).run())
        return found if isinstance(found, str) else None

    def _find(self, run: BallRun) -> tuple[int, int] | str:
        """Step and ball of the contact; why there is none."""
        begins = np.flatnonzero(run.contacts.entered)
        if len(begins) < self.number:
            return f"{len(begins)} contacts begin in {run.steps} steps"
        row = begins[self.number - 1]
        step, ball = int(run.contacts.step[row]), int(run.contacts.subject[row, 0])
        if self.shift < 0 and step == 1:
            return f"that contact of ball {ball} begins at the first step"
        return step, ball

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and made to touch a step earlier, or not to touch a step longer."""
        a = program(system)
        found = self._find(a.run())
        if isinstance(found, str):
            check(self, system)
            raise TypeError("a contact that is not there was not refused")
        step, ball = found
        pin = Pin("contact", step - 1, ball, 1) if self.shift < 0 else Pin("contact", step, ball, 0)
        words = f"the contact of ball {ball} at step {step} begins a step {self._word}"
        return BallTwin(a, a, words, pins=(pin,))


@dataclass(frozen=True)
class Inverted:
    """One contact decision taken the other way.

    Attributes:
        step: of it, from 1.
        ball: whose.
    """

    step: int
    ball: int = 0

    @property
    def name(self) -> str:
        """Such as "contact=57:0"."""
        return f"contact={self.step}:{self.ball}"

    @property
    def about(self) -> str:
        """One line."""
        return f"the contact decision of ball {self.ball} at step {self.step} taken the other way"

    @property
    def must_hold(self) -> bool:
        """A planted flip is a fork."""
        return False

    def why_not(self, system: BallSystem) -> str | None:
        """There may be no such step or ball."""
        steps = system.spec.integrator.steps
        if not 1 <= self.step <= steps:
            return f"there is no step {self.step} from 1 to {steps}"
        if not 0 <= self.ball < system.balls:
            return f"there is no ball {self.ball} among {system.balls}"
        return None

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and with the decision inverted."""
        check(self, system)
        a = program(system)
        touches = bool(a.run().contact[self.step - 1, self.ball])
        words = f"ball {self.ball} made {'not ' if touches else ''}to touch at step {self.step}"
        return BallTwin(a, a, words, pins=(Pin("contact", self.step, self.ball, int(not touches)),))


@dataclass(frozen=True)
class Iterations:
    """One solve goes on for more iterations, or for fewer, than its rule says.

    Attributes:
        more: how many, with sign.
        step: of the solve; None for the first that iterates.
        ball: whose, where each ball has a solve of its own; None for the first that iterates.
    """

    more: int = 1
    step: int | None = None
    ball: int | None = None

    def __post_init__(self):
        if self.more == 0:
            raise InputError("0 iterations more change nothing", where="iterations", remedy="Write +1 or -1")

    @property
    def name(self) -> str:
        """Such as "iterations=+1" or "iterations=-1:57"."""
        parts = (f"iterations={self.more:+d}", self.step, self.ball)
        return ":".join(str(part) for part in parts if part is not None)

    @property
    def about(self) -> str:
        """One line."""
        which = "the first solve" if self.step is None else f"the solve of step {self.step}"
        noun = "iteration" if abs(self.more) == 1 else "iterations"
        return f"{which} makes {abs(self.more)} {noun} {'more' if self.more > 0 else 'fewer'}"

    @property
    def must_hold(self) -> bool:
        """A planted flip is a fork."""
        return False

    def why_not(self, system: BallSystem) -> str | None:
        """There must be a solve that iterates."""
        if system.spec.stop is None:
            return "its steps solve nothing, so there is no iteration to add"
        steps = system.spec.integrator.steps
        if self.step is not None and not 1 <= self.step <= steps:
            return f"there is no step {self.step} from 1 to {steps}"
        if self.ball is not None and not 0 <= self.ball < system.balls:
            return f"there is no ball {self.ball} among {system.balls}"
        found = self._find(program(system).run())
        return found if isinstance(found, str) else None

    def _find(self, run: BallRun) -> Pin | str:
        """The count that the solve is made to have; why there is none."""
        counts = run.iterations
        if counts.ndim == 1 and self.ball is not None:
            return "one rule stops the solver for all balls"
        busy = counts if counts.ndim == 2 else counts[:, None]
        if self.step is None:
            rows = np.flatnonzero((busy > 0).any(axis=1))
            if not len(rows):
                return f"no solve iterates in {run.steps} steps"
            row = int(rows[0])
        else:
            row = self.step - 1
        ball = int((busy[row] > 0).argmax()) if self.ball is None else self.ball
        count = int(busy[row, ball if counts.ndim == 2 else 0]) + self.more
        if count < 0:
            return f"the solve of step {row + 1} makes {count - self.more} iterations"
        return Pin("stop", row + 1, ball if counts.ndim == 2 else -1, count)

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and made to go on, or to stop, at another iteration of one solve."""
        check(self, system)
        a = program(system)
        pin = self._find(a.run())
        assert isinstance(pin, Pin)
        whose = "" if pin.ball < 0 else f" of ball {pin.ball}"
        count = f"{pin.value} iterations, not {pin.value - self.more}"
        words = f"the solve{whose} at step {pin.step} makes {count}"
        return BallTwin(a, a, words, pins=(pin,))
