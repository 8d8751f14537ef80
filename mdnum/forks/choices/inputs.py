"""Choices of the input: a number of the file by an ulp, a coordinate by an ulp, another noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from mdnum.errors import InputError
from mdnum.forks.choices.base import check, is_langevin, varied
from mdnum.forks.twin import Twin
from mdnum.md.cell import wrap_positions
from mdnum.md.integrators import Langevin
from mdnum.precision.ulp import neighbor
from mdnum.systems.build import build
from mdnum.systems.load import System

#: So close to a face of the box, as a share of it, an ulp could take an atom across.
_NEAR = 1e-6


@dataclass(frozen=True)
class Ulps:
    """A number of the system file, moved to a float near it.

    The temperature of a run at constant energy is that of its drawn velocities: both runs draw theirs.

    Attributes:
        key: dotted, such as "cutoff.radius" or "potential.pairs.A-B.sigma".
        ulps: how many floats away, with sign.
    """

    key: str
    ulps: int = 1

    def __post_init__(self):
        if self.ulps == 0:
            raise InputError("0 ulps change nothing", where=self.name, remedy="Write +1 or -1")

    @property
    def name(self) -> str:
        """Such as "ulps=cutoff.radius:+1"."""
        return f"ulps={self.key}:{self.ulps:+d}"

    @property
    def about(self) -> str:
        """One line."""
        return f"{self.key} by {self.ulps:+d} ulp{'s' if abs(self.ulps) > 1 else ''}"

    @property
    def must_hold(self) -> bool:
        """Another number is another model."""
        return False

    def why_not(self, system: System) -> str | None:
        """The file may have no such number."""
        numbers = dict(float_keys(system))
        if self.key not in numbers:
            return f"it has no number {self.key}; there are {', '.join(numbers)}"
        if numbers[self.key] == 0:
            return f"{self.key} is 0, and the next float is nothing beside any other number"
        return None

    def make(self, system: System) -> Twin:
        """The system, and with the number's neighbor."""
        check(self, system)
        before = dict(float_keys(system))[self.key]
        after = float(neighbor(before, self.ulps))
        words = f"{self.key} = {after!r}, not {before!r}"
        if self.key == "dynamics.temperature" and not is_langevin(system) and system.velocities is not None:
            system = _drawn(system)
            words += " (both with drawn velocities)"
        return Twin(build(system), build(varied(system, {self.key: after})), words)


def float_keys(system: System) -> Iterator[tuple[str, float]]:
    """The numbers of a system file that are floats, by their dotted keys."""
    # what is asked of a system is no part of it
    yield from _floats((), system.spec.model_dump(mode="python", exclude_none=True, exclude={"fork"}))


def _floats(path: tuple[str, ...], table: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for key, value in table.items():
        if isinstance(value, float):
            yield ".".join((*path, key)), value
        elif isinstance(value, Mapping):
            yield from _floats((*path, key), value)


def _drawn(system: System) -> System:
    """The system without the velocities of its structure."""
    atoms = system.atoms.copy()
    del atoms.arrays["momenta"]
    structure = system.spec.structure.model_copy(update={"velocities": "drawn"})
    return replace(system, spec=system.spec.model_copy(update={"structure": structure}), atoms=atoms)


@dataclass(frozen=True)
class StartUlp:
    """One coordinate of the start, moved to a float near it.

    An ulp of a small coordinate would be lost in the first addition: by default it is the largest one.

    Attributes:
        atom, axis: which coordinate; None for the largest.
        ulps: how many floats of the state's dtype away, with sign.
    """

    atom: int | None = None
    axis: int | None = None
    ulps: int = 1

    def __post_init__(self):
        if self.axis is not None and self.axis not in (0, 1, 2):
            raise InputError(f"axis {self.axis}; expected 0, 1 or 2", where="start")
        if self.ulps == 0:
            raise InputError("0 ulps change nothing", where="start", remedy="Write +1 or -1")

    @property
    def name(self) -> str:
        """Such as "start" or "start=17:0:+1"."""
        return "start" if self.atom is None else f"start={self.atom}:{self.axis}:{self.ulps:+d}"

    @property
    def about(self) -> str:
        """One line."""
        return f"one coordinate of the start by {self.ulps:+d} ulp"

    @property
    def must_hold(self) -> bool:
        """Another start is another trajectory."""
        return False

    def why_not(self, system: System) -> str | None:
        """There may be no such atom."""
        atoms = len(system.atoms)
        if self.atom is not None and not 0 <= self.atom < atoms:
            return f"there is no atom {self.atom} among {atoms}"
        return None

    def make(self, system: System) -> Twin:
        """The system, and with the other coordinate."""
        check(self, system)
        a = build(system)
        dtype = a.policy.dtype("state")
        x = wrap_positions(a.cell, a.positions)[0].astype(dtype)
        if self.atom is None:
            fraction = x.astype(np.float64) @ np.asarray(a.cell.inverse)
            # an ulp must not carry it over a face
            inside = np.all(fraction < 1 - _NEAR, axis=1)
            size = np.abs(x) * inside[:, None]
            atom, axis = (int(k) for k in np.unravel_index(size.argmax(), x.shape))
        else:
            atom, axis = self.atom, self.axis or 0
        before = x[atom, axis]
        x[atom, axis] = neighbor(before, self.ulps, dtype)
        moved = float(x[atom, axis] - before)
        words = f"{'xyz'[axis]} of atom {atom} by {self.ulps:+d} ulp, {moved:.2g}"
        return Twin(a, replace(a, positions=x.astype(np.float64)), words)


@dataclass(frozen=True)
class Noise:
    """Another key of the thermostat's noise.

    Attributes:
        seed: of the key; None for the next after the system's own.
    """

    seed: int | None = None

    def __post_init__(self):
        if self.seed is not None and self.seed < 0:
            raise InputError(f"seed {self.seed} is negative", where="noise")

    @property
    def name(self) -> str:
        """Such as "noise" or "noise=7"."""
        return "noise" if self.seed is None else f"noise={self.seed}"

    @property
    def about(self) -> str:
        """One line."""
        return "another key of the thermostat's noise"

    @property
    def must_hold(self) -> bool:
        """Another noise is another trajectory."""
        return False

    def why_not(self, system: System) -> str | None:
        """Without a thermostat there is no noise."""
        if not is_langevin(system):
            return "there is no noise at constant energy (dynamics.kind is nve)"
        if self.seed == system.spec.dynamics.seed:
            return f"the seed is {self.seed} already"
        return None

    def make(self, system: System) -> Twin:
        """The system, and with the other noise: the start is the same."""
        check(self, system)
        a = build(system)
        assert isinstance(a.integrator, Langevin)
        own = system.spec.dynamics.seed
        seed = own + 1 if self.seed is None else self.seed
        integrator = eqx.tree_at(lambda one: one.key, a.integrator, jax.random.key(seed))
        return Twin(a, replace(a, integrator=integrator), f"noise of seed {seed}, not {own}")
