"""Building of a simulation from a system file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
from pydantic import TypeAdapter, ValidationError

from mdnum.errors import InputError
from mdnum.md.integrators import INTEGRATORS
from mdnum.md.neighbors import RebuildRule
from mdnum.md.potentials import POTENTIALS, Channels, PairFunction
from mdnum.numerics import PrecisionPolicy
from mdnum.numerics.reductions import REDUCTIONS
from mdnum.store.files import SIMULATION_FILE, SYSTEM_FILE
from mdnum.store.folder import system_tables
from mdnum.systems import code, pairs, schema
from mdnum.systems.construct import assembled, cut, weights
from mdnum.systems.describe import described
from mdnum.systems.load import GIVE_OBJECTS, System, load
from mdnum.systems.simulation import Origin, Simulation
from mdnum.systems.structures import species_of
from mdnum.systems.toml import flat

if TYPE_CHECKING:
    from ase import Atoms

#: Keys of a description that do not affect the computation.
_ASKED = ("name", "about", "dynamics.steps", "record.save_every")
_CHANGE_OBJECTS = "Change the objects: mdnum.changed(simulation, {...})"


def interaction(potential: Mapping[str, Any], cutoff: Mapping[str, Any] | None) -> schema.Interaction:
    """Validate the tables of a potential and of its cutoff.

    Raises:
        InputError: the tables are not valid tables of a system file.
    """
    try:
        made = schema.Interaction(
            TypeAdapter(schema.Potential).validate_python(dict(potential)),
            None if cutoff is None else schema.CutoffTable.model_validate(dict(cutoff)),
        )
        schema.check_interaction(*made)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(first["msg"], where=".".join(str(part) for part in first["loc"])) from None
    except ValueError as error:
        raise InputError(str(error)) from None
    return made


def model_of(spec: schema.SystemSpec | schema.Interaction, atoms: Atoms, folder: Path) -> Any:
    """Create the potential that tables describe (a `CutPotential`, `Channels` or a many-body potential).

    Args:
        folder: folder of the files that the tables name.

    Raises:
        InputError: the potential has no constants for a chemical species of the structure.
    """
    if isinstance(spec, schema.SystemSpec) and spec.terms is not None:
        tables = spec.interactions
        return Channels.of_terms(
            {
                key: _pair_model(tables[key], atoms, folder, weights(one.weight, atoms, key))
                for key, one in spec.terms.items()
            }
        )
    if spec.cutoff is None:
        a, b, c = (bool(flag) for flag in atoms.pbc)
        return pairs.many_body(spec.potential, species_of(atoms)[0], folder, (a, b, c))
    return _pair_model(schema.Interaction(spec.potential, spec.cutoff), atoms, folder)


def _pair_model(tables: schema.Interaction, atoms: Atoms, folder: Path, own: tuple[Any, ...] = ()):
    table, cutoff = tables
    assert cutoff is not None
    species, _ = species_of(atoms)
    if isinstance(table, schema.PythonTable):
        potential = PairFunction(code.function(table.function, folder), **table.parameters)
    else:
        potential = POTENTIALS[table.kind](**jax.device_put(pairs.pair_constants(tables, species)))
    return cut(potential, cutoff.kind, species, *pairs.cutoff_radii(tables, species), weights=own)


def build(system: Simulation | System | str | Path, overrides: Mapping[str, Any] | None = None) -> Simulation:
    """Build a simulation from a system: a name, a file or an object.

    Example:
        >>> mdnum.build("argon/liquid-864", {"cutoff.kind": "switched"})

    Args:
        system: a loaded system, a name or path to load, or a simulation, which is returned as it is.
        overrides: overrides as for `load`, if a name or path is given.

    Raises:
        InputError: the cutoff and skin do not fit the box, or the file cannot be run.
    """
    if isinstance(system, Simulation):
        if overrides:
            raise InputError(
                "keys of a loaded system cannot be overridden", where=system.name, remedy=_CHANGE_OBJECTS
            )
        return system
    system = load(system, overrides, world="md")
    spec, units = system.spec, system.units
    dynamics, neighbors, precision = spec.dynamics, spec.neighbors, spec.precision
    policy = PrecisionPolicy(precision.state, precision.force, precision.decision, precision.accumulate)
    rebuild, fork = neighbors.rebuild, spec.fork
    return assembled(
        Origin(system.name, spec.about, system, {} if fork is None else fork.model_dump()),
        system.atoms,
        units,
        model_of(spec, system.atoms, system.folder),
        spec.compare,
        RebuildRule(spec.skin, rebuild.every, rebuild.delay, rebuild.check),
        neighbors.builder,
        policy,
        REDUCTIONS.parse(precision.reduction),
        INTEGRATORS[dynamics.kind].of_file(dynamics.model_dump(), units),
        system.draw,
        dynamics.steps,
        spec.record.save_every,
    )


def again(folder: Path, given: Simulation | None = None) -> Simulation:
    """Recreate the simulation that was run in a run folder.

    Args:
        given: the simulation; required if it was made from objects, of which the folder holds only a
            description.

    Raises:
        InputError: `given` is missing, is not needed, or is not the simulation that ran in this folder.
    """
    if not (folder / SIMULATION_FILE).is_file():
        if given is not None:
            message = "this run uses the system file in its folder"
            raise InputError(message, where=str(folder), remedy="Omit the simulation")
        return build(load(folder / SYSTEM_FILE))
    if given is None:
        load(folder)
    assert given is not None
    there, here = (flat(tables) for tables in (system_tables(folder / SIMULATION_FILE), described(given)))
    keys = [key for key in dict.fromkeys((*there, *here)) if key not in _ASKED]
    other = [key for key in keys if there.get(key) != here.get(key)]
    if other:
        seen = f"{other[0]} was {there.get(other[0])!r} and is {here.get(other[0])!r}"
        more = f", and so on: {', '.join(other[1:5])}" * (len(other) > 1)
        raise InputError(
            f"the given simulation differs from that in the folder: {seen}{more}",
            where=str(folder),
            remedy=GIVE_OBJECTS,
        )
    return given
