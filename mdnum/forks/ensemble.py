"""Measure properties of perturbed runs, and change programs to validate the statistical test.

Every property (feature) is a continuous function of the positions. Pairs are counted with hat functions and
not in bins.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from mdnum.forks.reordered import ReorderedSimulation
from mdnum.md.cell import displacement
from mdnum.md.neighbors import BUILDERS, RebuildRule, VerletList
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, first_state, resume_point
from mdnum.rollout.program import MdProgram
from mdnum.systems.simulation import Simulation

#: Number of basis functions (hats) of the pair histogram, and its range in cutoffs, which is limited to half
#: the box.
HATS, _REACH = 24, 1.5
#: Largest displacement of an atom of a starting state, in float32 ulps of the largest coordinate, so that it
#: exceeds the rounding errors of a single-precision run.
NOISE = 40
#: Largest number of steps for which a pair of members is followed, and number of steps between comparisons.
_LONGEST, _EVERY = 20_000, 50
#: Factors of deliberate changes on the time step and the cutoff radii.
_TIMESTEP, _RADIUS = 1.025, 0.96

_NUMBERS = (
    "potential energy", "kinetic energy", "pressure", "spread of the atoms' kinetic energies",
    "skewness of the atoms' kinetic energies", "root mean square force", "fourth moment of the forces",
)  # fmt: skip


# --- features -------------------------------------------------------------------------------------------


def nodes_of(simulation: Simulation, start: Start) -> Float[np.ndarray, "nodes"]:
    """Return the nodes of the pair histogram and its upper end.

    The nodes extend from the closest pairs to the largest distance.
    """
    simulation = simulation.in_row(start.state.cells[0])
    half = float(np.min(simulation.cell.widths)) / 2
    reach = min(half, _REACH * simulation.r_cut)
    distances = pair_distances(simulation, np.asarray(start.state.x, np.float64).T, reach)
    closest = float(np.quantile(distances, 0.01)) if len(distances) else 0.5 * reach
    return np.linspace(closest, reach, HATS + 1)


def feature_names(nodes: Float[np.ndarray, "nodes"]) -> tuple[str, ...]:
    """Return the names of the features in the order of `measure`."""
    return (*_NUMBERS, *(f"pairs at distance {r:.3g}" for r in nodes[:-1]))


def measure(
    simulation: Simulation, segment: Segment, nodes: Float[np.ndarray, "nodes"]
) -> Float[np.ndarray, "features"]:
    """Compute the features at the last step of a segment, in internal units.

    Pairs are counted with a separate neighbor list.
    """
    potential, kinetic, virial = (
        float(segment.rows_of(name)[-1]) for name in ("potential", "kinetic", "virial")
    )
    x, simulation = segment.state.x_before, simulation.in_row(segment.cell_of(segment.rows - 1))
    tables = simulation.tables(segment.table)
    force = np.asarray(_forces(simulation.force, x[:, segment.table.order], tables), np.float64)
    square = (force**2).sum(axis=0)
    v = np.asarray(segment.state.v, np.float64)
    each = 0.5 * simulation.masses * (v**2).sum(axis=0)
    off = each - each.mean()
    volume = simulation.cell.volume if all(simulation.pbc) else 1.0
    numbers = [
        potential, kinetic, (2 * kinetic + virial) / (3 * float(volume)), np.sqrt(np.mean(off**2)),
        np.cbrt(np.mean(off**3)), np.sqrt(square.mean()), np.mean(square**2) ** 0.25,
    ]  # fmt: skip
    distances = pair_distances(simulation, np.asarray(x, np.float64).T, float(nodes[-1]))
    return np.concatenate([np.asarray(numbers, np.float64), hats(distances, nodes)])


@eqx.filter_jit
def _forces(force, x, tables):
    return force(x, tables, decisions=False).force


def pair_distances(
    simulation: Simulation, x: Float[np.ndarray, "atoms 3"], reach: float
) -> Float[np.ndarray, "pairs"]:
    """Return the distances (lengths) of all pairs closer than `reach`. Positions must be wrapped."""
    table = VerletList(BUILDERS["host"], RebuildRule(0.0), reach).build(x, simulation.cell)
    slots, columns = np.nonzero(table.index < len(x))
    i, j = table.order[columns], table.order[table.index[slots, columns]]
    once = i < j
    dx, dy, dz = displacement(simulation.cell, x[i[once]], x[j[once]])
    return np.sqrt(dx * dx + dy * dy + dz * dz)


def hats(
    distances: Float[np.ndarray, "pairs"], nodes: Float[np.ndarray, "nodes"]
) -> Float[np.ndarray, "hats"]:
    """Count pair distances with hat functions. Each distance contributes to two nodes.

    The contribution to a node grows linearly as the distance approaches the node. A distance below the first
    node is counted at this node. Counts do not jump when a pair distance passes the last node.
    """
    width = nodes[1] - nodes[0]
    place = np.clip((distances - nodes[0]) / width, 0.0, len(nodes) - 1.0)
    below = np.minimum(place.astype(np.int64), len(nodes) - 2)
    part = place - below
    counts = np.bincount(below, 1.0 - part, len(nodes)) + np.bincount(below + 1, part, len(nodes))
    return counts[:-1]


# --- runs -----------------------------------------------------------------------------------------------


def noise_size(simulation: Simulation) -> float:
    """Return the largest displacement (a length) of an atom in a perturbed state."""
    largest = np.abs(np.asarray(first_state(simulation).state.x)).max()
    return NOISE * float(np.spacing(np.float32(largest)))


def starts(simulation: Simulation, count: int, seed: int, start: Start | None = None) -> list[Start]:
    """Create the initial states of an ensemble, with different noise for each run."""
    programs = MdProgram(simulation, start).nudged(noise_size(simulation), count, seed)
    return [program.start for program in programs]


def stretches(simulation: Simulation, start: Start, steps: Iterable[int]) -> Iterator[Segment]:
    """Run a simulation in segments and yield each one. Stop if it blows up."""
    for step in steps:
        for segment in Engine(simulation, step, start=start, record=False).segments():
            if segment.closes in FAILURES:
                return
        yield segment
        start = resume_point(segment)


def ensemble(
    simulation: Simulation,
    begin: Sequence[Start],
    windows: Sequence[int],
    nodes: Float[np.ndarray, "nodes"],
    note: Callable[[], None] | None = None,
) -> Float[np.ndarray, "windows runs features"]:
    """Measure the features of every run at given steps. NaN after a run blew up.

    Args:
        begin: a start for each run.
        windows: steps at which features are measured, ascending.
        nodes: nodes of the pair histogram, see `nodes_of`.
        note: function called after each run.
    """
    out = np.full((len(windows), len(begin), len(feature_names(nodes))), np.nan)
    slots = 0
    for run, start in enumerate(begin):
        # with the capacity of the lists before, so that every member uses one compiled program
        start = replace(start, slots=max(start.slots, slots))
        for w, segment in enumerate(stretches(simulation, start, windows)):
            slots = segment.table.slots
            out[w, run] = measure(simulation, segment, nodes)
        if note is not None:
            note()
    return out


def steps_to_diverge(simulation: Simulation, start: Start | None, separation: float, seed: int) -> int | None:
    """Return the step at which two runs have moved apart by a given distance.

    The result is None if the runs stay together for 20,000 steps, or if a run blows up.
    """
    steps = range(_EVERY, _LONGEST + 1, _EVERY)
    pair = [stretches(simulation, one, steps) for one in starts(simulation, 2, seed, start)]
    for step, *segments in zip(steps, *pair, strict=False):
        a, b = (np.asarray(segment.state.x, np.float64) for segment in segments)
        d = simulation.in_row(segments[0].state.cells[0]).cell.minimum_image(*(a - b))
        if float(np.sqrt(sum(np.asarray(c) ** 2 for c in d)).max()) > separation:
            return step
    return None


# --- planted changes ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """A program with a deliberate change, to validate the comparison."""

    name: str  # of the change, for readers
    must_fail: bool  # whether it is another model; else only other rounding
    simulation: Simulation  # the changed program
    once: bool = False  # whether one verdict on it is enough, because its runs take long


def planted(a: Simulation) -> tuple[Change, ...]:
    """Create the programs with deliberate changes that are possible for a simulation.

    The test must detect a longer time step and a shorter cutoff. The test must accept another precision of
    forces, order of pairs or neighbor search. For a many-body potential, cutoff and precision are not
    changed.
    """
    longer = eqx.tree_at(lambda one: one.timestep, a.integrator, a.integrator.timestep * _TIMESTEP)
    search = next(name for name in BUILDERS if name != a.builder)
    changes = [Change("time step + 2.5 %", True, replace(a, integrator=longer))]
    if a.pairwise:
        changes.append(Change("cutoff - 4 %", True, shorter(a, _RADIUS)))
        other = "float32" if a.policy.dtype("force") == np.float64 else "float64"
        rounded = replace(a, policy=replace(a.policy, force=other))
        changes.append(Change(f"forces in {other}", False, rounded))
    changes.append(Change("pairs in another order", False, ReorderedSimulation.of(a, 1)))
    changes.append(Change(f"lists by {search}", False, replace(a, builder=search), once=True))
    return tuple(changes)


def shorter(a: Simulation, factor: float) -> Simulation:
    """Scale all cutoff radii, and the radii at which switching begins."""

    def ends(model):
        return jax.tree.leaves([(part.r_cut, part.r_onset) for part in model.parts])

    model = eqx.tree_at(ends, a.model, [leaf * factor for leaf in ends(a.model)])
    radii = tuple(factor * r for r in a.decider.r_cut)
    return replace(a, model=model, decider=replace(a.decider, r_cut=radii))
