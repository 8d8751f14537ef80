"""Numerical choices for a ball only: the stopping rule, and single inverted decisions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mdnum.ball.program import ImposedDecision
from mdnum.forks.choices.base import Choice, applies, check, choice, number, plural, some
from mdnum.forks.worlds import program_of, twin
from mdnum.program import Twin
from mdnum.systems import BallSystem
from mdnum.systems.ball import FixedRule, RelativeRule

#: Stopping rules whose tolerance is a length in meters.
RULES = {
    "sum": "the sum of the residuals of all balls",
    "per-instance": "each ball's own residual",
    "maximum": "the largest residual of the batch",
}


@choice("stop")
class Stopping(Choice):
    """Another stopping rule of the iterative solver, with the same tolerance."""

    worlds = ("ball",)
    screened = " ".join(f"stop={rule}" for rule in RULES)
    shown = True
    rule: str = "per-instance"  # "sum", "per-instance" or "maximum"

    def __post_init__(self):
        check(self.rule in RULES, f"no rule {self.rule!r}; there are {', '.join(RULES)}", "stop")

    def describe(self, world: str = "ball") -> str:
        return f"the solver is stopped by {RULES[self.rule]}"

    def make(self, system: Any) -> Twin:
        stop = system.spec.stop
        applies(stop is not None, "its steps use no solver, so there is no stopping rule")
        reason = "its solver makes a fixed number of iterations and has no tolerance"
        applies(not isinstance(stop, FixedRule), reason)
        reason = "its tolerance is a share of the first residual and not a height"
        applies(not isinstance(stop, RelativeRule), reason)
        applies(stop.rule != self.rule, f"the rule is {self.rule} already")
        difference = f"stopped by the rule {self.rule}, not {stop.rule}"
        return twin(system, {"stop.rule": self.rule}, self.name, difference)


@choice("max_iter")
class Cap(Choice):
    """More iterations before the solver gives up, or a larger fixed number of iterations."""

    worlds = ("ball",)
    shown = True
    more: int = 1  # how many, with sign

    def __post_init__(self):
        some(self.more, self.name)

    def describe(self, world: str = "ball") -> str:
        return f"{self.more:+d} {plural(self.more, 'iteration')} at most, or of a fixed number"

    def make(self, system: Any) -> Twin:
        stop = system.spec.stop
        applies(stop is not None, "its steps use no solver, so there is no iteration to add")
        word = "count" if isinstance(stop, FixedRule) else "max_iter"
        key, value = f"stop.{word}", getattr(stop, word)
        after = value + self.more
        return twin(system, {key: after}, self.name, f"{key} = {after}, not {value}")


# --- one decision taken otherwise ---------------------------------------------------------------------


def _imposed(program: Any, pin: ImposedDecision, difference: str) -> Twin:
    return Twin(program, replace(program, pins=(pin,)), difference)


def _check_place(system: BallSystem, step: int | None, ball: int | None) -> None:
    steps = system.spec.integrator.steps
    applies(step is None or 1 <= step <= steps, f"there is no step {step} from 1 to {steps}")
    applies(ball is None or 0 <= ball < system.balls, f"there is no ball {ball} among {system.balls}")


@choice("contact")
class ContactStep(Choice):
    """One inverted contact decision of one ball."""

    worlds = ("ball",)
    screened = "contact=earlier contact=later"
    shown = True
    # "earlier" or "later": a contact begins a step earlier or later; or the step, from 1, of the decision
    # that is inverted
    at: int | str = "earlier"
    # of all contacts that begin in the run, from 1, the first where None; or whose decision it is
    which: int | None = None

    def __post_init__(self):
        counted = isinstance(self.at, int) or self.which is None or self.which >= 1
        check(counted, f"contact {self.which}; they count from 1", self.name)

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        first, _, second = (argument or "earlier").partition(":")
        which = number(second, int, "contact") if second else None
        if first in ("earlier", "later"):
            return cls(first, None if which == 1 else which)
        return cls(number(first, int, "contact"), which or 0)

    def describe(self, world: str = "ball") -> str:
        if isinstance(self.at, int):
            return f"the contact decision of ball {self.which} at step {self.at} taken the other way"
        which = "the first contact" if self.which is None else f"contact {self.which}"
        return f"{which} one step {self.at}, everything else as it comes"

    def make(self, system: BallSystem) -> Twin:
        program: Any = program_of(system)
        if isinstance(self.at, int):
            step, ball = self.at, self.which or 0
            _check_place(system, step, ball)
            touches = bool(program.run(program.steps).contact[step - 1, ball])
            difference = f"ball {ball} made {'not ' if touches else ''}to touch at step {step}"
            return _imposed(program, ImposedDecision("contact", step, ball, int(not touches)), difference)
        run = program.run(program.steps)
        begins, place = np.flatnonzero(run.contacts.entered), (self.which or 1) - 1
        applies(len(begins) > place, f"{len(begins)} contacts begin in {run.steps} steps")
        row, earlier = begins[place], self.at == "earlier"
        step, ball = int(run.contacts.step[row]), int(run.contacts.subject[row, 0])
        applies(not (earlier and step == 1), f"ball {ball} has this contact from the first step on")
        pin = ImposedDecision("contact", step - earlier, ball, int(earlier))
        return _imposed(program, pin, f"the contact of ball {ball} at step {step} begins a step {self.at}")


@choice("iterations")
class Iterations(Choice):
    """One call of the solver that makes more or fewer iterations than its stopping rule requires."""

    worlds = ("ball",)
    shown = True
    more: int = 1  # how many, with sign
    step: int | None = None  # of the solve; None for the first that iterates
    ball: int | None = None  # whose, where each ball has a solve of its own; None for the first that iterates

    def __post_init__(self):
        some(self.more, "iterations")

    def describe(self, world: str = "ball") -> str:
        which = "the first solve" if self.step is None else f"the solve of step {self.step}"
        count = f"{abs(self.more)} {plural(self.more, 'iteration')}"
        return f"{which} makes {count} {'more' if self.more > 0 else 'fewer'}"

    def make(self, system: BallSystem) -> Twin:
        applies(system.spec.stop is not None, "its steps use no solver, so there is no iteration to add")
        _check_place(system, self.step, self.ball)
        program: Any = program_of(system)
        counts = program.run(program.steps).iterations
        each = counts.ndim == 2
        applies(each or self.ball is None, "one rule stops the solver for all balls")
        busy = counts if each else counts[:, None]
        rows = np.flatnonzero((busy > 0).any(axis=1)) if self.step is None else np.array([self.step - 1])
        applies(len(rows) > 0, f"no solve iterates in {len(counts)} steps")
        row = int(rows[0])
        ball = int((busy[row] > 0).argmax()) if self.ball is None else self.ball
        count = int(busy[row, ball])
        after = count + self.more
        applies(after >= 0, f"the solve of step {row + 1} makes {count} iterations")
        whose = f" of ball {ball}" if each else ""
        pin = ImposedDecision("stop", row + 1, ball if each else -1, after)
        difference = f"the solve{whose} at step {row + 1} makes {after} iterations, not {count}"
        return _imposed(program, pin, difference)
