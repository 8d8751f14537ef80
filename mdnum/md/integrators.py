"""Integrators, and the function that makes a time step.

A step evaluates the forces at x_s. `finish` completes the previous step and gives full-step velocities v_s.
The first half of the next step (`begin`) gives the positions x_{s+1}. The state between steps is (x_{s+1},
half-step velocity, extra). An outdated neighbor list is therefore replaced before forces are evaluated. A
simulation can stop and resume between steps without evaluating forces twice.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import Field, fields
from operator import mul, truediv
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Real

import mdnum.numerics  # noqa: F401 (float64 must be on before the first array exists)
from mdnum.errors import InputError
from mdnum.md.cell import Cell, transformed
from mdnum.registry import Registry
from mdnum.units import Units

Vector = Float[Array, "3 atoms"]
Masses = Float[Array, "atoms"]
Number = Float[Array, ""]
Step = Int[Array, ""]
Order = Int[Array, "atoms"]


def unsorted(a: Real[Any, "*rest atoms"], order: Int[Any, "atoms"]) -> Real[Array, "*rest atoms"]:
    """Convert a per-atom array from sorted order to the order of the input."""
    return jnp.zeros_like(a).at[..., order].set(a)


class ByAtom(NamedTuple):
    """Array in an integrator's extra state, with one entry per atom (last axis)."""

    value: Array


def by_atom(change: Callable[[Array], Array], extra: Any) -> Any:
    """Apply a function to all per-atom arrays of an integrator's extra state."""

    def one(part: Any) -> Any:
        return ByAtom(change(part.value)) if isinstance(part, ByAtom) else part

    return jax.tree.map(one, extra, is_leaf=lambda part: isinstance(part, ByAtom))


#: For each unit: conversion of a number in a file to internal units, the inverse conversion, and the factor
#: of the units.
_INSIDE = {
    "time": (mul, truediv, "time_factor"),
    "rate": (truediv, mul, "time_factor"),
    "temperature": (mul, truediv, "k_B"),
    "pressure": (truediv, mul, "pressure_factor"),
    "compressibility": (mul, truediv, "pressure_factor"),
}


def converted(field: Field[Any], value: Any, units: Units, *, back: bool = False) -> Any:
    """Convert a number from a system file's unit to the internal unit, or back."""
    if (unit := field.metadata.get("unit")) not in _INSIDE:
        return value
    *ways, factor = _INSIDE[unit]
    return ways[back](value, getattr(units, factor))


def quantity(
    unit: Literal["time", "rate", "temperature", "pressure", "compressibility", "seed"], **options: Any
) -> Any:
    """Declare a field of an integrator with a unit in system files.

    In system files, kT has the key `temperature` and the random key has the key `seed`.
    """
    return eqx.field(metadata={"unit": unit}, **options)


class AtStep(NamedTuple):
    """Data of a time step for an integrator, after the force evaluation."""

    acceleration: Vector  # force/mass, in the dtype of the state
    virial: Number  # sum over pairs of r_ij · F_ij, energy, float64
    # sum over pairs of r_ij ⊗ F_ij, shape (3, 3), for an integrator that is `anisotropic`; else None
    tensor: Float[Array, "3 3"] | None
    cell: Cell  # the box, float64
    masses: Masses  # float64
    step: Step
    order: Order  # sorted atom k is atom order[k]; noise belongs to the atom, not to its place


class Integrator(eqx.Module):
    """Base class of integrators, which update positions and velocities between force evaluations.

    All fields except keyword-only fields are keys in a system file. Fields that have a unit are declared by
    `quantity`. Values of static fields are not converted between units.

    Example:
        >>> class NoseHoover(mdnum.Integrator): ...  # examples/thermostat.py is a whole one

    Attributes:
        timestep: internal time.
        constraints: number of degrees of freedom that the starting state removes permanently; set by a
            simulation.
    """

    name: ClassVar[str]
    #: Whether the integrator conserves a total momentum of zero.
    keeps_momentum: ClassVar[bool] = True
    #: Number of steps after which the loop must return its state to the host, if the extra state requires
    #: this.
    pause: ClassVar[Any] = None
    timestep: Float[Array, ""] = quantity("time")
    constraints: int = eqx.field(static=True, kw_only=True, default=0)

    @classmethod
    def keys(cls) -> dict[str, Field[Any]]:
        """Fields of the integrator by their keys in a system file."""
        units = [(one.metadata.get("unit"), one) for one in fields(cls) if not one.kw_only]
        return {unit if unit in ("temperature", "seed") else one.name: one for unit, one in units}

    @classmethod
    def numbers(cls) -> list[str]:
        """Keys of the parameters with respect to which an integrator can be differentiated."""
        return [key for key, one in cls.keys().items() if key != "seed" and not one.metadata.get("static")]

    @classmethod
    def of_file(cls, table: Mapping[str, Any], units: Units) -> Integrator:
        """Make an integrator from the table that describes it in a system file."""
        made = {}
        for key, field in cls.keys().items():
            if (value := table.get(key)) is None:
                continue
            if key in cls.numbers():
                value = jax.device_put(np.float64(converted(field, value, units)))
            made[field.name] = jax.random.key(value) if key == "seed" else value
        return cls(**made)

    @property
    def random(self) -> Any:
        """Random key, as an array; None if there is no noise."""
        field = self.keys().get("seed")
        return None if field is None else getattr(self, field.name)

    @property
    def noise_belongs_to(self) -> tuple[str, ...]:
        """Symmetries ("atoms", "axes") that the noise breaks."""
        return () if self.random is None else ("atoms", "axes")

    def number(self, key: str, units: Units) -> float:
        """Return the value of a field in the units of a system file."""
        field = self.keys()[key]
        return converted(field, float(getattr(self, field.name)), units, back=True)

    def with_number(self, key: str, value: Any, units: Units) -> Integrator:
        """Return a copy of the integrator with another value of a field. Nothing is recompiled."""
        field = self.keys()[key]
        # of a numpy number: a Python one would make another compiled program (a weak type)
        inner = jnp.asarray(np.float64(converted(field, value, units)))
        return eqx.tree_at(lambda one: getattr(one, field.name), self, inner)

    def init(self, x: Vector, v: Vector, masses: Masses) -> Any:
        """Return the initial extra state, a pytree of arrays. Per-atom arrays are `ByAtom`.

        Args:
            x, v: wrapped positions and velocities of step 0, in the order of the user.
        """
        return ()

    @abstractmethod
    def finish(self, v: Vector, extra: Any, at: AtStep, time: Number) -> tuple[Vector, Any]:
        """Complete a step after its force evaluation. Return full-step velocities and extra state.

        Args:
            v, extra: sorted velocities and extra state, as returned by `begin` and `deform`.
            at: data of the present step.
            time: half a time step, in the dtype of v; 0 at step 0, where the velocities are already full-step
                velocities.
        """

    @abstractmethod
    def begin(self, x: Vector, v: Vector, extra: Any, at: AtStep) -> tuple[Vector, Vector, Any, Number]:
        """Begin a step. Return the next positions, velocities and extra state, and the absorbed heat.

        Args:
            x, v: sorted positions and full-step velocities.
        """

    def deform(self, v: Vector, extra: Any, at: AtStep) -> tuple[Float[Array, "3 3"], Vector, Any]:
        """Return the deformation of the box before the next force evaluation. Default: none.

        The method `deform` is called after `begin`. Lattice vectors and positions, as rows, are multiplied by
        the deformation. The method `begin` must move the atoms only relative to the box.

        Args:
            v, extra: sorted velocities and extra state, as returned by `begin`.

        Returns:
            the deformation, shape (3, 3), float64; velocities and extra state.
        """
        return jnp.eye(3), v, extra

    @property
    def moves_cell(self) -> bool:
        """True if the integrator changes the box (`deform`). Otherwise the box is not recorded."""
        return type(self).deform is not Integrator.deform

    def check(self, cell: Cell) -> None:
        """Raise `InputError` for an unsupported box or option. `check` is called once, on the host."""

    def freedom(self, masses: Float[Any, "atoms"]) -> int:
        """Return the number of degrees of freedom: 3 per atom, minus 3 for zero total momentum."""
        return max(3 * masses.shape[0] - self.constraints, 1)

    def kinetic(self, v: Vector, masses: Masses) -> Number:
        """Return the kinetic energy of all atoms."""
        speed2 = jnp.sum(jnp.square(v.astype(jnp.float64)), axis=0)
        return 0.5 * jnp.sum(masses * speed2)

    @property
    def anisotropic(self) -> bool:
        """True if the integrator needs the virial tensor. Force evaluations are then 10 % slower."""
        return False

    @property
    def keeps_angles(self) -> bool:
        """True if `deform` returns only diagonal matrices, so that orthorhombic boxes stay orthorhombic."""
        return False

    def exchanged(self, extra: Any, at: AtStep) -> tuple[Number | float, Number | float]:
        """Return the heat from the thermostat and the work of the box, so far.

        The total energy minus this heat and work, and minus the heat from `begin`, is conserved.
        """
        return 0.0, 0.0


class StepEnd(NamedTuple):
    """Result of a time step, with atoms in the input order."""

    # v, extra: full-step velocities and the extra state with them
    v: Vector
    extra: Any
    # x, kicked, ahead: wrapped positions of the next step, velocities and extra state that lead there
    x: Vector
    kicked: Vector
    ahead: Any
    images: Vector  # lattice vectors that wrapping has just taken off
    heat: Number  # energy taken up on the way
    cell: Cell  # box of the next step
    at: AtStep  # the step itself


def one_step(
    integrator: Integrator,
    cell: Cell,
    masses: Masses,
    order: Order,
    step: Step,
    x: Vector,
    v: Vector,
    extra: Any,
    made: Any,
    *,
    wrap: bool = True,
) -> StepEnd:
    """Make one time step, from the forces to the next positions.

    Args:
        cell: the box, float64. masses: float64. made: the `Forces` at x.
        x, v, extra: wrapped positions, and velocities and extra state as returned by `begin`; at step 0, the
            starting state.
        wrap: True to wrap positions; False for derivatives, for which wrapping is only a translation.
    """
    dtype = x.dtype
    acceleration = made.force.astype(dtype) / masses.astype(dtype)
    at = AtStep(acceleration, made.virial, made.tensor, cell, masses, step, order)
    half = (0.5 * integrator.timestep).astype(dtype)
    # the first step of all starts from full-step velocities
    second_half = jnp.where(step == 0, jnp.zeros((), dtype), half)
    v, extra = integrator.finish(v, extra, at, second_half)
    if integrator.moves_cell:
        # in float64, or a slow strain would be lost when positions are rounded a second time
        after, kicked, ahead, heat = integrator.begin(x.astype(jnp.float64), v, extra, at)
        by, kicked, ahead = integrator.deform(kicked, ahead, at)
        cell, after = cell.deformed(by), transformed(after, by).astype(dtype)
    else:
        after, kicked, ahead, heat = integrator.begin(x, v, extra, at)
    if not wrap:
        return StepEnd(v, extra, after, kicked, ahead, jnp.zeros_like(after), heat, cell, at)
    wrapped, n = cell.astype(dtype).wrap(*after)
    return StepEnd(v, extra, jnp.stack(wrapped), kicked, ahead, jnp.stack(n), heat, cell, at)


class KickDrift(Integrator):
    """Base class of integrators with a kick by the forces and a drift without forces.

    Example:
        >>> isinstance(mdnum.build("argon/langevin-500").integrator, mdnum.KickDrift)
        True

    Raises:
        TypeError: a subclass overrides a method that derivatives of kick and drift would ignore.
    """

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        own = ("kick", "init", "finish", "begin", "deform")
        if other := [name for name in own if getattr(cls, name) is not getattr(KickDrift, name)]:
            raise TypeError(
                f"the class {cls.__name__} overrides {other[0]}; derive the class from Integrator instead"
            )

    def kick(self, v: Vector, time: Number, acceleration: Vector) -> Vector:
        """Return velocities after an acceleration has acted for a given time."""
        return v + time * acceleration

    def finish(self, v, extra, at, time):
        return self.kick(v, time, at.acceleration), extra

    def begin(self, x, v, extra, at):
        v = self.kick(v, (0.5 * self.timestep).astype(v.dtype), at.acceleration)
        x, v, heat = self.drift(x, v, at.masses, at.step, at.order)
        return x, v, extra, heat

    @abstractmethod
    def drift(
        self, x: Vector, v: Vector, masses: Masses, step: Step, order: Order
    ) -> tuple[Vector, Vector, Number]:
        """Advance the state after the kick. The map must be linear in positions and velocities."""


def without_kick(integrator: Integrator) -> str | None:
    """Return why derivatives of kick and drift are invalid. None if the derivatives are valid."""
    if type(integrator) in (VelocityVerlet, Langevin):
        return None
    if isinstance(integrator, KickDrift) and _is_linear(integrator):
        return None
    return (
        f"it is written out for integrators of a kick and a linear drift, and {integrator.name} is another; "
        "the methods symmetric, event-aware and unrolled differentiate any integrator"
    )


def check_kick(integrator: Integrator) -> None:
    """Raise `InputError` if the equations of motion of an integrator cannot be linearized."""
    if why := without_kick(integrator):
        raise InputError(f"the equations of motion cannot be linearized: {why}", where="dynamics.kind")


def check_one_box(integrator: Integrator, what: str) -> None:
    """Raise `InputError` if an integrator changes the box where it must be fixed."""
    if integrator.moves_cell:
        raise InputError(
            f"{what} need a fixed box, but {integrator.name} changes the box", where="dynamics.kind"
        )


def _is_linear(integrator: KickDrift) -> bool:
    """Return True if the drift has equal derivatives at two states."""
    x, v, dx, dv = jax.random.normal(jax.random.key(0), (4, 3, 4), jnp.float64)
    zero, order = jnp.zeros((), jnp.int64), jnp.arange(4)

    def drift(x, v):
        return jnp.stack(integrator.drift(x, v, jnp.arange(1.0, 5.0), zero, order)[:2])

    here, there = (jax.jvp(drift, at, (dx, dv))[1] for at in ((x, v), (v - x, 2 * x)))
    return bool(jnp.allclose(here, there, rtol=1e-9, atol=1e-12))


class VelocityVerlet(KickDrift):
    """Velocity Verlet (NVE): symplectic and time-reversible in exact arithmetic; local error O(dt³).

    Example:
        >>> mdnum.simulation(atoms, argon, mdnum.Cut("switched", 8.5), timestep=0.002)
    """

    name = "nve"

    def drift(self, x, v, masses, step, order):
        return x + self.timestep.astype(x.dtype) * v, v, jnp.zeros((), jnp.float64)


class Langevin(KickDrift):
    """Langevin dynamics, BAOAB (Leimkuhler & Matthews 2013): drift, exact Ornstein-Uhlenbeck step, drift.

    The noise depends only on the random key and the step number. Two runs can therefore have the same noise.
    A resumed run continues its noise sequence.

    Example:
        >>> cut = mdnum.Cut("switched", 8.5)
        >>> mdnum.simulation(atoms, argon, cut, timestep=0.002, temperature=90, friction=1.0)
    """

    name = "langevin"
    keeps_momentum = False
    friction: Float[Array, ""] = quantity("rate")
    kT: Float[Array, ""] = quantity("temperature")  # as an energy
    key: Array = quantity("seed")  # counter-based random key

    def drift(self, x, v, masses, step, order):
        half = (0.5 * self.timestep).astype(x.dtype)
        x = x + half * v
        decay = jnp.exp(-self.friction * self.timestep)
        spread = jnp.sqrt(self.kT * (1 - decay * decay) / masses.astype(jnp.float64))
        noise = jax.random.normal(jax.random.fold_in(self.key, step), x.shape, jnp.float64)[:, order]
        kicked = (decay * v.astype(jnp.float64) + spread * noise).astype(v.dtype)
        heat = 0.5 * jnp.sum(
            masses.astype(jnp.float64)
            * (jnp.square(kicked.astype(jnp.float64)) - jnp.square(v.astype(jnp.float64)))
        )
        return x + half * kicked, kicked, heat


#: All integrators, by their names in system files.
INTEGRATORS: Registry[Integrator] = Registry("integrator", "mdnum.integrators", kind=Integrator)
for _scheme in (VelocityVerlet, Langevin):
    INTEGRATORS.add(_scheme.name, _scheme)
for _name, _place, _words in (
    (
        "nose-hoover",
        "thermostats:NoseHooverChain",
        "NVT. Nosé-Hoover chain (Martyna et al. 1992).",
    ),
    ("csvr", "thermostats:CSVR", "NVT. Stochastic velocity rescaling (Bussi, Donadio & Parrinello 2007)."),
    ("mtk", "barostats:MTK", "NPT. Martyna, Tobias & Klein 1994; isotropic or full box."),
    ("cell-rescaling", "barostats:CellRescaling", "NPT. Stochastic cell rescaling (Bernetti & Bussi 2020)."),
):
    INTEGRATORS.add(_name, f"mdnum.md.{_place}", description=_words)
