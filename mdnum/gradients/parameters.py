"""Parameters by name: what a rollout can be differentiated by, and where it is in a simulation.

Each kind of parameter is one class: its value, the simulation with another value, the derivative by it from
the derivatives by all that a rollout is made of, and what of a rollout moves with it, for tangents.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.cell import Cell
from mdnum.md.integrators import Integrator, converted
from mdnum.md.manybody import leaves_by_path
from mdnum.md.pairforce import ManyBodyForce, PairForce
from mdnum.registry import nearest
from mdnum.systems.simulation import Simulation

#: Other words for a parameter.
_ALIASES = {
    "r_cut": "cutoff.radius", "r_onset": "cutoff.onset", "dt": "dynamics.timestep",
    "temperature": "dynamics.temperature", "friction": "dynamics.friction", "x0": "initial.positions",
    "v0": "initial.velocities", "scale": "box.scale", "box": "box.scale",
}  # fmt: skip
#: Numbers of a system file that have no derivative, and why.
_INTEGERS = {
    "dynamics.seed": "it is the number of a noise, not a quantity",
    "dynamics.steps": "it is a whole number",
    "neighbors.skin": "it changes which list is used, and no force",
}
#: Units by the last word of a name, or by what a field of an integrator is.
_UNITS = {
    "sigma": "{length}", "epsilon": "{energy}", "depth": "{energy}", "r0": "{length}",
    "radius": "{length}", "onset": "{length}", "time": "{time}", "temperature": "{temperature}",
    "rate": "1/{time}", "scale": "", "positions": "{length}", "velocities": "√({energy}/{mass})", None: "",
}  # fmt: skip


@dataclass(frozen=True)
class Cotangents:
    """Derivatives of a loss by everything that a rollout is made of."""

    model: Any  # by the quantities of the force (`quantities`)
    integrator: Integrator  # by the leaves of the integrator that are numbers
    # x, v: by the positions and velocities of step 0, user's order
    x: Float[np.ndarray, "3 atoms"]
    v: Float[np.ndarray, "3 atoms"]
    scale: float  # by a common factor of the box and all positions, at 1
    # by the cutoffs through the times of the flips alone; 0 without saltation
    r_cut: Float[np.ndarray, "types"]


class Direction(NamedTuple):
    """Derivatives of everything that a rollout is made of by one number, or by several along a first axis."""

    # x, v: of the positions and velocities of step 0, user's order
    x: Float[Array, "*columns 3 atoms"]
    v: Float[Array, "*columns 3 atoms"]
    model: Any  # of the quantities of the force
    integrator: Any  # of the numbers of the integrator; None where a leaf is no number
    matrix: Float[Array, "*columns 3 3"]  # of the lattice vectors
    r_cut: Float[Array, "*columns types"]  # of the cutoffs at which pairs cross


def quantities(force: PairForce | ManyBodyForce) -> Any:
    """The parameters of a force that are quantities: a pytree of arrays.

    Of a many-body potential they are its arrays and its constants, by name.
    """
    return force.model if isinstance(force, PairForce) else _quantities_of(force.potential)


def with_quantities(force: PairForce | ManyBodyForce, values: Any) -> PairForce | ManyBodyForce:
    """The force with other quantities; inside jit too."""
    if isinstance(force, PairForce):
        return replace(force, model=values)
    return replace(force, potential=_with_quantities(force.potential, values))


def _quantities_of(potential: Any) -> dict[str, Any]:
    found = {name: leaf for name, leaf in leaves_by_path(potential).items() if eqx.is_inexact_array(leaf)}
    for field in fields(potential):
        value = getattr(potential, field.name)
        # constants that a formula holds; the radius of a table is where it ends, and not one of them
        if type(value) is float and field.name != "r_cut":
            found[field.name] = jnp.asarray(value, jnp.float64)
    return found


def _with_quantities(potential: Any, values: Mapping[str, Any]) -> Any:
    names, tree = list(leaves_by_path(potential)), jax.tree.structure(potential)
    leaves = [values.get(name, leaf) for name, leaf in zip(names, jax.tree.leaves(potential), strict=True)]
    whole = jax.tree.unflatten(tree, leaves)
    # constants are static fields, so that a module would warn of an array; here they only live for a trace
    out = object.__new__(type(potential))
    for field in fields(potential):
        static = field.name in values and field.name not in names
        object.__setattr__(out, field.name, values[field.name] if static else getattr(whole, field.name))
    return out


@dataclass(frozen=True)
class Parameter(ABC):
    """One quantity of a simulation; its value is a scalar, or has an entry for each pair type, atom or so."""

    simulation: Simulation
    name: str

    @property
    def key(self) -> str:
        """The name behind its table."""
        return self.name.partition(".")[2]

    @abstractmethod
    def value(self) -> Float[np.ndarray, "..."]:
        """In units of the system file, but velocities are length per internal time."""

    @abstractmethod
    def changed(self, new: np.ndarray) -> Simulation:
        """The simulation with another value."""

    @abstractmethod
    def gradient(self, parts: Cotangents) -> Float[np.ndarray, "..."]:
        """The derivative by it, of the shape of the value."""

    @abstractmethod
    def moved(self, still: Direction, index: tuple[int, ...]) -> Direction:
        """What moves with one entry, per unit of the value, where nothing else does."""


class _PairQuantity(Parameter):
    """An array of the cut pair potential with an entry for each pair type."""

    def of(self, model):
        return model.potential.leaves[self.key]

    def value(self):
        return _plain(self.of(self.simulation.model))

    def changed(self, new):
        model = eqx.tree_at(self.of, self.simulation.model, jnp.asarray(np.atleast_1d(new), jnp.float64))
        return replace(self.simulation, model=model)

    def gradient(self, parts):
        return _plain(self.of(parts.model))

    def moved(self, still, index):
        entry = np.zeros(self.simulation.pair_types)
        entry[index[0] if index else 0] = 1.0
        leaf = jnp.asarray(entry, self.of(still.model).dtype)
        return still._replace(model=eqx.tree_at(self.of, still.model, leaf))


class _Onset(_PairQuantity):
    def of(self, model):
        return model.r_onset


class _Radius(_PairQuantity):
    """The cutoff; of one that does not switch the onset goes with it, and the times of the flips do."""

    def of(self, model):
        return model.r_cut

    @property
    def onset(self) -> Parameter | None:
        return None if self.simulation.model.cutoff.switches else _Onset(self.simulation, "cutoff.onset")

    def changed(self, new):
        radii = tuple(float(r) for r in np.atleast_1d(new))
        changed = super().changed(new)
        if self.onset:
            changed = replace(self.onset, simulation=changed).changed(new)
        return replace(changed, decider=replace(self.simulation.decider, r_cut=radii))

    def gradient(self, parts):
        onset = np.asarray(parts.model.r_onset) if self.onset else 0.0
        return _plain(np.asarray(parts.model.r_cut) + onset + parts.r_cut)

    def moved(self, still, index):
        moved = super().moved(still, index)
        if self.onset:
            moved = self.onset.moved(moved, index)
        return moved._replace(r_cut=moved.model.r_cut.astype(jnp.float64))


class _Constant(Parameter):
    """An array or constant of a many-body potential."""

    def value(self):
        return np.array(_quantities_of(self.simulation.model)[self.key], np.float64)

    def changed(self, new):
        constant = self.key not in leaves_by_path(self.simulation.model)
        value = float(new) if constant else jnp.asarray(new)
        model: Any = _with_quantities(self.simulation.model, {self.key: value})
        # its radius may follow
        decider = replace(self.simulation.decider, r_cut=(float(model.r_cut),))
        return replace(self.simulation, model=model, decider=decider)

    def gradient(self, parts):
        return np.array(parts.model[self.key], np.float64)

    def moved(self, still, index):
        leaf = still.model[self.key]
        return still._replace(model=still.model | {self.key: leaf.at[index].set(1.0)})


class _Number(Parameter):
    """A number of the integrator."""

    def value(self):
        return np.asarray(self.simulation.integrator.number(self.key, self.simulation.units))

    def changed(self, new):
        simulation = self.simulation
        return replace(
            simulation, integrator=simulation.integrator.with_number(self.key, new, simulation.units)
        )

    def gradient(self, parts):
        field = parts.integrator.keys()[self.key]
        return np.asarray(
            converted(field, float(getattr(parts.integrator, field.name)), self.simulation.units)
        )

    def moved(self, still, index):
        return still._replace(integrator=still.integrator.with_number(self.key, 1.0, self.simulation.units))


class _Temperature(_Number):
    """It scales the velocities of step 0 with its root, and is that of a thermostat."""

    def value(self):
        return np.asarray(float(self.simulation.draw.temperature))

    def changed(self, new):
        old, simulation = self.value(), self.simulation
        if not float(new) > 0 or not float(old) > 0:
            raise InputError(
                f"temperature {float(old):g} to {float(new):g}; expected both above 0", where="dynamics"
            )
        v = simulation.velocities * np.sqrt(float(new) / float(old))
        simulation = replace(simulation, draw=replace(simulation.draw, temperature=float(new)), velocities=v)
        return _Number.changed(replace(self, simulation=simulation), new) if self._of_bath else simulation

    @property
    def _of_bath(self) -> bool:
        return self.key in self.simulation.integrator.numbers()

    def gradient(self, parts):
        by_start = float(np.sum(parts.v * self.simulation.velocities.T)) / (2 * float(self.value()))
        return np.asarray(by_start + (super().gradient(parts) if self._of_bath else 0.0))

    def moved(self, still, index):
        v = self.simulation.velocities.T / (2 * float(self.value()))
        moved = still._replace(v=jnp.asarray(v, still.v.dtype))
        return super().moved(moved, index) if self._of_bath else moved


class _Start(Parameter):
    """Positions or velocities of step 0, shape (atoms, 3)."""

    def value(self):
        return np.array(getattr(self.simulation, self.key))

    def changed(self, new):
        return replace(self.simulation, **{self.key: new})

    def gradient(self, parts):
        return (parts.v if self.key == "velocities" else parts.x).T.copy()

    def moved(self, still, index):
        one = jnp.zeros_like(still.x).at[index[1], index[0]].set(1.0)
        return still._replace(**{"v" if self.key == "velocities" else "x": one})


class _Scale(Parameter):
    """A common factor of the box and all positions."""

    def value(self):
        return np.asarray(1.0)

    def changed(self, new):
        simulation = self.simulation
        cell = Cell.create(np.asarray(simulation.cell.matrix) * float(new), simulation.pbc)
        return replace(simulation, positions=simulation.positions * float(new)).with_cell(cell)

    def gradient(self, parts):
        return np.asarray(parts.scale)

    def moved(self, still, index):
        x = jnp.asarray(self.simulation.positions.T, still.x.dtype)
        return still._replace(x=x, matrix=jnp.asarray(np.asarray(self.simulation.cell.matrix), jnp.float64))


_KINDS: dict[str, type[Parameter]] = {
    "cutoff.radius": _Radius, "cutoff.onset": _Onset, "dynamics.temperature": _Temperature,
    "initial.positions": _Start, "initial.velocities": _Start, "box.scale": _Scale,
}  # fmt: skip


def parameter(simulation: Simulation, name: str) -> Parameter:
    """The parameter of a full name."""
    of_potential = _PairQuantity if simulation.pairwise else _Constant
    kind = _KINDS.get(name, _Number if name.startswith("dynamics.") else of_potential)
    return kind(simulation, name)


def names(simulation: Simulation) -> tuple[str, ...]:
    """Parameters that a simulation has."""
    if simulation.pairwise:
        found = [f"potential.{name}" for name in simulation.model.potential.leaves]
        found += ["cutoff.radius"]
        if simulation.model.cutoff.switches:
            found += ["cutoff.onset"]
    else:
        found = [f"potential.{name}" for name in _quantities_of(simulation.model)]
    found += ["dynamics.timestep"]
    # without one there is nothing that a temperature would scale
    if simulation.draw.temperature:
        found += ["dynamics.temperature"]
    others = [key for key in simulation.integrator.numbers() if key not in ("timestep", "temperature")]
    found += [f"dynamics.{key}" for key in others]
    return (*found, "initial.positions", "initial.velocities", "box.scale")


def resolve(simulation: Simulation, words: Sequence[str]) -> tuple[str, ...]:
    """Full names of parameters, from full or short ones.

    Raises:
        InputError: no such parameter, or one that is no quantity.
    """
    known = names(simulation)
    short = {name.rpartition(".")[2]: name for name in known}
    # a simulation need not have what a short word means
    short |= {word: name for word, name in _ALIASES.items() if name in known}
    out = []
    for word in words:
        name = word if word in known else short.get(word, word)
        if name not in known:
            whole = next((key for key in _INTEGERS if word in (key, key.rpartition(".")[2])), None)
            if whole is not None:
                raise InputError(f"nothing is differentiable by {whole}: {_INTEGERS[whole]}", where=word)
            close = nearest(word, [*known, *short])
            hint = f"Did you mean {close}? " if close else ""
            raise InputError(f"no parameter {word!r}", remedy=f"{hint}There are {', '.join(known)}")
        if name not in out:
            out.append(name)
    if not out:
        raise InputError("no parameter to differentiate by", remedy=f"There are {', '.join(known)}")
    return tuple(out)


def value(simulation: Simulation, name: str) -> Float[np.ndarray, "..."]:
    """The value of a parameter: a scalar where the simulation has one pair type, else one for each."""
    return parameter(simulation, name).value()


def with_values(simulation: Simulation, values: Mapping[str, Any]) -> Simulation:
    """The simulation with other values of some parameters.

    Raises:
        InputError: a value that is not finite, complex, or of another shape.
    """
    for name, given in values.items():
        one, new = parameter(simulation, name), np.asarray(given)
        if new.shape != one.value().shape or np.iscomplexobj(new) or not np.isfinite(new).all():
            raise InputError(
                f"{name}: shape {new.shape}, {new.dtype}, finite: {bool(np.isfinite(new).all())}; expected "
                f"finite numbers of shape {one.value().shape}, and none that is complex"
            )
        simulation = one.changed(new.astype(np.float64))
    return simulation


def gradient(simulation: Simulation, parts: Cotangents, name: str) -> Float[np.ndarray, "..."]:
    """The derivative by a named parameter, of the shape of its value."""
    return parameter(simulation, name).gradient(parts)


def unit(simulation: Simulation, name: str) -> str:
    """The unit of a parameter: "" for none, its own name in brackets where none is known."""
    short = name.rpartition(".")[2]
    field = simulation.integrator.keys().get(name.removeprefix("dynamics."))
    word = short if field is None else field.metadata.get("unit")
    return _UNITS.get(word, f"[{short}]").format_map(vars(simulation.units))


@dataclass(frozen=True)
class ParameterEntry:
    """One number among the parameters."""

    name: str  # full name of the parameter
    index: tuple[int, ...] = ()  # which of its entries; empty for a scalar

    def __str__(self) -> str:
        return f"{self.name}[{', '.join(map(str, self.index))}]" if self.index else self.name


def columns_of(simulation: Simulation, names: Sequence[str]) -> tuple[ParameterEntry, ...]:
    """The numbers that some parameters consist of, in order."""
    return tuple(
        ParameterEntry(name, tuple(int(k) for k in index))
        for name in names
        for index in np.ndindex(value(simulation, name).shape)
    )


def gathered(
    simulation: Simulation, names: Sequence[str], values: Float[np.ndarray, "columns"]
) -> dict[str, Float[np.ndarray, "..."]]:
    """A value for each column, put back into the shapes of the parameters."""
    shapes = {name: value(simulation, name).shape for name in names}
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])
    parts = np.split(np.asarray(values, np.float64), ends[:-1])
    return {name: part.reshape(shapes[name]) for name, part in zip(names, parts, strict=True)}


def directions(simulation: Simulation, columns: Sequence[ParameterEntry]) -> Direction:
    """What each column moves, stacked along a first axis; per unit of the parameter's own value."""
    nothing = jnp.zeros((3, simulation.atoms), simulation.policy.dtype("state"))
    still = Direction(
        nothing,
        nothing,
        jax.tree.map(jnp.zeros_like, quantities(simulation.force)),
        jax.tree.map(jnp.zeros_like, eqx.filter(simulation.integrator, eqx.is_inexact_array)),
        jnp.zeros((3, 3), jnp.float64),
        jnp.zeros(simulation.pair_types, jnp.float64),
    )
    each = [parameter(simulation, column.name).moved(still, column.index) for column in columns]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def _plain(leaf) -> Float[np.ndarray, "..."]:
    array = np.array(leaf, np.float64)
    return array.reshape(()) if array.shape == (1,) else array
