"""Parameters of a simulation, and the inputs that each one changes.

Names, values and units of parameters are those of `mdnum.systems.parameters`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md import manybody
from mdnum.md.integrators import Integrator, converted
from mdnum.md.pairforce import ManyBodyForce, PairForce
from mdnum.systems import parameters
from mdnum.systems.parameters import by, is_weight, leaf_of, unit, value, with_values
from mdnum.systems.simulation import Simulation

__all__ = ["by", "is_weight", "unit", "value", "with_values"]

#: Numbers of a system file without a derivative, and the reason.
_INTEGERS = {
    "dynamics.seed": "it selects random numbers and is not a quantity",
    "dynamics.steps": "it is a whole number",
    "neighbors.skin": "it changes which list is used, and no force",
    "dynamics.temperature": "nothing has it; velocity.scale scales velocities that are given",
}


@dataclass(frozen=True)
class Cotangents:
    """Derivatives of a loss with respect to all inputs of a simulation."""

    model: Any  # by the quantities of the force (`quantities`)
    integrator: Integrator  # by the leaves of the integrator that are numbers
    # x, v: by the positions and velocities of step 0, user's order
    x: Float[np.ndarray, "3 atoms"]
    v: Float[np.ndarray, "3 atoms"]
    scale: float  # by a common factor of the box and all positions, at 1
    # by the cutoffs through the times of the flips alone; 0 without saltation
    r_cut: Float[np.ndarray, "types"]


class Direction(NamedTuple):
    """Derivatives of all inputs with respect to one or several parameter entries."""

    # x, v: of the positions and velocities of step 0, user's order
    x: Float[Array, "*columns 3 atoms"]
    v: Float[Array, "*columns 3 atoms"]
    model: Any  # of the quantities of the force
    integrator: Any  # of the numbers of the integrator; None where a leaf is no number
    matrix: Float[Array, "*columns 3 3"]  # of the lattice vectors
    r_cut: Float[Array, "*columns types"]  # of the cutoffs at which pairs cross


def quantities(force: PairForce | ManyBodyForce) -> Any:
    """Return the differentiable parameters of a force, as a pytree of arrays.

    For a many-body potential, the pytree has arrays and constants by name.
    """
    return force.model if isinstance(force, PairForce) else manybody.quantities_of(force.potential)


def with_quantities(force: PairForce | ManyBodyForce, values: Any) -> PairForce | ManyBodyForce:
    """Return a copy of a force with other parameters. It can be called inside jit."""
    if isinstance(force, PairForce):
        return replace(force, model=values)
    return replace(force, potential=manybody.with_quantities(force.potential, values))


def onto_start(simulation: Simulation, start: Any, extra: Any) -> tuple[Any, Array, Array]:
    """Propagate derivatives of the integrator's initial state to parameters, positions and velocities.

    Args:
        start: the state of step 0.
    """

    def begun(numbers, x, v):
        made = eqx.combine(numbers, rest).init(x, v, jnp.asarray(simulation.masses))
        return eqx.filter(made, eqx.is_inexact_array)

    numbers, rest = eqx.partition(simulation.integrator, eqx.is_inexact_array)
    return jax.vjp(begun, numbers, start.x, start.v)[1](extra)


def names(simulation: Simulation) -> tuple[str, ...]:
    """Return the names of all parameters of a simulation."""
    # there is no derivative by a temperature of 0
    cold = () if value(simulation, "dynamics.temperature") else ("dynamics.temperature",)
    model = simulation.model
    return tuple(
        name for name in parameters.names(simulation)
        if name not in ("neighbors.skin", *cold) and not parameters.shared_radius(model, name)
    )  # fmt: skip


def resolve(simulation: Simulation, words: Sequence[str]) -> tuple[str, ...]:
    """Return full names of parameters. "potential" stands for all of its parameters.

    Raises:
        InputError: a parameter does not exist, or is not a differentiable quantity.
    """
    known, out = names(simulation), []
    for word in words:
        below = [name for name in known if name.startswith(f"{word}.")]
        whole = next((key for key in _INTEGERS if word in (key, key.rpartition(".")[2])), None)
        if whole is not None and whole not in known:
            raise InputError(f"the parameter {whole} has no derivative: {_INTEGERS[whole]}", where=word)
        if shared := parameters.shared_radius(simulation.model, word):
            message = f"{', '.join(shared)} have the same radius and share one decision per pair"
            remedy = "Differentiate by cutoff.radius, which moves all terms, or give different radii"
            raise InputError(message, where=word, remedy=remedy)
        out += below or [parameters.resolve(simulation, word, known)]
    if not out:
        raise InputError(
            "no parameter was given for the derivative", remedy=f"Choose from {', '.join(known)}"
        )
    return tuple(dict.fromkeys(out))


def _places(simulation: Simulation, name: str) -> list[tuple[Callable[[Any], Any], Any]]:
    """For each input that depends on a parameter, return a selector and the derivative."""
    if name in ("initial.positions", "initial.velocities"):
        return [((lambda of: of.x) if name == "initial.positions" else (lambda of: of.v), None)]
    v = simulation.velocities.T
    if name == "velocity.scale":
        return [(lambda of: of.v, v)]
    if name == "box.scale":
        return [(lambda of: of.x, simulation.positions.T), (lambda of: of.matrix, simulation.cell.matrix)]
    table, _, key = name.partition(".")
    if table != "dynamics":
        # the onset of one that does not switch goes with the radius
        alone = name == "cutoff.radius" and not simulation.cutoff.switches and "" in simulation.model.terms
        onset: list[Any] = [(lambda of: of.model.r_onset, None)] if alone else []
        return [(lambda of: leaf_of(of.model, name) if simulation.pairwise else of.model[key], None), *onset]
    found: list[tuple[Callable[[Any], Any], Any]] = []
    if key == "temperature" and simulation.draw.drawn:
        found.append((lambda of: of.v, v / (2 * float(value(simulation, name)))))
    if (field := simulation.integrator.keys().get(key)) is not None:
        at = field.name
        found.append((lambda of: getattr(of.integrator, at), converted(field, 1.0, simulation.units)))
    return found


def gradient(simulation: Simulation, parts: Cotangents, name: str) -> Float[np.ndarray, "..."]:
    """Return the derivative with respect to a parameter, in the shape of the parameter."""
    entry = parameters.entry(simulation, name)
    if name == "box.scale":
        return np.asarray(parts.scale)
    total: Any = 0.0
    for where, along in _places(simulation, entry.whole):
        leaf = np.asarray(where(parts), np.float64)
        total = total + (leaf if along is None else np.sum(leaf * along))
    if entry.whole.endswith("cutoff.radius"):
        # and the times of the flips
        channels, types = enumerate(simulation.model.parts), simulation.pair_types
        channel = next(c for c, part in channels if entry.whole in parameters.pair_leaves(part))
        total = total + np.asarray(parts.r_cut)[channel * types : (channel + 1) * types]
    if entry.whole.startswith("initial."):
        return np.array(total.T[entry.index] / entry.factor)
    return np.array(np.reshape(total, np.shape(value(simulation, entry.whole)))[entry.index])


def moved(simulation: Simulation, still: Direction, column: ParameterEntry) -> Direction:
    """Return derivatives of all inputs with respect to one parameter entry."""
    entry = parameters.entry(simulation, column.name)
    unit_entry = np.zeros(np.shape(value(simulation, entry.whole)))
    unit_entry[(*entry.index, *column.index)] = 1 / entry.factor
    turned = unit_entry.T if entry.whole.startswith("initial.") else unit_entry
    for where, along in _places(simulation, entry.whole):
        leaf = where(still)
        made = jnp.asarray(turned if along is None else along, leaf.dtype).reshape(leaf.shape)
        still = eqx.tree_at(where, still, made)
    if entry.whole.endswith("cutoff.radius"):
        still = still._replace(r_cut=still.model.r_cut.astype(jnp.float64))
    return still


@dataclass(frozen=True)
class ParameterEntry:
    """Variable of differentiation: a scalar parameter, or one entry of an array parameter."""

    name: str  # full name of the parameter
    index: tuple[int, ...] = ()  # which of its entries; empty for a scalar

    def __str__(self) -> str:
        return f"{self.name}[{', '.join(map(str, self.index))}]" if self.index else self.name


def columns_of(simulation: Simulation, names: Sequence[str]) -> tuple[ParameterEntry, ...]:
    """Return all entries (single numbers) of the given parameters."""
    return tuple(
        ParameterEntry(name, tuple(int(k) for k in index))
        for name in names
        for index in np.ndindex(value(simulation, name).shape)
    )


def gathered(
    simulation: Simulation, names: Sequence[str], values: Float[np.ndarray, "columns"]
) -> dict[str, Float[np.ndarray, "..."]]:
    """Split a vector of entries into arrays with the parameters' shapes."""
    shapes = {name: value(simulation, name).shape for name in names}
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])
    parts = np.split(np.asarray(values, np.float64), ends[:-1])
    return {name: part.reshape(shapes[name]) for name, part in zip(names, parts, strict=True)}


def directions(simulation: Simulation, columns: Sequence[ParameterEntry]) -> Direction:
    """Return derivatives of a simulation's inputs. The first axis is the parameter entry."""
    nothing = jnp.zeros((3, simulation.atoms), simulation.policy.dtype("state"))
    still = Direction(
        nothing,
        nothing,
        jax.tree.map(jnp.zeros_like, quantities(simulation.force)),
        jax.tree.map(jnp.zeros_like, eqx.filter(simulation.integrator, eqx.is_inexact_array)),
        jnp.zeros((3, 3), jnp.float64),
        jnp.zeros(len(simulation.decider.r_cut), jnp.float64),
    )
    each = [moved(simulation, still, column) for column in columns]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
