"""Numbers and words of a simulation by name: what they are, their units, and the simulation with others.

Names are the keys of system files where those have them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import ValidationError

from mdnum.errors import InputError
from mdnum.md.neighbors import check_radius
from mdnum.numerics.reductions import REDUCTIONS
from mdnum.numerics.roles import LATTICE
from mdnum.registry import nearest
from mdnum.systems import schema, structures, toml
from mdnum.systems.build import build
from mdnum.systems.construct import in_whole_numbers
from mdnum.systems.simulation import Simulation


def changed(simulation: Simulation, values: Mapping[str, Any]) -> Simulation:
    """The simulation with other values of some keys, checked.

    Args:
        values: dotted key to value. A key of the structure makes the atoms of a file again.

    Raises:
        InputError: a value that it could not have, or no such key.
    """
    system = simulation.file
    if system is None:
        for key, value in values.items():
            simulation = _with(simulation, key, value)
        return simulation
    data = system.spec.model_dump(mode="python", exclude_none=True)
    keys = {toml.dotted(key): value for key, value in values.items()}
    toml.apply_overrides(data, keys, schema.SystemSpec)
    try:
        spec = schema.SystemSpec.model_validate(data)
    except ValidationError as error:
        raise InputError(error.errors()[0]["msg"], where=", ".join(values)) from None
    atoms = system.atoms
    if any(key[0] == "structure" for key in keys):
        atoms = structures.make(spec.structure, spec.units, system.folder)
    return build(replace(system, spec=spec, atoms=atoms))


def redrawn(simulation: Simulation) -> Simulation:
    """The simulation with drawn velocities instead of those of its structure."""
    if simulation.file is not None:
        return changed(simulation, {"structure.velocities": "drawn"})
    draw = replace(simulation.draw, drawn=True)
    return replace(
        simulation, draw=draw, velocities=draw.velocities(simulation.masses, simulation.units, None)
    )


def floats(simulation: Simulation) -> dict[str, float]:
    """The numbers that are floats and enter a step, by their dotted keys."""
    if simulation.file is not None:
        data = simulation.file.spec.model_dump(mode="python", exclude_none=True, exclude={"fork"})
        return {key: value for key, value in toml.flat(data).items() if isinstance(value, float)}
    return {one.key: one.value for one in _fixed(simulation).values() if one.key != "velocity.scale"}


def _with(simulation: Simulation, key: str, value: Any) -> Simulation:
    """A simulation of objects with another value of one key."""
    table, _, name = key.partition(".")
    rule, draw = simulation.rule, simulation.draw
    if table == "precision":
        if name == "reduction":
            return replace(simulation, reduction=REDUCTIONS.parse(value))
        policy = replace(simulation.policy, **{name: value})
        if simulation.lattice is not None:
            raise InputError(
                "a state of whole numbers cannot become another", where=key, remedy="Make it again"
            )
        other = simulation.with_policy(policy)
        return in_whole_numbers(other) if policy.state == LATTICE else other
    if table == "neighbors" and name != "skin":
        word = name.rpartition(".")[2]
        if word == "builder":
            return replace(simulation, builder=value)
        return replace(simulation, rule=replace(rule, **{word: value}))
    if key == "cutoff.kind":
        return simulation.with_cutoff(value)
    if key == "cutoff.compare":
        return replace(simulation, decider=replace(simulation.decider, compare=value))
    if key == "dynamics.seed":
        draw, field = replace(draw, seed=value), simulation.integrator.keys().get("seed")
        if field is not None:
            at: Any = lambda one: getattr(one, field.name)  # noqa: E731
            integrator = eqx.tree_at(at, simulation.integrator, jax.random.key(value))
            simulation = replace(simulation, integrator=integrator)
        return redrawn(replace(simulation, draw=draw)) if draw.drawn else replace(simulation, draw=draw)
    if key == "dynamics.temperature":
        draw = replace(draw, temperature=float(value))
        if "temperature" in simulation.integrator.numbers():
            simulation = _integrator("temperature")(simulation, float(value))
        return redrawn(replace(simulation, draw=draw)) if draw.drawn else replace(simulation, draw=draw)
    return dial(simulation, key).turn(simulation, float(value))


# --- numbers that can be turned without compiling anew: arguments of the compiled epochs ---------------

Turn = Callable[[Simulation, float], Simulation]
_SHORT = {
    "timestep": "dynamics.timestep",
    "temperature": "dynamics.temperature",
    "friction": "dynamics.friction",
    "radius": "cutoff.radius",
    "r_cut": "cutoff.radius",
    "onset": "cutoff.onset",
    "dt": "dynamics.timestep",
}


@dataclass(frozen=True)
class Dial:
    """One number of a system."""

    key: str  # its name, as system files have it where they do
    value: float  # what the system says, in the units of its file
    turn: Turn  # the simulation with another value, without compiling anew
    positive: bool = True  # whether only values above 0 make sense


def dial(simulation: Simulation, key: str) -> Dial:
    """The number that a key names.

    Args:
        simulation: the system as objects.
        key: "dynamics.timestep", "potential.sigma" ("potential.pairs.Ni-P.sigma" for one pair of species),
            "cutoff.radius", "cutoff.onset", "neighbors.skin", "position.17.x", "velocity.17.x",
            "velocity.scale"; of Langevin dynamics also "dynamics.temperature" and "dynamics.friction". The
            last word alone will do where only one number ends so.

    Raises:
        InputError: no such number, or several; the known ones are listed.
    """
    dials = _fixed(simulation)
    word = _SHORT.get(key, key)
    found = [word] if word in dials else [name for name in dials if name.endswith(f".{word}")]
    if len(found) == 1:
        return dials[found[0]]
    if found:
        raise InputError(f"{key!r} could be any of {', '.join(found)}", remedy="Write one of them in full")
    started = _start(simulation, key)
    if started is not None:
        return started
    known = [*dials, "position.ATOM.x", "velocity.ATOM.x"]
    ends = {name.rpartition(".")[2]: name for name in dials}
    meant = nearest(key, [*known, *ends])
    hint = "" if meant is None else f"Did you mean {ends.get(meant, meant)}? "
    raise InputError(
        f"{key!r} is no number that can be turned", remedy=f"{hint}Use one of: {', '.join(known)}"
    )


def unit(simulation: Simulation, key: str) -> str:
    """The unit of a number in the user's words; empty for a pure number and where it is not known."""
    units, last = simulation.units, key.rpartition(".")[2]
    if key.startswith("velocity.") and last != "scale":
        return f"{units.length}/{units.time}"
    if key.startswith(("position.", "cutoff.")) or last in ("sigma", "skin"):
        return units.length
    named = {
        "timestep": units.time,
        "friction": f"1/{units.time}",
        "temperature": units.temperature,
        "epsilon": units.energy,
    }
    return named.get(last, "")


def names(simulation: Simulation) -> tuple[str, ...]:
    """The keys of a system, those of single coordinates aside."""
    return tuple(_fixed(simulation))


def _fixed(simulation: Simulation) -> dict[str, Dial]:
    integrator, units = simulation.integrator, simulation.units
    # velocities that are drawn are drawn at the temperature: then it is more than one number
    drawn = simulation.draw.drawn
    keys = [key for key in integrator.numbers() if not (drawn and key == "temperature")]
    first, *others = [
        Dial(f"dynamics.{key}", integrator.number(key, units), _integrator(key)) for key in keys
    ]
    dials = [
        first,
        Dial("velocity.scale", 1.0, _scaled),
        Dial("neighbors.skin", simulation.rule.skin, _skin),
        *others,
    ]
    if simulation.pairwise:
        dials += _constants(simulation) + _radii(simulation)
    return {one.key: one for one in dials}


def _integrator(key: str) -> Turn:
    def turn(simulation: Simulation, value: float) -> Simulation:
        changed = simulation.integrator.with_number(key, value, simulation.units)
        return replace(simulation, integrator=changed)

    return turn


def _skin(simulation: Simulation, value: float) -> Simulation:
    """Another skin: another list, hence another order of the same sums from the first rebuild on."""
    check_radius(simulation.cell, simulation.r_cut, value)
    return replace(simulation, rule=replace(simulation.rule, skin=value))


def _scaled(simulation: Simulation, value: float) -> Simulation:
    return replace(simulation, velocities=simulation.velocities * value)


def _constants(simulation: Simulation) -> list[Dial]:
    """Constants of the potential: one for each, or one for each and pair of species."""
    dials = []
    for name, values in simulation.potential.leaves.items():
        if name == "sigma" and simulation.in_sigma:
            # the radius would move along
            continue
        leaf = np.asarray(values)
        for kind, name_of_pair in enumerate(schema.pair_names(simulation.symbols)):
            pair = "" if len(leaf) == 1 else f"pairs.{name_of_pair}."
            value = float(leaf[kind])
            dials.append(Dial(f"potential.{pair}{name}", value, _constant(name, kind), value > 0))
    return dials


def _constant(name: str, kind: int) -> Turn:
    def turn(simulation: Simulation, value: float) -> Simulation:
        leaf = np.array(simulation.potential.leaves[name], np.float64)
        leaf[kind] = value
        model = eqx.tree_at(lambda m: m.potential.leaves[name], simulation.model, jnp.asarray(leaf))
        return replace(simulation, model=model)

    return turn


def _radii(simulation: Simulation) -> list[Dial]:
    radii = simulation.decider.r_cut
    if len(set(radii)) > 1:
        return []
    dials = [Dial("cutoff.radius", radii[0], _radius)]
    if simulation.cutoff.switches:
        dials.append(Dial("cutoff.onset", float(np.asarray(simulation.model.r_onset)[0]), _onset))
    return dials


def _onset(simulation: Simulation, value: float) -> Simulation:
    if value >= simulation.r_cut:
        raise InputError(f"an onset of {value!r} is not below the cutoff radius {simulation.r_cut!r}")
    leaf = jnp.full_like(simulation.model.r_onset, np.float64(value))
    return replace(simulation, model=eqx.tree_at(lambda m: m.r_onset, simulation.model, leaf))


def _radius(simulation: Simulation, value: float) -> Simulation:
    """Another cutoff radius; the onset of switching stays where it is."""
    check_radius(simulation.cell, value, simulation.rule.skin)
    model = simulation.model
    if simulation.cutoff.switches and value <= float(np.max(model.r_onset)):
        onset = float(np.max(model.r_onset))
        raise InputError(f"a cutoff radius of {value!r} is not above its onset, {onset!r}")
    leaf = jnp.full_like(model.r_cut, np.float64(value))
    model = eqx.tree_at(lambda m: m.r_cut, model, leaf)
    if not simulation.cutoff.switches:
        model = eqx.tree_at(lambda m: m.r_onset, model, leaf)
    decider = replace(simulation.decider, r_cut=(float(value),) * len(simulation.decider.r_cut))
    return replace(simulation, model=model, decider=decider)


def _start(simulation: Simulation, key: str) -> Dial | None:
    parts = key.split(".")
    if len(parts) != 3 or parts[0] not in ("position", "velocity") or parts[2] not in ("x", "y", "z"):
        return None
    if not parts[1].isdigit() or int(parts[1]) >= simulation.atoms:
        raise InputError(
            f"{key!r}: there is no atom {parts[1]}", remedy=f"Use an atom from 0 to {simulation.atoms - 1}"
        )
    place = int(parts[1]), "xyz".index(parts[2])
    name, factor = (
        ("positions", 1.0) if parts[0] == "position" else ("velocities", simulation.units.time_factor)
    )

    def turn(simulation: Simulation, value: float) -> Simulation:
        array = getattr(simulation, name).copy()
        array[place] = value / factor
        return replace(simulation, **{name: array})

    return Dial(key, float(getattr(simulation, name)[place]) * factor, turn, positive=False)
