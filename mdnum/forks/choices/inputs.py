"""Choices of the input: a number of the file, a coordinate of the start, the noise, an energy's constant."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.choices.base import (
    Choice,
    built,
    choice,
    is_langevin,
    number,
    simulations,
    some_ulps,
    world_of,
)
from mdnum.forks.worlds import as_used, floats, not_possible, program_of, twin, varied
from mdnum.numerics.rounding import neighbor
from mdnum.program import Twin
from mdnum.systems import System
from mdnum.systems.ball import FixedRule

#: Numbers that ship as choices, whether a system has them or not.
OFTEN = {
    "md": (
        "cutoff.radius", "cutoff.in_sigma", "dynamics.timestep", "dynamics.temperature", "potential.sigma",
        "potential.epsilon",
    ),
    "ball": (
        "contact.k", "contact.damping", "contact.eps", "contact.alpha", "contact.restitution",
        "contact.rest_speed", "contact.hysteresis", "stop.tol", "stop.enter", "integrator.timestep",
        "flight.gravity",
    ),
}  # fmt: skip
#: So close to a face of the box, as a share of it, an ulp could take an atom across.
_NEAR = 1e-6


@choice("ulps")
class Ulps(Choice):
    """A number of the system file, moved to a float near it in the format that it is used in.

    The temperature of a run at constant energy is that of its drawn velocities: both runs draw theirs.

    Attributes:
        key: dotted, such as "cutoff.radius", "potential.pairs.A-B.sigma" or "stop.tol".
        ulps: how many floats away, with sign.
    """

    key: str
    ulps: int = 1

    def __post_init__(self):
        some_ulps(self.ulps, self.name)

    @property
    def argument(self) -> str:
        return f"{self.key}:{self.ulps:+d}"

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        if not argument:
            raise InputError("no number is named", where="ulps", remedy="Write such as ulps=cutoff.radius:+1")
        key, _, count = argument.partition(":")
        return cls(key, number(count, int, "ulps") if count else 1)

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls(key) for key in OFTEN[world]]

    def describe(self, world: str = "md") -> str:
        return f"{self.key} by {self.ulps:+d} ulp{'s' if abs(self.ulps) > 1 else ''}"

    def reason_unavailable(self, system: Any) -> str | None:
        numbers = floats(system)
        if self.key not in numbers:
            # one that somebody wrote may be a slip of the pen
            known = "" if self.key in OFTEN[world_of(system)] else f"; there are {', '.join(numbers)}"
            return f"it has no number {self.key}{known}"
        if numbers[self.key] == 0:
            return f"{self.key} is 0, and the next float is nothing beside any other number"
        if world_of(system) == "md":
            return None
        return not_possible(system, {self.key: self._moved(system)[1]}, self.name)

    def _moved(self, system: Any) -> tuple[float, float]:
        """The number as the program has it, and its neighbor."""
        before, dtype = as_used(system, self.key)
        return before, float(neighbor(before, self.ulps, np.dtype(dtype)))

    def make(self, system: Any) -> Twin:
        before, after = self._moved(system)
        difference = f"{self.key} = {after!r}, not {before!r}"
        if self.key == "dynamics.temperature" and not is_langevin(system) and system.velocities is not None:
            system = _drawn(system)
            difference += " (both with drawn velocities)"
        return twin(system, {self.key: after}, self.name, difference)


def _drawn(system: System) -> System:
    """The system without the velocities of its structure."""
    atoms = system.atoms.copy()
    del atoms.arrays["momenta"]
    structure = system.spec.structure.model_copy(update={"velocities": "drawn"})
    return replace(system, spec=system.spec.model_copy(update={"structure": structure}), atoms=atoms)


@choice("start")
class StartUlp(Choice):
    """One coordinate of the start, moved to a float near it.

    Attributes:
        which: the atom or the ball; None for that of the largest value. An ulp of a small coordinate would be
            lost in the first addition.
        what: 0, 1 or 2 for the axis of an atom's position, "height" or "velocity" of a ball; None for the
            largest coordinate, or the height.
        ulps: how many floats of the state's dtype away, with sign.
    """

    which: int | None = None
    what: int | str | None = None
    ulps: int = 1

    def __post_init__(self):
        if self.what not in (None, 0, 1, 2, "height", "velocity"):
            known = "0, 1 or 2 of an atom, height or velocity of a ball"
            raise InputError(f"coordinate {self.what!r}; expected {known}", where="start")
        some_ulps(self.ulps, "start")

    @property
    def argument(self) -> str:
        parts = [str(part) for part in (self.which, self.what) if part is not None]
        return "" if self == StartUlp() else ":".join([*parts, f"{self.ulps:+d}"])

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        if not argument:
            return cls()
        parts = argument.split(":")
        which = None if parts[0] in ("height", "velocity") else number(parts.pop(0), int, "start")
        what = parts.pop(0) if parts else "height"
        count = number(parts.pop(0), int, "start") if parts else 1
        if parts:
            raise InputError(f"{argument!r} is not which:what:ulps", where="start", remedy="start=17:0:+1")
        if what not in ("height", "velocity"):
            what = number(what, int, "start")
        return cls(which, what, count)

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls()] if world == "md" else [cls(), cls(what="velocity")]

    def describe(self, world: str = "md") -> str:
        if world == "md":
            return f"one coordinate of the start by {self.ulps:+d} ulp"
        which = "one ball" if self.which is None else f"ball {self.which}"
        return f"{self.what or 'height'} of {which} at the start by {self.ulps:+d} ulp"

    def reason_unavailable(self, system: Any) -> str | None:
        world = world_of(system)
        count = len(system.atoms) if world == "md" else system.balls
        if self.which is not None and not 0 <= self.which < count:
            return f"there is no {'atom' if world == 'md' else 'ball'} {self.which} among {count}"
        if isinstance(self.what, str) is (world == "md") and self.what is not None:
            return f"there is no coordinate {self.what}"
        if world == "ball":
            values, which = self._of_balls(program_of(system))
            if values[which] == 0:
                what = self.what or "height"
                return f"the {what} is 0, and the next float is nothing beside any other number"
        return None

    def make(self, system: Any) -> Twin:
        return self._make_md(system) if world_of(system) == "md" else self._make_ball(system)

    def _make_md(self, system: System) -> Twin:
        from mdnum.md.cell import wrap_positions

        a = built(system)
        dtype = a.policy.dtype("state")
        x = wrap_positions(a.cell, a.positions)[0].astype(dtype)
        if self.which is None:
            fraction = x.astype(np.float64) @ np.asarray(a.cell.inverse)
            # an ulp must not carry it over a face
            inside = np.all(fraction < 1 - _NEAR, axis=1)
            size = np.abs(x) * inside[:, None]
            atom, axis = (int(k) for k in np.unravel_index(size.argmax(), x.shape))
        else:
            atom, axis = self.which, int(self.what or 0)
        before = x[atom, axis]
        x[atom, axis] = neighbor(before, self.ulps, dtype)
        moved = float(x[atom, axis] - before)
        difference = f"{'xyz'[axis]} of atom {atom} by {self.ulps:+d} ulp, {moved:.2g}"
        return simulations(a, replace(a, positions=x.astype(np.float64)), difference)

    def _of_balls(self, program: Any) -> tuple[np.ndarray, int]:
        """The coordinates of the balls, and which of them is moved."""
        problem = program.problem
        value = problem.v0 if self.what == "velocity" else problem.y0
        dtype = problem.world.policy.dtype("state")
        values = np.broadcast_to(np.asarray(value), np.shape(problem.y0)).astype(dtype)
        return values, int(np.abs(values).argmax()) if self.which is None else self.which

    def _make_ball(self, system: Any) -> Twin:
        a: Any = program_of(system)
        values, which = self._of_balls(a)
        before = values[which]
        values[which] = neighbor(before, self.ulps, values.dtype)
        moved = float(values[which]) - float(before)
        difference = f"{self.what or 'height'} of ball {which} by {self.ulps:+d} ulp, {moved:.2g}"
        start = {"v0" if self.what == "velocity" else "y0": values.astype(np.float64)}
        return Twin(a, replace(a, problem=replace(a.problem, **start)), difference)


@choice("noise")
class NoiseChoice(Choice):
    """Another key of the thermostat's noise.

    Attributes:
        seed: of the key; None for the next after the system's own.
    """

    worlds = ("md",)
    seed: int | None = None

    def __post_init__(self):
        if self.seed is not None and self.seed < 0:
            raise InputError(f"seed {self.seed} is negative", where="noise")

    def reason_unavailable(self, system: System) -> str | None:
        if not is_langevin(system):
            return "there is no noise at constant energy (dynamics.kind is nve)"
        if self.seed == system.spec.dynamics.seed:
            return f"the seed is {self.seed} already"
        return None

    def make(self, system: System) -> Twin:
        import equinox as eqx
        import jax

        a = built(system)
        own = system.spec.dynamics.seed
        seed = own + 1 if self.seed is None else self.seed
        integrator = eqx.tree_at(lambda one: one.key, a.integrator, jax.random.key(seed))
        return simulations(a, replace(a, integrator=integrator), f"noise of seed {seed}, not {own}")


@choice("max_iter")
class Cap(Choice):
    """More iterations before the solver gives up, or of a fixed number of them.

    Attributes:
        more: how many, with sign.
    """

    worlds = ("ball",)
    more: int = 1

    def __post_init__(self):
        some_ulps(self.more, self.name)

    @property
    def argument(self) -> str:
        return f"{self.more:+d}"

    def describe(self, world: str = "ball") -> str:
        return f"{self.more:+d} iteration{'s' if abs(self.more) > 1 else ''} at most, or of a fixed number"

    def _key(self, system: Any) -> tuple[str, int]:
        stop = system.spec.stop
        if isinstance(stop, FixedRule):
            return "stop.count", stop.count
        return "stop.max_iter", stop.max_iter

    def reason_unavailable(self, system: Any) -> str | None:
        if system.spec.stop is None:
            return "its steps solve nothing, so there is no iteration to add"
        key, value = self._key(system)
        return not_possible(system, {key: value + self.more}, self.name)

    def make(self, system: Any) -> Twin:
        key, value = self._key(system)
        return twin(system, {key: value + self.more}, self.name, f"{key} = {value + self.more}, not {value}")


@choice("energy-shift")
class EnergyShift(Choice):
    """Pair energies shifted to zero at the cutoff, or not.

    The two differ in the energy they conserve, and in nothing that moves: a constant has no derivative.
    """

    worlds = ("md",)
    must_hold = True

    def reason_unavailable(self, system: System) -> str | None:
        cutoff = system.spec.cutoff
        if cutoff is None:
            return "the potential carries its own cutoff"
        if cutoff.kind not in ("hard", "shifted"):
            return f"a {cutoff.kind} cutoff changes the force too"
        return None

    def make(self, system: System) -> Twin:
        assert system.spec.cutoff is not None
        kind = system.spec.cutoff.kind
        other = "shifted" if kind == "hard" else "hard"
        b = built(varied(system, {"cutoff.kind": other}))
        return simulations(built(system), b, f"cutoff {other}, not {kind}: the same forces")
