"""Parameters of a simulation: paths, values, units, and changes of values.

A parameter is a number or an array of numbers. The name of a parameter is a path. Paths are keys of a system
file ("potential.sigma", "cutoff.radius", "dynamics.timestep"). Other paths lead to a component of a potential
("potential.layers.0.weight"). A single array entry is also a parameter, such as "potential.pairs.Ni-P.sigma"
or "position.17.x". Further examples are "velocity.17.x" and "potential.layers.0.weight.3.2" (a path with
indices).

`dynamics.temperature` is the temperature of the thermostat. Drawn velocities scale with the square root of
temperature. Velocities from a file do not change. `velocity.scale` scales all initial velocities. For a
cutoff without switching, the onset equals `cutoff.radius`. `box.scale` scales lattice vectors and positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import ValidationError

from mdnum.errors import InputError
from mdnum.md.cell import Cell
from mdnum.md.manybody import leaves_by_path, quantities_of, with_quantities
from mdnum.md.neighbors import check_radius
from mdnum.md.potentials import Channels, CutPotential
from mdnum.numerics.reductions import REDUCTIONS
from mdnum.numerics.roles import FIXED_POINT
from mdnum.registry import meant
from mdnum.systems import schema, structures, toml
from mdnum.systems.build import build
from mdnum.systems.construct import in_fixed_point
from mdnum.systems.load import System
from mdnum.systems.simulation import Simulation

#: Alternative names of parameters.
_ALIASES = {
    "r_cut": "cutoff.radius", "r_onset": "cutoff.onset", "dt": "dynamics.timestep",
    "x0": "initial.positions", "v0": "initial.velocities", "scale": "box.scale", "box": "box.scale",
}  # fmt: skip
#: Units by the last word of a name, or by the kind of a field of an integrator.
_UNITS = {
    "sigma": "{length}", "epsilon": "{energy}", "depth": "{energy}", "r0": "{length}", "skin": "{length}",
    "radius": "{length}", "onset": "{length}", "time": "{time}", "temperature": "{temperature}",
    "rate": "1/{time}", "scale": "", "positions": "{length}", "velocities": "√({energy}/{mass})", None: "",
    "velocity": "{length}/{time}", "species": "", "pressure": "{pressure}", "compressibility": "1/{pressure}",
}  # fmt: skip


@dataclass(frozen=True, repr=False)
class Parameter:
    """A parameter of a simulation: a number or an array of numbers.

    Attributes:
        value: value in `unit`; of shape (), or with an entry for each of `by`, or of the shape of an array
            that all pairs share.
        unit: unit in the unit system of the simulation; "" for a pure number, and for example "[alpha]" for
            an alpha whose unit is not known. For initial velocities: length per internal time.
        by: "pair type", "species" or "atom"; "" for a single value or a shared array.
    """

    value: Float[np.ndarray, "..."]
    unit: str
    by: str

    def __repr__(self) -> str:
        few = self.value.size <= 3
        value = f"{self.value.tolist()!r}" if few else f"shape {self.value.shape}"
        return f"Parameter({value}{self.unit and f' {self.unit}'}{self.by and f', by {self.by}'})"


def parameters(simulation: Simulation) -> dict[str, Parameter]:
    """Return all parameters of a simulation by path. The function `changed` changes parameter values.

    Example:
        >>> mdnum.parameters(sim)["potential.sigma"].value
        >>> mdnum.changed(sim, {"potential.sigma": 3.41, "dynamics.timestep": 0.001})
    """
    return {
        name: Parameter(value(simulation, name), unit(simulation, name), by(simulation, name))
        for name in names(simulation)
    }


def names(simulation: Simulation) -> tuple[str, ...]:
    """Return the paths of all parameters. Single array entries are omitted."""
    model, draw = simulation.model, simulation.draw
    if simulation.pairwise:
        found = list(pair_leaves(model))
    else:
        found = [f"potential.{key}" for key in quantities_of(model)]
    keys = dict.fromkeys(("timestep", *["temperature"] * draw.drawn, *simulation.integrator.numbers()))
    start = ("initial.positions", "initial.velocities", "box.scale", "velocity.scale", "neighbors.skin")
    return (*found, *(f"dynamics.{key}" for key in keys), *start)


def numbers(simulation: Simulation) -> tuple[str, ...]:
    """Return the paths of all scalar parameters. Single coordinates and weights are omitted."""
    file = simulation.origin.system
    # as its file has it the radius would move along with sigma
    ends = [] if file is None else [one.cutoff for one in file.spec.interactions.values()]
    moving = "sigma" if any(end and end.in_sigma is not None for end in ends) else None
    found = (*names(simulation), *_of_pairs(simulation))
    return tuple(name for name in found if _is_number(simulation, name) and name.rpartition(".")[2] != moving)


def _is_number(simulation: Simulation, name: str) -> bool:
    here = value(simulation, name)
    # a radius of all pairs is one
    return here.ndim == 0 or ("cutoff." in name and bool(np.all(here == here[0])))


def number(simulation: Simulation, name: str) -> float:
    """Return the value of a scalar parameter, given its path (one of `numbers`)."""
    return float(value(simulation, name).flat[0])


def with_number(simulation: Simulation, name: str, given: float) -> Simulation:
    """Return the simulation with a changed scalar parameter, without compiling its functions again."""
    return with_values(simulation, {name: np.full(value(simulation, name).shape, given)})


def is_positive(simulation: Simulation, name: str) -> bool:
    """Return True if a parameter must be positive."""
    whole = entry(simulation, name).whole
    if "potential." in whole:
        return _is_typed(simulation, whole) and number(simulation, name) > 0
    return not (whole.startswith("initial.") or is_weight(whole))


def by(simulation: Simulation, name: str) -> str:
    """Return what each entry of a parameter belongs to: "pair type", "species", "atom" or ""."""
    if name.startswith("initial.") or is_weight(name):
        return "atom"
    if not _is_typed(simulation, name) or simulation.pair_types == 1:
        return ""
    return "species" if name in _by_species(simulation) else "pair type"


def is_weight(name: str) -> bool:
    """Return True if a path refers to atom weights in a term of the potential."""
    return name.startswith("terms.") and name.split(".")[2:] == ["weight"]


def _is_typed(simulation: Simulation, name: str) -> bool:
    return simulation.pairwise and name in pair_leaves(simulation.model, shared=False)


def _by_species(simulation: Simulation) -> set[str]:
    """Return the paths of parameters that have one entry for each chemical species."""
    every = pair_leaves(simulation.model, shared=False)
    return set(every) - set(pair_leaves(simulation.model, shared=False, species=False))


def unit(simulation: Simulation, name: str) -> str:
    """Return the unit of a parameter: "" for a pure number, "[name]" if unknown."""
    table, whole = name.partition(".")[0], entry(simulation, name).whole
    last = whole.rpartition(".")[2]
    field = simulation.integrator.keys().get(last) if table == "dynamics" else None
    word = last if field is None else field.metadata.get("unit")
    word = "velocity" if table == "velocity" and last == "velocities" else word
    known = "" if is_weight(whole) else _UNITS.get(word, f"[{last}]")
    return known.format_map(vars(simulation.units))


def value(simulation: Simulation, name: str) -> Float[np.ndarray, "..."]:
    """Return the value of a parameter, a scalar if there is only one pair type."""
    place = entry(simulation, name)
    if place.index:
        return np.asarray(value(simulation, place.whole)[place.index] * place.factor)
    table, _, key = name.partition(".")
    if table in ("potential", "cutoff", "terms"):
        array = np.array(leaf_of(simulation.model, name), np.float64)
        return array.reshape(()) if array.shape == (1,) and _is_typed(simulation, name) else array
    if name == "dynamics.temperature" and simulation.draw.temperature:
        return np.asarray(float(simulation.draw.temperature))
    if table == "dynamics":
        known = key in simulation.integrator.numbers()
        return np.asarray(simulation.integrator.number(key, simulation.units) if known else 0.0)
    if table == "initial":
        return np.array(getattr(simulation, key))
    return np.asarray(simulation.rule.skin if key == "skin" else 1.0)


def leaf_of(model: Any, name: str) -> Any:
    """Return the array of a parameter of a potential or of its cutoff."""
    if not isinstance(model, CutPotential | Channels):
        return quantities_of(model)[name.removeprefix("potential.")]
    return pair_leaves(model)[name]


def pair_leaves(model: CutPotential | Channels, shared: bool = True, species: bool = True) -> dict[str, Any]:
    """Return the parameter arrays of pair potentials and of their cutoffs, by path.

    `shared` adds arrays that do not depend on the pair type. `species` adds arrays with one entry per
    species. If all cutoff radii are equal, the path is `cutoff.radius`. If cutoff radii differ, each term has
    its own path. Terms with equal cutoff radii share one array.
    """
    found: dict[str, Any] = {}
    for part in model.parts:
        every = len(model.parts) == 1 < len(part.rows)
        ends = {"cutoff.radius": part.r_cut} if every else {}
        for name, potential, end, onset, weight in part.rows:
            term = f"terms.{name}." if name else ""
            own = {**potential.leaves, **(dict(potential.by_species) if species else {})}
            own |= leaves_by_path(potential.shared) if shared else {}
            found |= {f"{term}potential.{key}": leaf for key, leaf in own.items()}
            found |= {f"{term}weight": weight} if shared and weight is not None else {}
            ends |= {f"{term}cutoff.radius": part.r_cut}
            ends |= {f"{term}cutoff.onset": onset} if end.switches else {}
        found |= ends
    return found


def shared_radius(model: Any, name: str) -> tuple[str, ...]:
    """Return the potential terms that share the cutoff radius at a path. Empty for one term."""
    table, term, key = (*name.split(".", 2), "", "")[:3]
    if table != "terms" or key != "cutoff.radius":
        return ()
    each = ([row[0] for row in part.rows] for part in getattr(model, "parts", ()))
    names = next((names for names in each if term in names), ())
    return tuple(names) if len(names) > 1 else ()


def with_values(simulation: Simulation, values: Mapping[str, Any]) -> Simulation:
    """Return the simulation with other parameter values, without the checks of system files.

    Raises:
        InputError: a value is not finite, is complex, has the wrong shape, or is not allowed.
    """
    for name, given in values.items():
        here, new = value(simulation, name), np.asarray(given)
        if new.shape != here.shape or np.iscomplexobj(new) or not np.isfinite(new).all():
            raise InputError(
                f"the new value of {name} has shape {new.shape} and type {new.dtype} (all numbers finite: "
                f"{bool(np.isfinite(new).all())}); expected finite real numbers of shape {here.shape}"
            )
        place = entry(simulation, name)
        whole = value(simulation, place.whole)
        whole[place.index] = new / place.factor
        simulation = _with(simulation, place.whole, whole)
    return simulation


def _with(simulation: Simulation, name: str, new: np.ndarray) -> Simulation:
    """Return the simulation with another value of a parameter, without a check of its shape."""
    table, _, key = name.partition(".")
    model, integrator = simulation.model, simulation.integrator
    if table == "potential" and not simulation.pairwise:
        constant = key not in leaves_by_path(model)
        model = with_quantities(model, {key: float(new) if constant else jnp.asarray(new)})
        # its radius may follow
        return simulation.with_model(model)
    if table in ("potential", "cutoff", "terms"):
        leaf = jnp.asarray(new.reshape(leaf_of(model, name).shape))
        if shared_radius(model, name):
            simulation = simulation.apart
            model = simulation.model
        model = eqx.tree_at(lambda one: leaf_of(one, name), model, leaf)
        if "cutoff." not in name:
            return replace(simulation, model=model)
        if table == "cutoff" and not model.cutoff.switches and "" in model.terms:
            model = eqx.tree_at(lambda one: one.r_onset, model, leaf)
        for term in model.terms.values():
            radius, onset = np.asarray(term.r_cut), np.asarray(term.r_onset)
            if term.cutoff.switches and np.any(onset >= radius):
                seen = f"the switching onset {float(np.max(onset))!r} is not below"
                raise InputError(f"{seen} the cutoff radius {float(np.min(radius))!r}", where=name)
        return simulation.with_model(model)
    if table == "dynamics":
        if key in integrator.numbers():
            simulation = replace(simulation, integrator=integrator.with_number(key, new, simulation.units))
        return _heated(simulation, float(new)) if key == "temperature" else simulation
    if table == "initial":
        return replace(simulation, **{key: new})
    if name == "velocity.scale":
        return replace(simulation, velocities=simulation.velocities * float(new))
    if name == "box.scale":
        cell = Cell.create(np.asarray(simulation.cell.matrix) * float(new), simulation.pbc)
        return replace(simulation, positions=simulation.positions * float(new)).with_cell(cell)
    # another skin: another list, hence another order of the same sums from the first rebuild on
    check_radius(simulation.cell, simulation.r_cut, float(new))
    return replace(simulation, rule=replace(simulation.rule, skin=float(new)))


def _heated(simulation: Simulation, new: float) -> Simulation:
    """Set the temperature of initial velocities. Velocities are drawn again or scaled."""
    old = simulation.draw
    heated = replace(simulation, draw=replace(old, temperature=new))
    if not (old.temperature and old.drawn) and "temperature" in simulation.integrator.numbers():
        # of the thermostat alone
        return simulation if old.drawn else heated
    if np.array_equal(_drawn(simulation).velocities, simulation.velocities):
        return _drawn(heated)
    if not (new > 0 and old.temperature > 0):
        seen = f"a change of temperature from {old.temperature:g} to {new:g}"
        raise InputError(f"{seen}; expected two temperatures above 0", where="dynamics")
    return replace(heated, velocities=simulation.velocities * np.sqrt(new / old.temperature))


# --- names -------------------------------------------------------------------------------------------


class Entry(NamedTuple):
    """Parameter, array index and unit conversion factor that belong to a path."""

    whole: str  # path of the parameter
    index: tuple[int, ...] = ()  # which of its entries; empty for all of it
    factor: float = 1.0  # of the unit of the entry


def entry(simulation: Simulation, name: str) -> Entry:
    """Find the parameter or array entry of a path. An unknown path is returned unchanged."""
    if (of_pair := _of_pairs(simulation).get(name)) is not None:
        return of_pair
    table, *at = name.split(".")
    if table in ("position", "velocity") and len(at) == 2 and at[1] in ("x", "y", "z"):
        if not at[0].isdigit() or int(at[0]) >= simulation.atoms:
            remedy = f"Use an atom from 0 to {simulation.atoms - 1}"
            raise InputError(f"{name!r}: there is no atom {at[0]}", remedy=remedy)
        whole = "initial.positions" if table == "position" else "initial.velocities"
        factor = 1.0 if table == "position" else simulation.units.time_factor
        return Entry(whole, (int(at[0]), "xyz".index(at[1])), factor)
    known, parts = names(simulation), name.split(".")
    for k in range(len(parts) - 1, 0, -1):
        whole, index = ".".join(parts[:k]), parts[k:]
        if whole in known and all(one.isdigit() for one in index):
            shape, at = value(simulation, whole).shape, tuple(map(int, index))
            if len(at) == len(shape) and all(one < size for one, size in zip(at, shape, strict=True)):
                return Entry(whole, at)
    return Entry(name)


def _of_pairs(simulation: Simulation) -> dict[str, Entry]:
    """Return the paths of entries by species or pair of species. Empty for a single species."""
    if not simulation.pairwise or simulation.pair_types == 1:
        return {}
    single = _by_species(simulation)
    typed = [name for name in pair_leaves(simulation.model, shared=False) if "potential." in name]
    pairs = schema.pair_names(simulation.symbols)
    return {
        name.replace("potential.", f"potential.{'species' if name in single else 'pairs'}.{of}.", 1): Entry(
            name, (k,)
        )
        for name in typed
        for k, of in enumerate(simulation.symbols if name in single else pairs)
    }


def resolve(simulation: Simulation, word: str, known: Sequence[str]) -> str:
    """Return the path of a parameter, given its path, an alias or an unambiguous ending.

    Args:
        word: a path, an alias such as "r_cut" or "dt", or an ending that only one path has.

    Raises:
        InputError: no parameter matches, or several do; the message lists the known parameters.
    """
    full = _ALIASES.get(word, word)
    for name in (word, full):
        if name in known:
            return name
    for paths in (known, tuple(_of_pairs(simulation))):
        ends = [name for name in paths if name.endswith(f".{word}")]
        if len(ends) == 1:
            return ends[0]
        if ends:
            several = f"{word!r} is ambiguous: it could be any of {', '.join(ends)}"
            raise InputError(several, remedy="Give the full name of a parameter, such as potential.sigma")
    if entry(simulation, word).index:
        return word
    hint = meant(word, [*known, *(name.rpartition(".")[2] for name in known)]) + "Choose from "
    listed = ", ".join((*known, "position.ATOM.x", "velocity.ATOM.x"))
    raise InputError(f"unknown parameter {word!r}", where=simulation.name, remedy=f"{hint}{listed}")


# --- keys of system files, words among them ------------------------------------------------------------


def changed(simulation: Simulation, values: Mapping[str, Any]) -> Simulation:
    """Change values of system-file keys or parameters. Return the new, validated simulation.

    A simulation from a system file is rebuilt with the new values. If a changed parameter has no system-file
    key, the new simulation has no system file.

    Example:
        >>> mdnum.changed(sim, {"cutoff.radius": 9.0, "precision.force": "float32"})
        >>> mdnum.changed(sim, {"potential.layers.0.weight": weight, "position.17.x": 0.5})

    Args:
        values: path to value. A new value of a structure key creates the atoms of a file again.

    Raises:
        InputError: a value is not allowed, or a key does not exist.
    """
    keys: dict[str, Any] = {}
    if simulation.file is not None:
        has, here = toml.flat(simulation.file.spec.model_dump()), names(simulation)
        keys = {
            key: given for key, given in values.items()
            if (key in has and not np.ndim(given)) or not (key in here or entry(simulation, key).index)
        }  # fmt: skip
        simulation = _of_file(simulation.file, keys) if keys else simulation
    for key in (key for key in values if key not in keys):
        simulation = _changed(simulation, key, values[key])
    return simulation


def _of_file(system: System, values: Mapping[str, Any]) -> Simulation:
    data = system.spec.model_dump(mode="python", exclude_none=True)
    keys = {toml.dotted(key): given for key, given in values.items()}
    toml.apply_overrides(data, keys, schema.SystemSpec)
    try:
        spec = schema.SystemSpec.model_validate(data)
    except ValidationError as error:
        raise InputError(error.errors()[0]["msg"], where=", ".join(values)) from None
    atoms = system.atoms
    if any(key[0] == "structure" for key in keys):
        atoms = structures.make(spec.structure, spec.units, system.folder)
    return build(replace(system, spec=spec, atoms=atoms))


def _changed(simulation: Simulation, key: str, given: Any) -> Simulation:
    """Change one key in a simulation that was made from objects."""
    table, _, name = key.partition(".")
    if key == "precision.reduction":
        return replace(simulation, reduction=REDUCTIONS.parse(given))
    if table == "precision":
        policy = replace(simulation.policy, **{name: given})
        if simulation.fixed_point is not None:
            message = "a fixed-point state cannot be converted to another type"
            raise InputError(message, where=key, remedy="Create the simulation again")
        other = simulation.with_policy(policy)
        return in_fixed_point(other) if policy.state == FIXED_POINT else other
    if key == "neighbors.builder":
        return replace(simulation, builder=given)
    if key.startswith("neighbors.rebuild."):
        return replace(simulation, rule=replace(simulation.rule, **{name.rpartition(".")[2]: given}))
    if key == "cutoff.kind":
        return simulation.with_cutoff(given)
    if key == "cutoff.compare":
        return replace(simulation, decider=replace(simulation.decider, compare=given))
    if key == "dynamics.seed":
        simulation = replace(simulation, draw=replace(simulation.draw, seed=given))
        if (integrator := simulation.integrator).random is not None:
            integrator = eqx.tree_at(lambda one: one.random, integrator, jax.random.key(given))
            simulation = replace(simulation, integrator=integrator)
        return redrawn(simulation) if simulation.draw.drawn else simulation
    name = resolve(simulation, key, names(simulation))
    one = np.ndim(given) == 0 and _is_number(simulation, name)
    made = with_number(simulation, name, given) if one else with_values(simulation, {name: given})
    if table != "terms" or "cutoff." not in name:
        return made
    # radii that agree now, or no longer
    return made.with_model(Channels.of_terms(made.model.terms))


def redrawn(simulation: Simulation) -> Simulation:
    """Return the simulation with randomly drawn velocities."""
    if simulation.file is not None:
        return changed(simulation, {"structure.velocities": "drawn"})
    return _drawn(replace(simulation, draw=replace(simulation.draw, drawn=True)))


def _drawn(simulation: Simulation) -> Simulation:
    v = simulation.draw.velocities(simulation.masses, simulation.units, None)
    return replace(simulation, velocities=v)


def floats(simulation: Simulation) -> dict[str, float]:
    """Return the floating-point numbers in the settings of a simulation, by dotted key."""
    if simulation.file is not None:
        data = simulation.file.spec.model_dump(mode="python", exclude_none=True, exclude={"fork"})
        return {key: value for key, value in toml.flat(data).items() if isinstance(value, float)}
    found = (name for name in numbers(simulation) if name not in ("velocity.scale", "box.scale"))
    return {name: number(simulation, name) for name in found}
