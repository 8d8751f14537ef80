"""Named parameters as directions: what of a rollout moves with each, and how fast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.gradients import parameters
from mdnum.md.integrators import Langevin
from mdnum.systems.build import Simulation


class Direction(NamedTuple):
    """Derivatives of everything that a rollout is made of by one number, or by several along a first axis.

    Attributes:
        x, v: of the positions and velocities of step 0, user's order, shape (..., 3, atoms).
        model: of the quantities of the force.
        integrator: of the numbers of the integrator; None where a leaf is no number.
        matrix: of the lattice vectors, shape (..., 3, 3).
        r_cut: of the cutoffs at which pairs cross, shape (..., types).
    """

    x: Float[Array, "*columns 3 atoms"]
    v: Float[Array, "*columns 3 atoms"]
    model: Any
    integrator: Any
    matrix: Float[Array, "*columns 3 3"]
    r_cut: Float[Array, "*columns types"]


@dataclass(frozen=True)
class Column:
    """One number among the parameters.

    Attributes:
        name: full name of the parameter.
        index: which of its entries; empty for a scalar.
    """

    name: str
    index: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{self.name}[{', '.join(map(str, self.index))}]" if self.index else self.name


def columns_of(simulation: Simulation, names: Sequence[str]) -> tuple[Column, ...]:
    """The numbers that some parameters consist of, in order."""
    return tuple(
        Column(name, tuple(int(k) for k in index))
        for name in names
        for index in np.ndindex(parameters.value(simulation, name).shape)
    )


def gathered(
    simulation: Simulation, names: Sequence[str], values: Float[np.ndarray, "columns"]
) -> dict[str, Float[np.ndarray, "..."]]:
    """A value for each column, put back into the shapes of the parameters."""
    out, start = {}, 0
    for name in names:
        shape = parameters.value(simulation, name).shape
        size = int(np.prod(shape))
        out[name] = np.asarray(values[start : start + size], np.float64).reshape(shape)
        start += size
    return out


def numbers_of(integrator: Any) -> Any:
    """The leaves of an integrator that are quantities, the others None; a key is not one."""
    return eqx.filter(integrator, eqx.is_inexact_array)


def directions(simulation: Simulation, columns: Sequence[Column]) -> Direction:
    """What each column moves, stacked along a first axis; per unit of the parameter's own value."""
    each = [_direction(simulation, column) for column in columns]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def _direction(simulation: Simulation, column: Column) -> Direction:
    name, index = column.name, column.index
    units, dtype = simulation.units, simulation.policy.dtype("state")
    nothing = np.zeros((3, simulation.atoms))
    x, v, matrix = nothing, nothing, np.zeros((3, 3))
    # a scalar by name is the one entry of a leaf by pair type
    r_cut = np.zeros(simulation.pair_types)
    entry = r_cut.copy()
    by_type = simulation.pairwise and name.startswith(("potential.", "cutoff."))
    entry[index[0] if by_type and index else 0] = 1.0
    moved: dict[str, np.ndarray] = {}
    numbers: dict[str, float] = {}
    values: Any = jax.tree.map(jnp.zeros_like, parameters.quantities(simulation.force))
    if name.startswith("potential.") and not simulation.pairwise:
        key = name.partition(".")[2]
        one = np.zeros(values[key].shape)
        one[index] = 1.0
        values = values | {key: jnp.asarray(one, values[key].dtype)}
    elif name.startswith("potential."):
        moved["potential." + name.partition(".")[2]] = entry
    elif name == "cutoff.radius":
        moved["r_cut"], r_cut = entry, entry
        if not simulation.model.cutoff.switches:
            moved["r_onset"] = entry
    elif name == "cutoff.onset":
        moved["r_onset"] = entry
    elif name == "dynamics.timestep":
        numbers["timestep"] = units.time_factor
    elif name == "dynamics.friction":
        numbers["friction"] = 1 / units.time_factor
    elif name == "dynamics.temperature":
        v = simulation.velocities.T / (2 * float(parameters.value(simulation, name)))
        if isinstance(simulation.integrator, Langevin):
            numbers["kT"] = units.k_B
    elif name == "initial.positions":
        x = nothing.copy()
        x[index[1], index[0]] = 1.0
    elif name == "initial.velocities":
        v = nothing.copy()
        v[index[1], index[0]] = 1.0
    else:
        assert name == "box.scale", name
        x, matrix = simulation.positions.T, np.asarray(simulation.cell.matrix)
    for where, value in moved.items():
        leaf = jnp.asarray(value, values.r_cut.dtype)
        path = where.split(".")
        values = eqx.tree_at(lambda one, path=path: _at(one, path), values, leaf)
    integrator = jax.tree.map(jnp.zeros_like, numbers_of(simulation.integrator))
    for field in fields(integrator):
        if field.name in numbers:
            integrator = eqx.tree_at(
                lambda one, field=field.name: getattr(one, field),
                integrator,
                jnp.asarray(numbers[field.name], getattr(integrator, field.name).dtype),
            )
    return Direction(
        jnp.asarray(x, dtype),
        jnp.asarray(v, dtype),
        values,
        integrator,
        jnp.asarray(matrix, jnp.float64),
        jnp.asarray(r_cut, jnp.float64),
    )


def _at(tree: Any, path: Sequence[str]) -> Any:
    for key in path:
        tree = getattr(tree, key)
    return tree
