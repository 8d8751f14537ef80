"""Cutoffs: what becomes of a pair potential u(r) at r_cut, in closed form.

Every cutoff turns the value and slope of the bare potential, u and w = du/d(r²), into those of the cut
one, for pairs inside. What a pair outside contributes (nothing) is decided elsewhere.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class AtCutoff(NamedTuple):
    """Constants of the bare potential at its cutoff, one per pair type (or broadcast per pair).

    Attributes:
        r_cut, r_onset: cutoff and onset of switching, length.
        energy: u(r_cut).
        slope: du/dr at r_cut.
    """

    r_cut: Float[Array, "..."]
    r_onset: Float[Array, "..."]
    energy: Float[Array, "..."]
    slope: Float[Array, "..."]


class Cutoff(eqx.Module):
    """How a pair potential ends.

    Attributes:
        name: the word of system files.
        smoothness: the cut energy is C^k at r_cut (and at the onset); -1 where the energy itself jumps.
        switches: has an onset radius below which the potential is untouched.
    """

    name: ClassVar[str]
    smoothness: ClassVar[int]
    switches: ClassVar[bool] = False

    @abstractmethod
    def cut(self, r2, u, w, at: AtCutoff) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Energy and slope of the cut potential inside r_cut.

        Args:
            r2: squared distances, length².
            u, w: bare energy and du/d(r²) at r2.
            at: constants at the cutoff, broadcast against r2.

        Returns:
            (energy, denergy/d(r²)).
        """

    def energy_jump(self, at: AtCutoff):
        """Energy that a pair brings when it enters: the limit of the cut energy at r_cut from inside."""
        return jnp.zeros_like(at.energy)

    def force_jump(self, at: AtCutoff):
        """Radial force (positive: repulsive) that a pair brings when it enters, energy per length."""
        return jnp.zeros_like(at.slope)


class Hard(Cutoff):
    """Truncated, unshifted: energy and force jump."""

    name = "hard"
    smoothness = -1

    def cut(self, r2, u, w, at):
        return u, w

    def energy_jump(self, at):
        return at.energy

    def force_jump(self, at):
        return -at.slope


class Shifted(Cutoff):
    """u(r) - u(r_cut): the energy is continuous; the forces, hence the trajectory, are those of `hard`."""

    name = "shifted"
    smoothness = 0

    def cut(self, r2, u, w, at):
        return u - at.energy, w

    def force_jump(self, at):
        return -at.slope


class ForceShifted(Cutoff):
    """u(r) - u(r_cut) - (r - r_cut) u'(r_cut): energy and force are continuous, at every distance changed."""

    name = "force-shifted"
    smoothness = 1

    def cut(self, r2, u, w, at):
        r = jnp.sqrt(r2)
        return u - at.energy - (r - at.r_cut) * at.slope, w - at.slope / (r + r)


class Switched(Cutoff):
    """The C1 switch in r² of jax-md, HOOMD-blue and ASE's `smooth=True`.

    S = (rc² - r²)² (rc² + 2 r² - 3 ro²) / (rc² - ro²)³ beyond the onset.
    """

    name = "switched"
    smoothness = 1
    switches = True

    def cut(self, r2, u, w, at):
        b, a = at.r_cut * at.r_cut, at.r_onset * at.r_onset
        cube = (b - a) * (b - a) * (b - a)
        s = (b - r2) * (b - r2) * (b + (r2 + r2) - (a + a + a)) / cube
        ds = 6 * (b - r2) * (a - r2) / cube
        beyond = r2 > a
        return jnp.where(beyond, u * s, u), jnp.where(beyond, w * s + u * ds, w)


class _SwitchedInDistance(Cutoff):
    switches = True

    @abstractmethod
    def switch(self, t) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Switching function and its derivative for t in [0, 1] from onset to cutoff."""

    def cut(self, r2, u, w, at):
        r = jnp.sqrt(r2)
        width = at.r_cut - at.r_onset
        t = (r - at.r_onset) / width
        s, ds = self.switch(t)
        beyond = t > 0
        return jnp.where(beyond, u * s, u), jnp.where(beyond, w * s + u * ds / (width * (r + r)), w)


class Quintic(_SwitchedInDistance):
    """The C2 switch 1 - 10 t³ + 15 t⁴ - 6 t⁵."""

    name = "quintic"
    smoothness = 2

    def switch(self, t):
        rest = 1 - t
        return 1 - t * t * t * (10 - t * (15 - 6 * t)), -30 * t * t * rest * rest


class Cosine(_SwitchedInDistance):
    """The C1 switch (1 + cos(pi t)) / 2, as in neural-network potentials."""

    name = "cosine"
    smoothness = 1

    def switch(self, t):
        return (1 + jnp.cos(jnp.pi * t)) / 2, -(jnp.pi / 2) * jnp.sin(jnp.pi * t)


BY_NAME: dict[str, Cutoff] = {
    cutoff.name: cutoff for cutoff in (Hard(), Shifted(), ForceShifted(), Switched(), Quintic(), Cosine())
}
