"""Parameters by name: what a rollout can be differentiated by, and where it sits in a simulation."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.md.cell import Cell
from mdnum.md.integrators import Integrator, Langevin
from mdnum.md.manyforce import ManyBodyForce
from mdnum.md.pairforce import PairForce
from mdnum.md.potentials import CutPotential
from mdnum.systems.build import Simulation

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


@dataclass(frozen=True)
class Cotangents:
    """Derivatives of a loss by everything that a rollout is made of.

    Attributes:
        model: by the quantities of the force (`quantities`).
        integrator: by the leaves of the integrator that are numbers.
        x, v: by the positions and velocities of step 0, user's order, shape (3, atoms).
        scale: by a common factor of the box and all positions, at 1.
        r_cut: by the cutoffs through the times of the flips alone, shape (types,); 0 without saltation.
    """

    model: Any
    integrator: Integrator
    x: Float[np.ndarray, "3 atoms"]
    v: Float[np.ndarray, "3 atoms"]
    scale: float
    r_cut: Float[np.ndarray, "types"]


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


def _leaves_by_path(potential: Any) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(potential)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _quantities_of(potential: Any) -> dict[str, Any]:
    found = {name: leaf for name, leaf in _leaves_by_path(potential).items() if eqx.is_inexact_array(leaf)}
    for field in fields(potential):
        value = getattr(potential, field.name)
        # constants that a formula holds; the radius of a table is where it ends, and not one of them
        if type(value) is float and field.name != "r_cut":
            found[field.name] = jnp.asarray(value, jnp.float64)
    return found


def _with_quantities(potential: Any, values: Mapping[str, Any]) -> Any:
    names, tree = list(_leaves_by_path(potential)), jax.tree.structure(potential)
    leaves = [values.get(name, leaf) for name, leaf in zip(names, jax.tree.leaves(potential), strict=True)]
    whole = jax.tree.unflatten(tree, leaves)
    # constants are static fields, so that a module would warn of an array; here they only live for a trace
    out = object.__new__(type(potential))
    for field in fields(potential):
        static = field.name in values and field.name not in names
        object.__setattr__(out, field.name, values[field.name] if static else getattr(whole, field.name))
    return out


def names(simulation: Simulation) -> tuple[str, ...]:
    """Parameters that a simulation has."""
    if simulation.pairwise:
        found = [f"potential.{leaf.name}" for leaf in fields(simulation.model.potential)]
        found += ["cutoff.radius"]
        if simulation.model.cutoff.switches:
            found += ["cutoff.onset"]
    else:
        found = [f"potential.{name}" for name in _quantities_of(simulation.model)]
    found += ["dynamics.timestep"]
    # without one there is nothing that a temperature would scale
    if simulation.system.spec.dynamics.temperature:
        found += ["dynamics.temperature"]
    if isinstance(simulation.integrator, Langevin):
        found += ["dynamics.friction"]
    return (*found, "initial.positions", "initial.velocities", "box.scale")


def resolve(simulation: Simulation, words: Sequence[str]) -> tuple[str, ...]:
    """Full names of parameters, from full or short ones.

    Raises:
        InputError: no such parameter, or one that is no quantity.
    """
    known = names(simulation)
    short = {name.rpartition(".")[2]: name for name in known}
    # a simulation need not have what a short word stands for
    short |= {word: name for word, name in _ALIASES.items() if name in known}
    out = []
    for word in words:
        name = word if word in known else short.get(word, word)
        if name not in known:
            whole = next((key for key in _INTEGERS if word in (key, key.rpartition(".")[2])), None)
            if whole is not None:
                raise InputError(f"nothing is differentiable by {whole}: {_INTEGERS[whole]}", where=word)
            close = difflib.get_close_matches(word, [*known, *short], n=1)
            hint = f"Did you mean {close[0]}? " if close else ""
            raise InputError(f"no parameter {word!r}", remedy=f"{hint}There are {', '.join(known)}")
        if name not in out:
            out.append(name)
    if not out:
        raise InputError("no parameter to differentiate by", remedy=f"There are {', '.join(known)}")
    return tuple(out)


def value(simulation: Simulation, name: str) -> Float[np.ndarray, "..."]:
    """The value of a parameter: a scalar where the simulation has one pair type, else one for each.

    Units are those of the system file, but velocities are length per internal time.
    """
    units = simulation.units
    model = simulation.model
    if name.startswith("potential."):
        key = name.partition(".")[2]
        if not simulation.pairwise:
            return np.array(_quantities_of(model)[key], np.float64)
        return _plain(getattr(model.potential, key))
    if name == "cutoff.radius":
        return _plain(model.r_cut)
    if name == "cutoff.onset":
        return _plain(model.r_onset)
    if name == "dynamics.timestep":
        return np.asarray(float(simulation.integrator.timestep) / units.time_factor)
    if name == "dynamics.temperature":
        return np.asarray(float(simulation.system.spec.dynamics.temperature))
    if name == "dynamics.friction":
        assert isinstance(simulation.integrator, Langevin)
        return np.asarray(float(simulation.integrator.friction) * units.time_factor)
    if name == "initial.positions":
        return np.array(simulation.positions)
    if name == "initial.velocities":
        return np.array(simulation.velocities)
    assert name == "box.scale", name
    return np.asarray(1.0)


def with_values(simulation: Simulation, values: Mapping[str, Any]) -> Simulation:
    """The simulation with other values of some parameters.

    A temperature scales the velocities of step 0 with its root and sets that of a thermostat. A radius is a
    static part of compiled programs, so each new one compiles anew.

    Raises:
        InputError: a value that is not finite, or of another shape.
    """
    for name, given in values.items():
        new = np.asarray(given, np.float64)
        old = value(simulation, name)
        if new.shape != old.shape or not np.isfinite(new).all():
            raise InputError(
                f"{name}: shape {new.shape}, finite: {bool(np.isfinite(new).all())}; expected finite numbers "
                f"of shape {old.shape}"
            )
        simulation = _changed(simulation, name, new)
    return simulation


def _changed(simulation: Simulation, name: str, new: np.ndarray) -> Simulation:
    time = simulation.units.time_factor
    if name.startswith("potential.") and not simulation.pairwise:
        return _bound(simulation, name.partition(".")[2], new)
    if name.startswith("potential."):
        return _modelled(simulation, lambda m: getattr(m.potential, name.partition(".")[2]), new)
    if name == "cutoff.radius":
        radii = tuple(float(r) for r in np.atleast_1d(new))
        changed = _modelled(simulation, lambda m: m.r_cut, new)
        if not changed.model.cutoff.switches:
            changed = _modelled(changed, lambda m: m.r_onset, new)
        return replace(changed, decider=replace(simulation.decider, r_cut=radii))
    if name == "cutoff.onset":
        return _modelled(simulation, lambda m: m.r_onset, new)
    if name == "dynamics.timestep":
        return _integrated(simulation, "timestep", new * time)
    if name == "dynamics.friction":
        return _integrated(simulation, "friction", new / time)
    if name == "dynamics.temperature":
        return _heated(simulation, value(simulation, name), new)
    if name == "initial.positions":
        return replace(simulation, positions=new)
    if name == "initial.velocities":
        return replace(simulation, velocities=new)
    cell = Cell.create(np.asarray(simulation.cell.matrix) * float(new), simulation.pbc)
    return replace(simulation, positions=simulation.positions * float(new)).with_cell(cell)


def _modelled(simulation: Simulation, where: Callable[[CutPotential], Any], new: np.ndarray) -> Simulation:
    return replace(simulation, model=eqx.tree_at(where, simulation.model, _leaf(new)))


def _bound(simulation: Simulation, key: str, new: np.ndarray) -> Simulation:
    """A many-body potential with another constant or array; its radius may follow."""
    constant = key not in _leaves_by_path(simulation.model)
    model = _with_quantities(simulation.model, {key: float(new) if constant else jnp.asarray(new)})
    decider = replace(simulation.decider, r_cut=(float(model.r_cut),))
    return replace(simulation, model=model, decider=decider)


def _plain(leaf) -> Float[np.ndarray, "..."]:
    array = np.array(leaf, np.float64)
    return array.reshape(()) if array.shape == (1,) else array


def _leaf(array: np.ndarray):
    return jnp.asarray(np.atleast_1d(array), jnp.float64)


def _integrated(simulation: Simulation, name: str, new) -> Simulation:
    changed = eqx.tree_at(
        lambda one: getattr(one, name), simulation.integrator, jnp.asarray(new, jnp.float64)
    )
    return replace(simulation, integrator=changed)


def _heated(simulation: Simulation, old, new) -> Simulation:
    if not float(new) > 0 or not float(old) > 0:
        raise InputError(
            f"temperature {float(old):g} to {float(new):g}; expected both above 0", where="dynamics"
        )
    dynamics = simulation.system.spec.dynamics.model_copy(update={"temperature": float(new)})
    spec = simulation.system.spec.model_copy(update={"dynamics": dynamics})
    simulation = replace(
        simulation,
        system=replace(simulation.system, spec=spec),
        velocities=simulation.velocities * np.sqrt(float(new) / float(old)),
    )
    if isinstance(simulation.integrator, Langevin):
        simulation = _integrated(simulation, "kT", simulation.units.k_B * new)
    return simulation


def gradient(simulation: Simulation, parts: Cotangents, name: str) -> Float[np.ndarray, "..."]:
    """The derivative by a named parameter, from the derivatives by what a rollout is made of; of the shape
    that the parameter's value has."""
    units = simulation.units
    if name.startswith("potential.") and not simulation.pairwise:
        return np.array(parts.model[name.partition(".")[2]], np.float64)
    if name.startswith("potential."):
        return _plain(getattr(parts.model.potential, name.partition(".")[2]))
    if name == "cutoff.radius":
        onset = 0.0 if simulation.model.cutoff.switches else np.asarray(parts.model.r_onset)
        return _plain(np.asarray(parts.model.r_cut) + onset + parts.r_cut)
    if name == "cutoff.onset":
        return _plain(parts.model.r_onset)
    if name == "dynamics.timestep":
        return np.asarray(float(parts.integrator.timestep) * units.time_factor)
    if name == "dynamics.friction":
        assert isinstance(parts.integrator, Langevin)
        return np.asarray(float(parts.integrator.friction) / units.time_factor)
    if name == "dynamics.temperature":
        by_start = float(np.sum(parts.v * simulation.velocities.T)) / (2 * float(value(simulation, name)))
        bath = parts.integrator
        return np.asarray(by_start + (float(bath.kT) * units.k_B if isinstance(bath, Langevin) else 0.0))
    if name == "initial.positions":
        return parts.x.T.copy()
    if name == "initial.velocities":
        return parts.v.T.copy()
    assert name == "box.scale", name
    return np.asarray(parts.scale)
