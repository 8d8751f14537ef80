"""What would be measured of a run at a step: the features by which two ensembles are compared.

Every feature is continuous in the positions, so that in a short run, where members of an ensemble differ by
little, it differs by little too: pairs are counted with hats and not in boxes.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float

from mdnum.md.cell import displacement
from mdnum.md.verlet import BUILDERS, RebuildRule, VerletList
from mdnum.rollout.engine import Segment, Start
from mdnum.systems.build import Simulation

#: Nodes of the pair histogram.
NODES = 24
#: The histogram reaches so many times the cutoff, or to half the box.
_REACH = 1.5


@dataclass(frozen=True)
class Ruler:
    """What the features are measured on; the same for every run of a comparison.

    Attributes:
        nodes: distances at which the hats of the pair histogram peak, length, ascending; the last one is
            where the histogram ends.
    """

    nodes: Float[np.ndarray, "nodes"]

    @classmethod
    def of(cls, simulation: Simulation, start: Start) -> Ruler:
        """A ruler from the closest pairs of a start to as far as pairs are counted."""
        half = float(np.min(simulation.cell.widths)) / 2
        reach = min(half, _REACH * simulation.r_cut)
        distances = pair_distances(simulation, np.asarray(start.state.x, np.float64).T, reach)
        closest = float(np.quantile(distances, 0.01)) if len(distances) else 0.5 * reach
        return cls(np.linspace(closest, reach, NODES + 1))

    @property
    def names(self) -> tuple[str, ...]:
        """The features, in the order in which `measure` gives them."""
        pairs = (f"pairs at distance {r:.3g}" for r in self.nodes[:-1])
        return (*_NUMBERS, *pairs)


_NUMBERS = (
    "potential energy",
    "kinetic energy",
    "pressure",
    "spread of the atoms' kinetic energies",
    "skewness of the atoms' kinetic energies",
    "root mean square force",
    "fourth moment of the forces",
)


def measure(simulation: Simulation, segment: Segment, ruler: Ruler) -> Float[np.ndarray, "features"]:
    """The features at the last step of a segment.

    Energies, virial and forces are the run's own; pairs are counted by a list of their own.

    Args:
        simulation: whose segment it is.
        segment: with at least one row.
        ruler: from the first run of the comparison.

    Returns:
        in the internal units of the system, in the order of `ruler.names`.
    """
    potential, kinetic, virial = (
        float(segment.rows_of(name)[-1]) for name in ("potential", "kinetic", "virial")
    )
    x = segment.state.x_before
    tables = simulation.tables(segment.table)
    force = np.asarray(_forces(simulation.force, x[:, segment.table.order], tables), np.float64)
    square = (force**2).sum(axis=0)
    v = np.asarray(segment.state.v, np.float64)
    each = 0.5 * simulation.masses * (v**2).sum(axis=0)
    apart = each - each.mean()
    volume = simulation.cell.volume if all(simulation.pbc) else 1.0
    numbers = [
        potential,
        kinetic,
        (2 * kinetic + virial) / (3 * float(volume)),
        np.sqrt(np.mean(apart**2)),
        np.cbrt(np.mean(apart**3)),
        np.sqrt(square.mean()),
        np.mean(square**2) ** 0.25,
    ]
    distances = pair_distances(simulation, np.asarray(x, np.float64).T, float(ruler.nodes[-1]))
    return np.concatenate([np.asarray(numbers, np.float64), hats(distances, ruler.nodes)])


@eqx.filter_jit
def _forces(force, x, tables):
    return force(x, tables, decisions=False).force


def pair_distances(
    simulation: Simulation, x: Float[np.ndarray, "atoms 3"], reach: float
) -> Float[np.ndarray, "pairs"]:
    """Distances of the pairs of wrapped positions that are closer than `reach`, length."""
    table = VerletList(BUILDERS["host"], RebuildRule(0.0), reach).build(x, simulation.cell)
    slots, columns = np.nonzero(table.index < len(x))
    i, j = table.order[columns], table.order[table.index[slots, columns]]
    once = i < j
    dx, dy, dz = displacement(simulation.cell, x[i[once]], x[j[once]])
    return np.sqrt(dx * dx + dy * dy + dz * dz)


def hats(
    distances: Float[np.ndarray, "pairs"], nodes: Float[np.ndarray, "nodes"]
) -> Float[np.ndarray, "hats"]:
    """A histogram in which a distance between two nodes counts for both, by how near it is to each.

    Distances below the first node count for it; the last node only ends the histogram, so that a pair that
    leaves does not jump.
    """
    width = nodes[1] - nodes[0]
    place = np.clip((distances - nodes[0]) / width, 0.0, len(nodes) - 1.0)
    below = np.minimum(place.astype(np.int64), len(nodes) - 2)
    part = place - below
    counts = np.bincount(below, 1.0 - part, len(nodes)) + np.bincount(below + 1, part, len(nodes))
    return counts[:-1]
