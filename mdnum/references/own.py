"""The searches that a run stands on, as finders: mdnum's force loop, its list builders, and jax-md's list."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from ase import Atoms
from numpy import ndarray

from mdnum import systems
from mdnum.references.finders import PEERS, Finder, Found, Search
from mdnum.systems import System


def all_finders(system: System) -> tuple[Finder, ...]:
    """mdnum's own searches with the convention of a system, and every peer."""
    return (*own_finders(system), *PEERS)


def own_finders(system: System) -> tuple[Finder, ...]:
    """What mdnum uses for this system, and jax-md's list by itself.

    "mdnum force loop" is the set of decisions that multiply the forces, out of jit. The other two of mdnum's
    are its list builders with the same decision made on the host. "jax-md" is its list with no skin.
    """
    compare = system.spec.cutoff.compare if system.spec.cutoff is not None else "r <"
    dtype = system.spec.precision.decision
    unit = 2.0**-24 if "float32" in (dtype, system.spec.precision.state) else 2.0**-53
    return (
        Finder("mdnum force loop", "mdnum", _force_loop(system), unit, images=False, ours=True),
        Finder("mdnum, host list", "mdnum", _listed("host", compare, dtype), unit, images=False, ours=True),
        Finder(
            "mdnum, jax-md list",
            "mdnum",
            _listed("jax-md", compare, dtype),
            unit,
            images=False,
            ours=True,
            affords=0,
        ),
        Finder("jax-md", "jax-md", _listed("jax-md", None, "float64"), images=False, affords=12),
    )


def _force_loop(system: System) -> Search:
    built: dict[Any, Any] = {}

    def search(positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float) -> Found:
        key = (len(positions), pbc.tobytes(), r_cut)
        if key not in built:
            built[key] = systems.build(_variant(system, positions, cell, pbc, r_cut))
        evaluation = built[key].evaluate(positions, cell)
        return np.asarray(evaluation.i), np.asarray(evaluation.j), np.asarray(evaluation.distance)

    return search


def _variant(system: System, positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float) -> System:
    """The system itself, or two atoms of it with r_cut for all pairs, without a skin to ask for room."""
    spec = system.spec
    spec = spec.model_copy(update={"neighbors": spec.neighbors.model_copy(update={"skin": 0.0})})
    if len(positions) == len(system.atoms):
        atoms = Atoms(numbers=system.atoms.numbers, positions=positions, cell=cell, pbc=pbc)
        return replace(system, spec=spec, atoms=atoms)
    # the pair of species whose radius r_cut is; a pair at the cutoff is far from any core
    a, b = _species_with(system, r_cut)
    return replace(system, spec=spec, atoms=Atoms([a, b], positions=positions, cell=cell, pbc=pbc))


def _species_with(system: System, r_cut: float) -> tuple[str, str]:
    if system.spec.cutoff is None:
        return system.species[0], system.species[0]
    radius, _ = systems.pairs.cutoff_radii(system.spec, system.species)
    a, b = np.argwhere(radius == r_cut)[0]
    return system.species[a], system.species[b]


def _listed(builder: str, compare: str | None, dtype: str) -> Search:
    def search(positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float) -> Found:
        from mdnum.md.cell import Cell, displacement, wrap_positions
        from mdnum.md.decide import PairDecider
        from mdnum.md.verlet import BUILDERS, RebuildRule, VerletList

        box = Cell.create(cell, pbc)  # type: ignore[arg-type]  (one flag or one per axis)
        wrapped, _ = wrap_positions(box, positions)
        rows = VerletList(BUILDERS[builder], RebuildRule(0.0), r_cut).build(wrapped, box).unsorted()
        i, slot = np.nonzero(rows < len(positions))
        j = rows[i, slot]
        i, j = i[i < j], j[i < j]
        d = displacement(box, wrapped[i], wrapped[j], getattr(np, dtype))
        distance = np.sqrt(sum(np.asarray(c, np.float64) ** 2 for c in d))
        if compare is None:
            return i, j, distance
        decider = PairDecider((r_cut,), compare, dtype)
        quantity, threshold = decider.host_quantity(*d), decider.thresholds[0].value
        keep = quantity <= threshold if compare.endswith("<=") else quantity < threshold
        return i[keep], j[keep], distance[keep]

    return search
