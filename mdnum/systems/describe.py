"""Conversion of a simulation to plain tables, which are stored, hashed and compared.

The tables have the keys of a system file, also for simulations made from objects.
"""

from __future__ import annotations

import hashlib
import inspect
import json
from pathlib import Path
from textwrap import dedent
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from mdnum.md.energies import EnergyFunction
from mdnum.md.manybody import leaves_by_path
from mdnum.md.potentials import CutPotential
from mdnum.numerics.reductions import BY_NAME
from mdnum.store.files import SIMULATION_FILE, write_text
from mdnum.systems.load import STRUCTURE_FILE
from mdnum.systems.schema import pair_names
from mdnum.systems.structures import to_extxyz

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation


def program(simulation: Simulation) -> dict[str, Any]:
    """Return all parameters of a simulation except its structure, as JSON-compatible tables."""
    rule, draw, policy = simulation.rule, simulation.draw, simulation.policy
    tables: dict[str, Any] = {
        "units": simulation.units.name,
        **_interactions(simulation),
        "neighbors": {
            "skin": rule.skin,
            "builder": simulation.builder,
            "rebuild": {"every": rule.every, "delay": rule.delay, "check": rule.check},
        },
        "dynamics": {
            "kind": simulation.integrator.name,
            "timestep": simulation.timestep,
            "steps": simulation.steps,
            "seed": draw.seed,
            "remove_drift": draw.remove_drift,
            "temperature": draw.temperature,
            **_dynamics(simulation),
        },
        "precision": {
            **{role: getattr(policy, role) for role in ("state", "force", "decision", "accumulate")},
            "reduction": reduction_word(simulation.reduction),
        },
        "record": {"save_every": simulation.save_every},
    }
    return {key: table for key, table in tables.items() if table is not None}


def described(simulation: Simulation) -> dict[str, Any]:
    """Return a description of a simulation's objects, with a digest of the initial state."""
    formula = simulation.structure.get_chemical_formula()
    return {
        "name": simulation.name,
        "about": simulation.origin.about,
        "structure": {"formula": formula, "digest": _start(simulation)},
        **program(simulation),
    }


def write(simulation: Simulation, folder: Path) -> None:
    """Write a simulation into a folder: its system file, or simulation.json and structure.extxyz."""
    if simulation.file is not None:
        simulation.file.write(folder)
        return
    atoms = simulation.structure.copy()
    atoms.set_positions(simulation.positions)
    atoms.set_velocities(simulation.velocities)
    write_text(folder / STRUCTURE_FILE, to_extxyz(atoms))
    text = json.dumps(described(simulation), indent=1, ensure_ascii=False)
    write_text(folder / SIMULATION_FILE, text + "\n")


def keys_of(a: Simulation, b: Simulation) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return tables of two simulations for comparison. Use the system files if both simulations have one."""
    files = [one.origin.system for one in (a, b)]
    if a.file is not None and None not in files:
        first, second = (one.spec.model_dump(mode="json") for one in files if one is not None)
        return first, second
    return program(a), program(b)


def reduction_word(reduction: Any) -> str:
    """Return a summation order's name in system files, or its representation if it has no name."""
    return next((word for word, known in BY_NAME.items() if known == reduction), repr(reduction))


def plain_leaf(leaf: Any) -> Any:
    """Represent an array by a number, a list of at most 64 numbers, or a digest."""
    array = np.asarray(leaf)
    if array.size == 1:
        return array.reshape(()).item()
    if array.size <= 64:
        return array.tolist()
    return f"sha256:{hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()} {array.shape}"


def by_pair(simulation: Simulation, leaf: Any) -> Any:
    """Return one number if all pair types agree, otherwise one number per pair of species."""
    values = np.asarray(leaf, np.float64)
    if len(set(values.tolist())) == 1:
        return float(values[0])
    return dict(zip(pair_names(simulation.symbols), values.tolist(), strict=True))


def _start(simulation: Simulation) -> str:
    """Compute the SHA-256 digest of the state at step 0."""
    sums = hashlib.sha256()
    arrays = (
        simulation.structure.numbers, simulation.masses, simulation.positions, simulation.velocities,
        np.asarray(simulation.cell.matrix), np.array(simulation.pbc),
    )  # fmt: skip
    for array in arrays:
        sums.update(f"{array.dtype.str} {array.shape}".encode())
        sums.update(np.ascontiguousarray(array).tobytes())
    return sums.hexdigest()


def _interactions(simulation: Simulation) -> dict[str, Any]:
    """Return the tables of the potential and its cutoff. A sum of potentials has a table per term."""
    model = simulation.model
    if not simulation.pairwise:
        known = {"kind": model.name, **_leaves(model)}
        if isinstance(model, EnergyFunction):
            how, notes = model.call.how, {code: json.loads(values) for code, values in model.notes or ()}
            known |= {
                "convention": how.label, "list": model.format,
                "units": ", ".join(model.unit) or "the system's",
                "coordinates": "fractional" if how.fractional else "real", "box": how.box or "its own",
                "imposable": model.trusts_list, "order": "of the structure" if model.labeled else "any",
                **({"notes": notes} if notes else {}), **_code(model.call.function),
            }  # fmt: skip
        return {"potential": known}
    tables = {name: _pair_tables(simulation, term) for name, term in model.terms.items()}
    return tables.get("", {"terms": tables})


def _pair_tables(simulation: Simulation, term: CutPotential) -> dict[str, Any]:
    potential, cutoff = term.potential, term.cutoff
    constants = {name: by_pair(simulation, leaf) for name, leaf in potential.leaves.items()}
    constants |= {
        name: dict(zip(simulation.symbols, np.asarray(leaf).tolist(), strict=True))
        for name, leaf in dict(potential.by_species).items()
    }
    constants |= _leaves(potential.shared) | _code(getattr(potential, "function", None))
    onset = {"onset": by_pair(simulation, term.r_onset)} if cutoff.switches else {}
    radius, compare = by_pair(simulation, term.r_cut), simulation.decider.compare
    return {
        "potential": {"kind": potential.name, **constants},
        "cutoff": {"kind": cutoff.name, "radius": radius, **onset, "compare": compare},
        **({"weight": plain_leaf(term.weights[0])} if term.weights else {}),
    }


def _leaves(tree: Any) -> dict[str, Any]:
    leaves = leaves_by_path(tree).items()
    return {name: plain_leaf(leaf) for name, leaf in leaves if eqx.is_array_like(leaf)}


def _code(function: Any) -> dict[str, Any]:
    """Return source code and digest of a user's function. Without source code, digest the bytecode."""
    if function is None:
        return {}
    try:
        source = dedent(inspect.getsource(function)).strip()
    except (OSError, TypeError):
        source = ""
    compiled = getattr(function, "__code__", None)
    hashed = source.encode() or repr(compiled and (compiled.co_code, compiled.co_consts)).encode()
    return {"code": {"source": source, "sha256": hashlib.sha256(hashed).hexdigest()}}


def _dynamics(simulation: Simulation) -> dict[str, Any]:
    integrator, units = simulation.integrator, simulation.units
    numbers = {key: integrator.number(key, units) for key in integrator.numbers() if key != "timestep"}
    words = (one.name for one in integrator.keys().values() if one.metadata.get("static"))
    return numbers | {name: getattr(integrator, name) for name in words}
