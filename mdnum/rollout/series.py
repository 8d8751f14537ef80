"""One row per step: energies, temperature, pressure, pairs and flips, in the user's units."""

from __future__ import annotations

import numpy as np

from mdnum.numerics import Ledger
from mdnum.rollout.engine import Segment
from mdnum.systems import schema
from mdnum.systems.build import Simulation


def degrees_of_freedom(simulation: Simulation) -> int:
    """3 N, less the three of a center of mass that nothing moves."""
    conserved = simulation.system.spec.dynamics.remove_drift and not isinstance(
        simulation.system.spec.dynamics, schema.LangevinTable
    )
    return max(3 * simulation.atoms - (3 if conserved and simulation.atoms > 1 else 0), 1)


def series_columns(
    simulation: Simulation, segment: Segment, pairs: np.ndarray, ambiguous: np.ndarray, ledger: Ledger
) -> dict[str, np.ndarray]:
    """The rows of series.parquet for a segment.

    Args:
        simulation: the system as objects.
        segment: what the engine recorded.
        pairs: pairs inside at each row.
        ambiguous: pairs within the rounding bound at each row.
        ledger: the flips of the segment.
    """
    units = simulation.units
    step = np.arange(segment.first, segment.first + segment.rows)
    potential, kinetic = segment.rows_of("potential"), segment.rows_of("kinetic")
    row = ledger.step - segment.first
    count = segment.rows
    entered = np.bincount(row[ledger.entered], minlength=count)
    left = np.bincount(row[~ledger.entered], minlength=count)
    total = potential + kinetic
    pressure = (2 * kinetic + segment.rows_of("virial")) / (3 * simulation.cell.volume)
    return {
        "step": step,
        "time": step * simulation.system.spec.dynamics.timestep,
        "potential": potential,
        "kinetic": kinetic,
        "total": total,
        "temperature": 2 * kinetic / (degrees_of_freedom(simulation) * units.k_B),
        "pressure": pressure * units.pressure_factor,
        "pairs": pairs,
        "entered": entered,
        "left": left,
        "displacement": segment.rows_of("moved"),
        "energy_jump": np.bincount(row, weights=ledger.jump, minlength=count),
        "ambiguous": ambiguous,
        "min_margin": segment.rows_of("nearest"),
        "conserved": total - segment.rows_of("heat"),
    }
