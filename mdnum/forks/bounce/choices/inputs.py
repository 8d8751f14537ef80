"""Choices of the input: a number of the file by an ulp, a start by an ulp, one more iteration at most."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mdnum.ball.limits import DTYPES, rounded
from mdnum.errors import InputError
from mdnum.forks.bounce.choices.base import check, program, refused, twin
from mdnum.forks.bounce.twin import BallTwin
from mdnum.precision.ulp import neighbor
from mdnum.systems import ball
from mdnum.systems.ball_system import BallSystem

#: Numbers that ship as choices, whether a system has them or not.
OFTEN = (
    "contact.k",
    "contact.damping",
    "contact.eps",
    "contact.alpha",
    "contact.restitution",
    "contact.rest_speed",
    "contact.hysteresis",
    "stop.tol",
    "stop.enter",
    "integrator.timestep",
    "flight.gravity",
)
#: Tables that say nothing about a step.
_ELSEWHERE = ("loss", "gradient", "variants", "precision", "fork")


@dataclass(frozen=True)
class Ulps:
    """A number of the system file, moved to a float near it in the format that it is used in.

    Attributes:
        key: dotted, such as "contact.k" or "stop.tol".
        ulps: how many floats away, with sign.
    """

    key: str
    ulps: int = 1

    def __post_init__(self):
        if self.ulps == 0:
            raise InputError("0 ulps change nothing", where=self.name, remedy="Write +1 or -1")

    @property
    def name(self) -> str:
        """Such as "ulps=contact.k:+1"."""
        return f"ulps={self.key}:{self.ulps:+d}"

    @property
    def about(self) -> str:
        """One line."""
        return f"{self.key} by {self.ulps:+d} ulp{'s' if abs(self.ulps) > 1 else ''}"

    @property
    def must_hold(self) -> bool:
        """Another number is another program."""
        return False

    def why_not(self, system: BallSystem) -> str | None:
        """The file may have no such number, or must not have its neighbor."""
        numbers = dict(float_keys(system))
        if self.key not in numbers:
            # one that somebody wrote may be a slip of the pen
            known = "" if self.key in OFTEN else f"; there are {', '.join(numbers)}"
            return f"it has no number {self.key}{known}"
        if numbers[self.key] == 0:
            return f"{self.key} is 0, and the next float is nothing beside any other number"
        return refused(system, {self.key: self._moved(system)[1]}, self.name)

    def _moved(self, system: BallSystem) -> tuple[float, float]:
        """The number as the program has it, and its neighbor."""
        dtype = dtype_of(self.key, system)
        before = rounded(dict(float_keys(system))[self.key], dtype)
        return before, float(neighbor(before, self.ulps, DTYPES[dtype]))

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and with the number's neighbor."""
        check(self, system)
        before, after = self._moved(system)
        return twin(system, {self.key: after}, self.name, f"{self.key} = {after!r}, not {before!r}")


def float_keys(system: BallSystem) -> Iterator[tuple[str, float]]:
    """The numbers of a system file that are floats and enter a step, by their dotted keys."""
    data = system.spec.model_dump(mode="python", exclude_none=True, exclude=set(_ELSEWHERE))
    if system.spec.start.boundary is not None:
        # the other keys of the table hold their defaults and mean nothing
        del data["start"]
    yield from _floats((), data)


def _floats(path: tuple[str, ...], table: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for key, value in table.items():
        if isinstance(value, float):
            yield ".".join((*path, key)), value
        elif isinstance(value, Mapping):
            yield from _floats((*path, key), value)


def dtype_of(key: str, system: BallSystem) -> str:
    """The format in which a number of the file is used."""
    precision = system.spec.precision
    if key in ("start.height", "start.velocity"):
        return precision.state
    if key.startswith("stop."):
        return precision.decision
    # a spread is laid out, and a control drawn up, in double precision
    return "float64" if key.startswith(("start.", "flight.control.")) else precision.arithmetic


@dataclass(frozen=True)
class StartUlp:
    """Height or velocity of one ball at the start, moved to a float near it.

    Attributes:
        ball: which; None for the highest.
        what: "height" or "velocity".
        ulps: how many floats of the state's dtype away, with sign.
    """

    ball: int | None = None
    what: str = "height"
    ulps: int = 1

    def __post_init__(self):
        if self.what not in ("height", "velocity"):
            raise InputError(f"{self.what!r} is neither height nor velocity", where="start")
        if self.ulps == 0:
            raise InputError("0 ulps change nothing", where="start", remedy="Write +1 or -1")

    @property
    def name(self) -> str:
        """Such as "start", "start=velocity:+1" or "start=3:height:-1"."""
        if self == StartUlp():
            return "start"
        which = "" if self.ball is None else f"{self.ball}:"
        return f"start={which}{self.what}:{self.ulps:+d}"

    @property
    def about(self) -> str:
        """One line."""
        which = "one ball" if self.ball is None else f"ball {self.ball}"
        return f"{self.what} of {which} at the start by {self.ulps:+d} ulp"

    @property
    def must_hold(self) -> bool:
        """Another start is another trajectory."""
        return False

    def why_not(self, system: BallSystem) -> str | None:
        """There may be no such ball, or it starts at 0."""
        if self.ball is not None and not 0 <= self.ball < system.balls:
            return f"there is no ball {self.ball} among {system.balls}"
        values = self._values(program(system))
        if values[self._which(values)] == 0:
            return f"the {self.what} is 0, and the next float is nothing beside any other number"
        return None

    def _values(self, problem: Any) -> np.ndarray:
        dtype = problem.world.policy.dtype("state")
        value = problem.y0 if self.what == "height" else problem.v0
        return np.broadcast_to(np.asarray(value), np.shape(problem.y0)).astype(dtype)

    def _which(self, values: np.ndarray) -> int:
        return int(np.abs(values).argmax()) if self.ball is None else self.ball

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and with the other start."""
        check(self, system)
        a = program(system)
        values = self._values(a)
        one = self._which(values)
        before = values[one]
        values[one] = neighbor(before, self.ulps, values.dtype)
        moved = float(values[one]) - float(before)
        name = "y0" if self.what == "height" else "v0"
        words = f"{self.what} of ball {one} by {self.ulps:+d} ulp, {moved:.2g}"
        return BallTwin(a, replace(a, **{name: values.astype(np.float64)}), words)


@dataclass(frozen=True)
class Cap:
    """More iterations before the solver gives up, or of a fixed number of them.

    Attributes:
        more: how many, with sign.
    """

    more: int = 1

    def __post_init__(self):
        if self.more == 0:
            raise InputError("0 iterations more change nothing", where=self.name, remedy="Write +1 or -1")

    @property
    def name(self) -> str:
        """Such as "max_iter=+1"."""
        return f"max_iter={self.more:+d}"

    @property
    def about(self) -> str:
        """One line."""
        return f"{self.more:+d} iteration{'s' if abs(self.more) > 1 else ''} at most, or of a fixed number"

    @property
    def must_hold(self) -> bool:
        """A solver that gave up goes on."""
        return False

    def _keys(self, system: BallSystem) -> dict[str, int]:
        stop = system.spec.stop
        if isinstance(stop, ball.FixedRule):
            return {"stop.count": stop.count + self.more}
        assert stop is not None
        return {"stop.max_iter": stop.max_iter + self.more}

    def why_not(self, system: BallSystem) -> str | None:
        """There must be a solver."""
        if system.spec.stop is None:
            return "its steps solve nothing, so there is no iteration to add"
        return refused(system, self._keys(system), self.name)

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and with the other cap."""
        check(self, system)
        ((key, value),) = self._keys(system).items()
        return twin(system, {key: value}, self.name, f"{key} = {value}, not {value - self.more}")
