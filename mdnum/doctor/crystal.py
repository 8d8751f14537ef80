"""The tilted argon crystal: jit against eager against numpy, in the form that jax 0.10.2 gets wrong.

That release computes a vmapped matrix-vector product followed by a reduction wrongly under jit on
CPUs (jax-ml/jax#39103), without a warning: one coordinate of every displacement in a tilted box. It
needs more than 16,384 rows, so small tests pass. The test computes instead of asking for the version,
because the next such defect will carry another number.
"""

from __future__ import annotations

import hashlib
import math

import jax
import jax.numpy as jnp
import numpy as np

import mdnum.precision  # noqa: F401 (turns on float64)
from mdnum.doctor.rows import Row

_SIGMA = 3.405
_EPSILON = 0.0103235
_R_CUT = 8.5125
_SKIN = 0.4
_ROWS_THAT_MATTER = 16_384
# a product of three terms and a sum of three: a few units in the last place, whatever is contracted
_R2_TOLERANCE = 1e-14
# 24,000 terms of both signs, summed in any order
_ENERGY_TOLERANCE = 1e-12


def tilted_crystal() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """500 argon atoms of an fcc crystal, rattled, in a tilted box, with a padded pair list.

    Returns:
        cell: columns are box vectors (3, 3), Å.
        fractional: positions in units of the cell (500, 3).
        slots: atom indices of the listed pairs (slots, 2), i < j; unused slots hold (500, 500).
    """
    corners = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]])
    grid = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), -1).reshape(-1, 1, 3)
    fractional = ((grid + corners).reshape(-1, 3) / 5) % 1.0
    fractional = fractional + np.random.default_rng(39103).normal(scale=0.002, size=fractional.shape)
    length = 5 * 5.26
    cell = length * np.array([[1.0, 0.12, -0.07], [0.0, 1.0, 0.09], [0.0, 0.0, 1.0]])
    first, second = np.triu_indices(len(fractional), 1)
    separation = fractional[first] - fractional[second]
    r2 = np.sum(((separation - np.round(separation)) @ cell.T) ** 2, axis=1)
    listed = r2 < (_R_CUT + _SKIN) ** 2
    pairs = np.stack([first[listed], second[listed]], axis=1)
    padding = np.full((len(pairs) // 20, 2), len(fractional))
    return cell, fractional, np.concatenate([pairs, padding])


def squared_distances(cell: jax.Array, fractional: jax.Array, slots: jax.Array) -> jax.Array:
    """r² of every slot as jax-md computes it, one matrix-vector product a pair; 0 in unused slots."""
    atoms = fractional.shape[0]
    used = slots[:, 0] < atoms
    index = jnp.where(used[:, None], slots, 0)
    separation = fractional[index[:, 0]] - fractional[index[:, 1]]
    separation = separation - jnp.round(separation)
    r2 = jax.vmap(lambda row: jnp.sum((cell @ row) ** 2))(separation)
    return jnp.where(used, r2, jnp.zeros_like(r2))


def pair_energy(r2: jax.Array) -> jax.Array:
    """The Lennard-Jones energy of the slots inside a hard cutoff, eV."""
    inside = (r2 > 0) & (r2 < _R_CUT**2)
    inverse = (_SIGMA**2) / jnp.where(inside, r2, jnp.ones_like(r2))
    sixth = inverse * inverse * inverse
    return jnp.sum(jnp.where(inside, 4 * _EPSILON * (sixth * sixth - sixth), jnp.zeros_like(r2)))


def trap() -> Row:
    """Squared distances and energy of the crystal under jit and eagerly against numpy and exact sums."""
    cell, fractional, slots = tilted_crystal()
    used = slots[:, 0] < len(fractional)
    pairs = slots[used]
    separation = fractional[pairs[:, 0]] - fractional[pairs[:, 1]]
    separation -= np.round(separation)
    exact_r2 = np.sum((separation @ cell.T) ** 2, axis=1)
    inside = exact_r2[exact_r2 < _R_CUT**2]
    sixth = (_SIGMA**2 / inside) ** 3
    exact_energy = math.fsum(4 * _EPSILON * (sixth * sixth - sixth))

    arguments = (jnp.asarray(cell), jnp.asarray(fractional), jnp.asarray(slots))
    worst: dict[str, tuple[float, float]] = {}
    for mode, function in (
        ("jit", jax.jit(squared_distances)),
        ("eager", squared_distances),
    ):
        r2 = np.asarray(function(*arguments))
        energy = jax.jit(pair_energy) if mode == "jit" else pair_energy
        worst[mode] = (
            float(np.max(np.abs(r2[used] - exact_r2) / exact_r2)),
            abs(float(energy(jnp.asarray(r2))) - exact_energy) / abs(exact_energy),
        )
    rows = len(slots)
    seen = f"{len(fractional)} atoms, {rows:,} pair slots; relative errors " + ", ".join(
        f"{mode}: r² {r2:.1e}, energy {energy:.1e}" for mode, (r2, energy) in worst.items()
    )
    if rows <= _ROWS_THAT_MATTER:
        return Row("tilted crystal", "unsafe", f"only {rows} slots: too few to test what must be tested")
    # written so that a NaN is unsafe
    right = all(r2 <= _R2_TOLERANCE and energy <= _ENERGY_TOLERANCE for r2, energy in worst.values())
    if right:
        return Row("tilted crystal", "ok", seen)
    return Row(
        "tilted crystal",
        "unsafe",
        seen,
        "This jax computes wrong distances (jax-ml/jax#39103 is one known cause). "
        'Install another: python3 -m pip install "jax>=0.10.1,!=0.10.2,!=0.11.0,!=0.11.1"',
    )


def digest(steps: int = 50) -> str:
    """SHA-256 of a short jitted rollout, to be compared between processes.

    Args:
        steps: velocity Verlet steps of a 32-atom Lennard-Jones crystal.
    """
    corners = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]])
    grid = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), -1).reshape(-1, 1, 3)
    positions = (grid + corners).reshape(-1, 3) * 1.6
    positions += np.random.default_rng(7).normal(scale=0.05, size=positions.shape)
    box, step = 3.2, 0.002

    def force(x: jax.Array) -> jax.Array:
        separation = x[:, None] - x[None, :]
        separation = separation - box * jnp.round(separation / box)
        r2 = jnp.sum(separation * separation, axis=-1)
        inside = (r2 > 0) & (r2 < 1.5**2)
        inverse = jnp.where(inside, 1.0 / jnp.where(inside, r2, jnp.ones_like(r2)), jnp.zeros_like(r2))
        sixth = inverse * inverse * inverse
        return jnp.sum((24 * inverse * (2 * sixth * sixth - sixth))[..., None] * separation, axis=1)

    @jax.jit
    def roll(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def advance(_: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x, v = state
            half = v + 0.5 * step * force(x)
            x = x + step * half
            return x, half + 0.5 * step * force(x)

        return jax.lax.fori_loop(0, steps, advance, (x, jnp.zeros_like(x)))

    x, v = roll(jnp.asarray(positions))
    return hashlib.sha256(np.asarray(x).tobytes() + np.asarray(v).tobytes()).hexdigest()
