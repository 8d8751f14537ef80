"""One decision taken otherwise: a contact a step earlier or later, a solver that goes on once more."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from mdnum.ball.program import ImposedDecision
from mdnum.ball.rollout import BallRun
from mdnum.errors import InputError
from mdnum.forks.choices.base import Choice, choice, number, some_ulps
from mdnum.forks.worlds import program_of
from mdnum.program import Twin
from mdnum.systems import BallSystem


def _imposed(program: Any, pin: ImposedDecision, difference: str) -> Twin:
    return Twin(program, replace(program, pins=(pin,)), difference)


def _run(program: Any) -> BallRun:
    return program.run(program.steps)


def _no_subject(system: BallSystem, step: int | None, ball: int | None) -> str | None:
    steps = system.spec.integrator.steps
    if step is not None and not 1 <= step <= steps:
        return f"there is no step {step} from 1 to {steps}"
    if ball is not None and not 0 <= ball < system.balls:
        return f"there is no ball {ball} among {system.balls}"
    return None


@choice("contact")
class ContactStep(Choice):
    """One contact of one ball begins a step earlier or later; everything else is decided as ever.

    Attributes:
        shift: -1 for a step earlier, 1 for a step later.
        number: which of all contacts that begin in the run, from 1.
    """

    worlds = ("ball",)
    shift: int = -1
    number: int = 1

    def __post_init__(self):
        if self.shift not in (-1, 1):
            raise InputError(f"a shift of {self.shift} steps", where="contact", remedy="Give -1 or 1")
        if self.number < 1:
            raise InputError(f"contact {self.number}; they count from 1", where=self.name)

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        first, _, second = (argument or "earlier").partition(":")
        if first in ("earlier", "later"):
            return cls(-1 if first == "earlier" else 1, number(second, int, "contact") if second else 1)
        ball = number(second, int, "contact") if second else 0
        return Inverted(number(first, int, "contact"), ball)

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls(), cls(1)]

    @property
    def argument(self) -> str:
        return self._word if self.number == 1 else f"{self._word}:{self.number}"

    @property
    def _word(self) -> str:
        return "earlier" if self.shift < 0 else "later"

    def describe(self, world: str = "ball") -> str:
        which = "the first contact" if self.number == 1 else f"contact {self.number}"
        return f"{which} one step {self._word}, everything else as it comes"

    def reason_unavailable(self, system: BallSystem) -> str | None:
        found = self._find(_run(program_of(system)))
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

    def make(self, system: BallSystem) -> Twin:
        program = program_of(system)
        found = self._find(_run(program))
        assert not isinstance(found, str)
        step, ball = found
        earlier = self.shift < 0
        pin = ImposedDecision("contact", step - earlier, ball, int(earlier))
        return _imposed(program, pin, f"the contact of ball {ball} at step {step} begins a step {self._word}")


@choice(None)
class Inverted(Choice):
    """One contact decision taken the other way.

    Attributes:
        step: of it, from 1.
        ball: whose.
    """

    family = "contact"
    worlds = ("ball",)
    step: int
    ball: int = 0

    @property
    def argument(self) -> str:
        return f"{self.step}:{self.ball}"

    def describe(self, world: str = "ball") -> str:
        return f"the contact decision of ball {self.ball} at step {self.step} taken the other way"

    def reason_unavailable(self, system: BallSystem) -> str | None:
        return _no_subject(system, self.step, self.ball)

    def make(self, system: BallSystem) -> Twin:
        program = program_of(system)
        touches = bool(_run(program).contact[self.step - 1, self.ball])
        pin = ImposedDecision("contact", self.step, self.ball, int(not touches))
        difference = f"ball {self.ball} made {'not ' if touches else ''}to touch at step {self.step}"
        return _imposed(program, pin, difference)


@choice("iterations")
class Iterations(Choice):
    """One solve goes on for more iterations, or for fewer, than its rule says.

    Attributes:
        more: how many, with sign.
        step: of the solve; None for the first that iterates.
        ball: whose, where each ball has a solve of its own; None for the first that iterates.
    """

    worlds = ("ball",)
    more: int = 1
    step: int | None = None
    ball: int | None = None

    def __post_init__(self):
        some_ulps(self.more, "iterations")

    @property
    def argument(self) -> str:
        parts = (f"{self.more:+d}", self.step, self.ball)
        return ":".join(str(part) for part in parts if part is not None)

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        parts = [number(part, int, "iterations") for part in (argument or "+1").split(":")]
        if len(parts) > 3:
            raise InputError(f"{argument!r} is not more:step:ball", where="iterations")
        return cls(*parts)

    def describe(self, world: str = "ball") -> str:
        which = "the first solve" if self.step is None else f"the solve of step {self.step}"
        noun = "iteration" if abs(self.more) == 1 else "iterations"
        return f"{which} makes {abs(self.more)} {noun} {'more' if self.more > 0 else 'fewer'}"

    def reason_unavailable(self, system: BallSystem) -> str | None:
        if system.spec.stop is None:
            return "its steps solve nothing, so there is no iteration to add"
        if (reason := _no_subject(system, self.step, self.ball)) is not None:
            return reason
        found = self._find(_run(program_of(system)))
        return found if isinstance(found, str) else None

    def _find(self, run: BallRun) -> ImposedDecision | str:
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
        return ImposedDecision("stop", row + 1, ball if counts.ndim == 2 else -1, count)

    def make(self, system: BallSystem) -> Twin:
        program = program_of(system)
        pin = self._find(_run(program))
        assert not isinstance(pin, str)
        whose = "" if pin.ball < 0 else f" of ball {pin.ball}"
        count = f"{pin.value} iterations, not {pin.value - self.more}"
        return _imposed(program, pin, f"the solve{whose} at step {pin.step} makes {count}")
