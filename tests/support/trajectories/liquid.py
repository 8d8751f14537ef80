"""A small Lennard-Jones liquid in plain numpy: positions in float64 whose every digit is known."""

from __future__ import annotations

import functools

import numpy as np
from oracles import all_pairs

CUTOFF = 2.5


def _forces(x, length):
    d = x[:, None] - x[None]
    d -= length * np.rint(d / length)
    square = (d * d).sum(axis=2)
    np.fill_diagonal(square, np.inf)
    inverse = np.where(square < CUTOFF**2, 1.0 / square, 0.0) ** 3
    strength = (48 * inverse - 24) * inverse / square
    return (strength[:, :, None] * d).sum(axis=1)


@functools.cache
def liquid(frames: int, timestep: float = 0.005, stride: int = 1, cells: int = 3, warm: int = 250):
    """(positions (frames, atoms, 3), length of the box): density 0.8442 near the triple point, from fcc."""
    atoms = 4 * cells**3
    length = (atoms / 0.8442) ** (1 / 3)
    corners = np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), -1).reshape(-1, 1, 3)
    x = (corners + np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])).reshape(-1, 3)
    x = x * length / cells
    v = np.random.default_rng(1).normal(size=x.shape) * np.sqrt(1.44)
    v -= v.mean(axis=0)
    f, kept = _forces(x, length), []
    for step in range(warm + frames * stride):
        if step >= warm and (step - warm) % stride == 0:
            kept.append(x.copy())
        # coarse steps suffice to melt it
        dt = 0.005 if step < warm else timestep
        v = v + 0.5 * dt * f
        x = x + dt * v
        f = _forces(x, length)
        v = v + 0.5 * dt * f
    return np.array(kept), length


def memberships(positions, length, radius=CUTOFF):
    """Which of all pairs are inside at each frame, by minimum image: (frames, pairs)."""
    apart = (all_pairs(x, length * np.eye(3), (True,) * 3)[2] for x in positions)
    return np.array([(d * d).sum(axis=1) < radius**2 for d in apart])


def missed_and_invented(truth, seen):
    """Shares of the flips in truth that are not in seen, and of those in seen that are not in truth."""
    happened, found = truth[1:] != truth[:-1], seen[1:] != seen[:-1]
    both = (happened & found & (truth[1:] == seen[1:])).sum()
    return 1 - both / happened.sum(), 1 - both / found.sum()
