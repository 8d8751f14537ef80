"""Planted changes: what a test of two ensembles must see, and what it must not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np

from mdnum.forks.reordered import ShuffledSimulation
from mdnum.md.verlet import BUILDERS
from mdnum.systems.build import Simulation

_TIMESTEP = 1.025
_RADIUS = 0.96


@dataclass(frozen=True)
class Change:
    """A program that is changed on purpose.

    Attributes:
        name: of the change, in words.
        must_fail: whether it is another model; else only other rounding.
        simulation: the changed program.
        once: whether one verdict on it is enough, because its runs take long.
    """

    name: str
    must_fail: bool
    simulation: Simulation
    once: bool = False


def planted(a: Simulation) -> tuple[Change, ...]:
    """The changes that apply to a simulation: a longer time step and a shorter cutoff, which must fail;
    forces in the other precision, pairs in another order and lists by the other search, which must pass.

    The cutoff and the precision of a many-body potential cannot be changed, so those are left out.
    """
    longer = eqx.tree_at(lambda one: one.timestep, a.integrator, a.integrator.timestep * _TIMESTEP)
    search = next(name for name in BUILDERS if name != a.builder)
    changes = [Change("time step + 2.5 %", True, replace(a, integrator=longer))]
    if a.pairwise:
        changes.append(Change("cutoff - 4 %", True, shorter(a, _RADIUS)))
        other = "float32" if a.policy.dtype("force") == np.float64 else "float64"
        rounded = replace(a, policy=replace(a.policy, force=other))
        changes.append(Change(f"forces in {other}", False, rounded))
    changes.append(Change("pairs in another order", False, ShuffledSimulation.of(a, 1)))
    changes.append(Change(f"lists by {search}", False, replace(a, builder=search), once=True))
    return tuple(changes)


def shorter(a: Simulation, factor: float) -> Simulation:
    """The same simulation with all its cutoff radii, and where a switch sets in, scaled."""
    model = eqx.tree_at(
        lambda one: (one.r_cut, one.r_onset), a.model, (a.model.r_cut * factor, a.model.r_onset * factor)
    )
    radii = tuple(factor * r for r in a.decider.r_cut)
    return replace(a, model=model, decider=replace(a.decider, r_cut=radii))
