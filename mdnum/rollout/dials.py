"""A number of a system that can be turned without compiling the program anew.

Constants of the potential, the cutoff's threshold, the time step and the start enter a compiled epoch as
arguments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.integrators import Langevin
from mdnum.md.neighbors import check_radius
from mdnum.registry import nearest
from mdnum.systems.build import Simulation

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
    """One number of a system.

    Attributes:
        key: its name, as system files have it where they do.
        value: what the system says, in the units of its file.
        turn: the simulation with another value, without compiling anew.
        positive: whether only values above 0 make sense.
    """

    key: str
    value: float
    turn: Turn
    positive: bool = True


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
    factor = simulation.units.time_factor
    integrator = simulation.integrator
    dials = [
        Dial("dynamics.timestep", float(integrator.timestep) / factor, _integrator("timestep", factor)),
        Dial("velocity.scale", 1.0, _scaled),
        Dial("neighbors.skin", simulation.rule.skin, _skin),
    ]
    if isinstance(integrator, Langevin):
        k_B = simulation.units.k_B
        friction = float(integrator.friction) * factor
        dials.append(Dial("dynamics.friction", friction, _integrator("friction", factor, inverse=True)))
        # velocities that are drawn are drawn at the temperature: then it is more than one number
        if simulation.system.velocities is not None:
            dials.append(Dial("dynamics.temperature", float(integrator.kT) / k_B, _integrator("kT", k_B)))
    if simulation.pairwise:
        dials += _constants(simulation) + _radii(simulation)
    return {one.key: one for one in dials}


def _number(value: float) -> Float[Array, ""]:
    # of a numpy number: a Python one would make another compiled program (a weak type)
    return jnp.asarray(np.float64(value))


def _integrator(name: str, factor: float, *, inverse: bool = False) -> Turn:
    def turn(simulation: Simulation, value: float) -> Simulation:
        inner = value / factor if inverse else value * factor
        changed = eqx.tree_at(lambda part: getattr(part, name), simulation.integrator, _number(inner))
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
    spec, species = simulation.system.spec, simulation.system.species
    in_sigma = spec.cutoff is not None and getattr(spec.cutoff, "in_sigma", None) is not None
    dials = []
    for name in vars(simulation.potential):
        if name == "sigma" and in_sigma:
            # the radius would move along
            continue
        leaf = np.asarray(getattr(simulation.potential, name))
        for kind, (i, j) in enumerate(zip(*np.triu_indices(len(species)), strict=True)):
            pair = "" if len(leaf) == 1 else f"pairs.{species[i]}-{species[j]}."
            value = float(leaf[kind])
            dials.append(Dial(f"potential.{pair}{name}", value, _constant(name, kind), value > 0))
    return dials


def _constant(name: str, kind: int) -> Turn:
    def turn(simulation: Simulation, value: float) -> Simulation:
        leaf = np.array(getattr(simulation.potential, name), np.float64)
        leaf[kind] = value
        model = eqx.tree_at(lambda m: getattr(m.potential, name), simulation.model, jnp.asarray(leaf))
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
