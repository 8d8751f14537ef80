"""Estimates of whether the time step and the cutoff are adequate."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
from jaxtyping import Float

from mdnum.systems.evaluate import Evaluator
from mdnum.systems.simulation import Simulation

# a Lanczos iteration of 12 steps finds the highest frequency of a liquid and of a crystal within 3 %
_LANCZOS, _MOVE = 12, 1e-4
# nodes of a quadrature, and of a coarser one that it has to agree with
_NODES, _FEWER, _AGREE = 200, 100, 1e-3


def fastest_period(simulation: Simulation, positions: Float[np.ndarray, "atoms 3"]) -> float | None:
    """Period of the fastest vibration, in the user's time unit. None if there is no vibration.

    A Lanczos iteration finds the largest eigenvalue of the mass-weighted Hessian. The iteration uses finite
    differences of forces. Forces are shifted to zero at the cutoff, because pairs may cross the cutoff
    between two evaluations. Shifted forces change the Hessian only by a small transverse term.

    Args:
        simulation: the system as objects.
        positions: positions of the atoms, length.

        The period is at most a few percent too long, because the Lanczos iteration has 12 steps.
    """
    smooth = simulation.with_policy()
    smooth = smooth.with_cutoff("force-shifted") if smooth.pairwise else smooth
    evaluator, weight = Evaluator(smooth, often=False), np.sqrt(smooth.masses)[:, None]
    # nobody asks for it; but of many bodies the comparison with ASE has compiled the program that has it
    stress = not smooth.pairwise
    q = np.random.default_rng(0).standard_normal(positions.shape)
    q /= np.linalg.norm(q)
    before, diagonal, beside = np.zeros_like(q), [], [0.0]
    for _ in range(_LANCZOS):
        step = _MOVE / float(np.abs(q / weight).max())
        ends = (positions + sign * step * q / weight for sign in (1, -1))
        ahead, behind = (evaluator(one, stress=stress).forces for one in ends)
        back = (behind - ahead) / (2 * step * weight)
        diagonal.append(float((q * back).sum()))
        back -= diagonal[-1] * q + beside[-1] * before
        beside.append(float(np.linalg.norm(back)))
        if not beside[-1] > 0:
            break
        before, q = q, back / beside[-1]
    within = beside[1 : len(diagonal)]
    matrix = np.diag(diagonal) + np.diag(within, 1) + np.diag(within, -1)
    square = float(np.linalg.eigvalsh(matrix)[-1])
    return 2 * np.pi / square**0.5 / simulation.units.time_factor if square > 0 else None


def beyond_cutoff(simulation: Simulation, volume: float | None = None) -> Mapping[str, float] | None:
    """Tail corrections to energy and pressure for pairs beyond the cutoff. The radial distribution function
    g(r) is taken as 1.

    Args:
        simulation: the system as objects.
        volume: volume of the box, length cubed; by default the system's.

    Returns:
        `energy` per atom, `pressure` in the user's unit (Allen and Tildesley, section 2.8); None if an axis
        is not periodic, the potential ends before the cutoff, atoms have weights or the integral does not
        converge (it diverges unless the potential decays faster than 1/r³).
    """
    if not simulation.pairwise or not all(simulation.pbc) or simulation.model.weights:
        return None
    made, rough = (_beyond(simulation, nodes, volume) for nodes in (_NODES, _FEWER))
    if not made[0] or not np.isfinite(made).all() or not np.allclose(made, rough, rtol=_AGREE, atol=0):
        return None
    return {"energy": made[0], "pressure": made[1] * simulation.units.pressure_factor}


def _beyond(simulation: Simulation, nodes: int, volume: float | None) -> tuple[float, float]:
    """Integrate the tail corrections from the cutoff to infinity."""
    density = simulation.atoms / (volume or simulation.cell.volume)
    share = np.bincount(simulation.species) / simulation.atoms
    node, weight = np.polynomial.legendre.leggauss(nodes)
    node, weight = (node + 1) / 2, weight / 2
    energy = pressure = 0.0
    kinds = list(enumerate(zip(*np.triu_indices(len(simulation.symbols)), strict=True)))
    for term, (kind, (a, b)) in product(simulation.model.terms.values(), kinds):
        constants = term.potential.constants(kind)
        end = float(term.r_cut[kind])
        # from r = end to infinity is s = end / r from 1 to 0
        r = end / node
        u, slope = term.potential.reference(r, **constants)
        pairs = share[a] * share[b] * (1 if a == b else 2) * 2 * np.pi * density
        energy += pairs * float(weight @ (u * r**4)) / end
        pressure -= pairs * density / 3 * float(weight @ (slope * r**5)) / end
    return energy, pressure
