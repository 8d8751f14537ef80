"""What a gradient folder holds: its tables, large derivatives, and summary.json."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.gradients import parameters
from mdnum.gradients.diagnose.results import plain
from mdnum.md.potentials import pair_type
from mdnum.store import RunFolder
from mdnum.store.atomic import write_bytes
from mdnum.workflow.grad_words import LOSSES, unit_of_loss, unit_of_parameter

if TYPE_CHECKING:
    from mdnum.gradients.base import Gradient, Problem
    from mdnum.gradients.diagnose import Agreement, Diagnosis, Opinion, Trust
    from mdnum.systems.build import Simulation

#: Entries of a derivative that summary.json tells one by one.
_FEW = 6
#: File with the derivatives that have more, by "method/parameter".
ARRAYS = "gradients.npz"


def write(folder: RunFolder, found: Diagnosis) -> None:
    """Puts large derivatives into a folder, and tables of growth, trust, flips and ranges."""
    large = {
        f"{one.method}/{name}": np.asarray(value)
        for one in _agreement(found).opinions
        if one.found is not None
        for name, value in one.found.gradient.items()
        if np.ndim(value) > 1 or np.size(value) > _FEW
    }
    if large:
        sink = io.BytesIO()
        np.savez_compressed(sink, **large)  # type: ignore[arg-type]
        write_bytes(folder.path / ARRAYS, sink.getbuffer())
    if found.growth is not None:
        folder.append("growth", found.growth.table())
    if found.flips is not None and len(found.flips):
        folder.append("flip_contributions", found.flips.table())
    if found.trust is not None:
        folder.append("trust", found.trust.table())
    if found.scaling is not None:
        folder.append("scaling", found.scaling.table())


def summarize(problem: Problem, word: str, names: Sequence[str], found: Diagnosis) -> dict[str, Any]:
    """The content of summary.json, without headline and findings."""
    agreement = _agreement(found)
    simulation = problem.simulation
    units = simulation.units
    reference = agreement.gradient(agreement.reference)
    assert reference is not None
    return {
        "world": "grad",
        "question": "grad",
        "system": simulation.system.name,
        "about": simulation.system.spec.about,
        "atoms": simulation.atoms,
        "steps": problem.steps,
        "timestep": float(simulation.system.spec.dynamics.timestep),
        "units": units.name,
        "loss": {"word": word, "about": LOSSES[word].about, "unit": unit_of_loss(word, units)},
        "value": reference.value,
        "parameters": [
            {
                "name": name,
                "unit": unit_of_parameter(name, units),
                "value": told(parameters.value(simulation, name)),
                "entries": _entries(simulation, name),
            }
            for name in names
        ],
        "energy_jump": float(np.max(np.abs(simulation.jumps()[0]))),
        "force_jump": float(np.max(np.abs(simulation.jumps()[1]))),
        "reference": agreement.reference,
        "methods": [_method(one, one.found) for one in agreement.opinions if one.found is not None],
        "comparisons": [one.plain() for one in agreement.comparisons],
        "growth": None if found.growth is None else found.growth.plain(),
        "flips": None if found.flips is None else found.flips.plain(),
        "trust": None if found.trust is None else _trust(found.trust),
        "spectrum": None if found.spectrum is None else found.spectrum.plain(),
        "scaling": None if found.scaling is None else found.scaling.plain(),
        "edges": {name: one.plain() for name, one in found.edges.items()},
        "not_finite": None if found.not_finite is None else found.not_finite.plain(),
        "refused": [
            {"method": one.method, "why": one.missing} for one in agreement.opinions if one.found is None
        ],
        "findings": [],
        "status": "complete",
    }


def _agreement(found: Diagnosis) -> Agreement:
    assert found.agreement is not None, "a diagnosis was made without its methods"
    return found.agreement


def _entries(simulation: Simulation, name: str) -> list[str] | None:
    """Which pair each entry of a parameter belongs to; None where it has one entry, or one for each atom."""
    if (
        not simulation.pairwise
        or name.startswith("initial.")
        or not np.ndim(parameters.value(simulation, name))
    ):
        return None
    species = simulation.system.species
    found = [""] * simulation.pair_types
    for i, first in enumerate(species):
        for j, second in enumerate(species[i:], i):
            found[int(pair_type(np.array(i), np.array(j), len(species)))] = f"{first}-{second}"
    return found


def _trust(found: Trust) -> dict[str, Any]:
    """How far a gradient is trusted, without the rows of trust.parquet; derivatives as methods tell them."""
    half = {name: value[0] if len(value) == 1 else value.tolist() for name, value in found.half.items()}
    return {**found.plain(), "half": plain(half)}


def _method(opinion: Opinion, found: Gradient) -> dict[str, Any]:
    """What one method found, in plain values."""
    details = plain(found.details)
    return {
        "method": opinion.method,
        "says": found.says,
        "value": found.value,
        "gradient": {name: told(value) for name, value in found.gradient.items()},
        "error": details.pop("error", {}),
        "notes": dict(found.notes),
        "details": details,
        "seconds": opinion.seconds,
    }


def told(value: Any) -> Any:
    """A number, a few, or the size of many."""
    array = np.asarray(value, np.float64)
    if array.ndim == 0:
        return float(array)
    if array.ndim == 1 and array.size <= _FEW:
        return array.tolist()
    at = np.unravel_index(int(np.argmax(np.abs(array))), array.shape)
    return {
        "shape": list(array.shape),
        "norm": float(np.linalg.norm(array)),
        "largest": float(array[at]),
        "at": [int(place) for place in at],
    }
