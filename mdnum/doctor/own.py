"""mdnum's own energy and forces of a shipped system against twenty lines of numpy.

The rest of the doctor tests what mdnum stands on; this tests that it stands: system file, neighbor
search, decisions, potential and sums, as a run would use them.
"""

from __future__ import annotations

import math

import numpy as np

from mdnum.doctor.rows import Row

# the promise of `mdnum check energy`
_ENERGY_TOLERANCE, _FORCE_TOLERANCE = 1e-12, 1e-10


def forces() -> Row:
    """mdnum's energy and forces of argon/tilted-500, neighbor search included, against plain numpy."""
    try:
        energy, force = worst_errors()
    except Exception as error:  # whatever keeps mdnum from computing forces here is what was asked for
        return Row(
            "mdnum's forces",
            "unsafe",
            f"{type(error).__name__}: {' '.join(str(error).split())[:300]}",
            "python3 -m pip install --force-reinstall mdnum, in a new environment if that does not help",
        )
    seen = f"argon/tilted-500 against plain numpy: energy {energy:.1e} relative, forces {force:.1e}"
    if energy <= _ENERGY_TOLERANCE and force <= _FORCE_TOLERANCE:
        return Row("mdnum's forces", "ok", seen)
    return Row(
        "mdnum's forces", "unsafe", seen, "See the rows above; else install another jax and another numba"
    )


def worst_errors(name: str = "argon/tilted-500") -> tuple[float, float]:
    """Relative energy difference, and the largest force difference over the largest force.

    Args:
        name: a system of Lennard-Jones atoms with one hard cutoff in a periodic box.
    """
    from mdnum.systems import build, load

    system = load(name)
    potential, cutoff = system.spec.potential, system.spec.cutoff
    if cutoff is None or cutoff.kind != "hard" or potential.kind != "lennard-jones":
        raise ValueError(f"{name} is not a hard-cutoff Lennard-Jones system")
    evaluation = build(system).evaluate()
    energy, forces = _lennard_jones(
        system.atoms.get_positions(),
        system.atoms.cell.array,
        float(potential.sigma or math.nan),
        float(potential.epsilon or math.nan),
        float(cutoff.radius or math.nan),
    )
    return (
        abs(evaluation.energy - energy) / abs(energy),
        float(np.max(np.abs(evaluation.forces - forces)) / np.max(np.abs(forces))),
    )


def _lennard_jones(
    positions: np.ndarray, cell: np.ndarray, sigma: float, epsilon: float, r_cut: float
) -> tuple[float, np.ndarray]:
    """Energy and forces by all pairs in all neighboring images, one image after another."""
    terms: list[np.ndarray] = []
    forces = np.zeros_like(positions)
    fractional = positions @ np.linalg.inv(cell)
    home = positions - np.floor(fractional) @ cell
    for shift in np.ndindex(3, 3, 3):
        away = home[:, None] - home[None, :] + (np.array(shift) - 1) @ cell
        r2 = np.sum(away * away, axis=-1)
        inside = (r2 < r_cut**2) & (r2 > 0)
        sixth = (sigma**2 / r2[inside]) ** 3
        terms.append(2 * epsilon * (sixth * sixth - sixth))
        push = np.zeros_like(r2)
        push[inside] = 24 * epsilon * (2 * sixth * sixth - sixth) / r2[inside]
        forces += np.sum(push[..., None] * away, axis=1)
    return math.fsum(np.concatenate(terms)), forces
