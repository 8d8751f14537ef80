"""How the atoms and axes of one run are those of another: labels, a symmetry of the box, a shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Frame:
    """A run seen from the labels and axes of another.

    Attributes:
        labels: atom b of this run is atom labels[b] of the other, shape (atoms,).
        axes: axis a of the other run is axis axes[a] of this one, shape (3,).
        signs: and with this sign, shape (3,).
        shift: this run's positions are those of the other, turned, plus this, length, shape (3,).
    """

    labels: Int[np.ndarray, "atoms"]
    axes: Int[np.ndarray, "3"]
    signs: Float[np.ndarray, "3"]
    shift: Float[np.ndarray, "3"]

    @classmethod
    def same(cls, atoms: int) -> Frame:
        """Nothing is different."""
        return cls(np.arange(atoms), np.arange(3), np.ones(3), np.zeros(3))

    @property
    def is_same(self) -> bool:
        """Whether nothing is different."""
        return (
            bool((self.labels == np.arange(len(self.labels))).all())
            and bool((self.axes == np.arange(3)).all())
            and bool((self.signs == 1).all())
            and not self.shift.any()
        )

    @property
    def inverse(self) -> Frame:
        """The other run, seen from the labels and axes of this one."""
        shift = -self.signs * self.shift[self.axes]
        axes = np.argsort(self.axes)
        return Frame(np.argsort(self.labels), axes, self.signs[axes], shift)

    def positions(self, x: Float[np.ndarray, "rows 3 atoms"]) -> Float[np.ndarray, "rows 3 atoms"]:
        """Positions of this run as the other run would have them, up to lattice vectors."""
        if self.is_same:
            return x
        return self.vectors(x - self.shift[None, :, None])

    def vectors(self, v: Float[np.ndarray, "rows 3 atoms"]) -> Float[np.ndarray, "rows 3 atoms"]:
        """Velocities, likewise."""
        if self.is_same:
            return v
        out = np.empty_like(v)
        out[:, :, self.labels] = v[:, self.axes, :] * self.signs[None, :, None]
        return out

    def keys(self, own: Int[np.ndarray, "pairs"]) -> Int[np.ndarray, "pairs"]:
        """Keys of pairs of this run, in the other's labels."""
        i, j = np.divmod(own, len(self.labels))
        return np.sort(self.keys_of(i, j))

    def keys_of(self, i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"]) -> Int[np.ndarray, "pairs"]:
        """As `keys`, for pairs given by their ends, in their order."""
        a, b = self.labels[i], self.labels[j]
        return np.minimum(a, b).astype(np.int64) * len(self.labels) + np.maximum(a, b)
