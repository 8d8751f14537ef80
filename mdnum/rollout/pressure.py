"""Components of the pressure in a run, and corrections for the cutoff."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.md.cell import displacement
from mdnum.numerics import set_bits
from mdnum.rollout.adequacy import beyond_cutoff
from mdnum.rollout.engine import Segment
from mdnum.rollout.flips import bits_of
from mdnum.systems.simulation import Simulation

# pairs just inside the cutoff are counted in two shells of this share of it each; of more atoms every so many
# are asked for theirs, or a sample of a large system would take as long as many steps
_SHELL, _MOST = 0.02, 2_000


@dataclass
class PressureParts:
    """Components of the pressure: kinetic, virial (total and per term) and impulsive.

    The impulsive component is due to the energy jump at a cutoff. For one type of pair it is 2/3 π ρ²
    g(r_cut) r_cut³ u(r_cut) (Trokhymchuk and Alejandre, J. Chem. Phys. 111, 8510, 1999). The truncated
    potential has this component, but forces and barostats omit the component.

    Args:
        samples: for each sampled step, the volume, length³, and the components, energy/length³.
    """

    simulation: Simulation
    samples: list[dict[str, float]] = field(default_factory=list)

    @cached_property
    def _jumps(self) -> Float[np.ndarray, "kinds"]:
        """Energy jump of each type of pair at its cutoff."""
        return self.simulation.jumps()[0] if self.simulation.pairwise else np.zeros(1)

    def take(self, segment: Segment) -> None:
        """Compute the pressure at a segment's last step. Nothing is computed for a nonperiodic box."""
        simulation, row = self.simulation.in_row(segment.cell_of(segment.rows - 1)), segment.rows - 1
        volume = simulation.cell.volume
        if not (np.isfinite(volume) and all(simulation.pbc)):
            return
        kinetic, virial = (float(segment.rows_of(name)[row]) for name in ("kinetic", "virial"))
        parts = {"volume": volume, "kinetic": 2 * kinetic / (3 * volume), "virial": virial / (3 * volume)}
        jumps = bool(np.any(self._jumps))
        several = simulation.pairwise and len(simulation.model.terms) > 1
        if jumps or several:
            atoms, table = simulation.atoms, segment.table
            stride = 1 if several else max(1, atoms // _MOST)
            slot, column = set_bits(bits_of(segment, row)[:, ::stride])
            channel, slot = np.divmod(slot, table.slots)
            i, j = table.order[column * stride], table.order[table.index[slot, column * stride]]
            x = segment.unsorted("x", row).astype(np.float64)
            r = np.sqrt(sum(c * c for c in displacement(simulation.cell, x[i], x[j])))
            # a pair is there from both ends; its channel counts as one of its first atom
            i, j, share = np.minimum(i, j) + channel * atoms, np.maximum(i, j), stride / (6 * volume)
            if several:
                parts |= {name: share * one for name, one in _virials(simulation, i, j, r).items()}
            if jumps:
                kind = simulation.type_of(i, j)
                weighted = simulation.model.weights
                jump = simulation.jumps_of(i, j)[0] if weighted else self._jumps[kind]
                r_cut = np.array(simulation.decider.r_cut)[kind]
                # the line through two shells inside the cutoff, at the cutoff
                shell = np.floor((r_cut - r) / (_SHELL * r_cut))
                line = np.select([shell <= 0, shell == 1], [1.5, -0.5], 0.0)
                parts["impulsive"] = share * float(np.sum(line * jump)) / _SHELL
        self.samples.append(parts)

    def summary(self) -> dict[str, Any] | None:
        """Return pressures, in user units, with standard errors and cutoff corrections. None without samples.

        Standard errors assume independent samples. The cutoff correction uses the mean volume.
        """
        if not self.samples:
            return None
        count, factor = len(self.samples), self.simulation.units.pressure_factor

        def mean(name: str, factor: float = factor) -> dict[str, float | None]:
            values = factor * np.array([one[name] for one in self.samples])
            error = float(np.std(values, ddof=1)) / count**0.5 if count > 1 else None
            return {"mean": float(np.mean(values)), "error": error}

        for one in self.samples:
            one["total"] = one["kinetic"] + one["virial"]
        named = [name for name in self.samples[0] if name not in (*_OWN, "impulsive")]
        moves = self.simulation.integrator.moves_cell
        volume = float(np.mean([one["volume"] for one in self.samples])) if moves else None
        return {
            "samples": count,
            **{name: mean(name) for name in ("total", "kinetic", "virial")},
            "terms": {name: mean(name) for name in named},
            "impulsive": mean("impulsive") if "impulsive" in self.samples[0] else None,
            "tail": beyond_cutoff(self.simulation, volume),
        }


_OWN = ("volume", "kinetic", "virial", "total")


def _virials(
    simulation: Simulation, i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"], r: np.ndarray
) -> Mapping[str, float]:
    """Return the sum of r · F over pairs for each term. `Simulation.type_of` explains the argument i."""
    found, channel, i = {}, i // simulation.atoms, i % simulation.atoms
    for number, part in enumerate(simulation.model.parts):
        here = channel == number
        a, b, r2 = i[here], j[here], jnp.asarray(r[here] ** 2)
        kind = None if simulation.pair_types == 1 else jnp.asarray(simulation.type_of(a, b))
        for name, term in part.typed.terms.items():
            bare = replace(term, weights=())
            slope = np.asarray(bare.evaluate(r2, kind, bare.at_cutoff())[1])
            for weight in term.weights:
                slope = slope * np.asarray(weight)[a] * np.asarray(weight)[b]
            found[name] = float(-2 * np.sum(np.asarray(r2) * slope))
    return found
