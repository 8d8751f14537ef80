"""Cut Lennard-Jones forces in ball arithmetic: an independent writing of md.potentials and md.cutoffs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mdnum.errors import InputError


class Undecided(Exception):
    """A ball straddles a threshold: the decision is not proven at this precision."""


def pull_of(cutoff: str, sigma: float, epsilon: float, r_cut: float, r_onset: float) -> Callable[[Any], Any]:
    """2 du/d(r²) of a pair inside its cutoff, as a function of the ball r².

    The factor of the displacement x_j - x_i in the force on i. Constants are the given doubles, exactly;
    what follows from them is enclosed at the precision in force when this is called.

    Args:
        cutoff: "hard", "shifted", "force-shifted", "switched", "quintic" or "cosine".
        sigma, r_cut, r_onset: length.
        epsilon: energy.

    Raises:
        InputError: another cutoff.
    """
    from flint import arb

    s2 = arb(sigma) * arb(sigma)
    s6 = s2 * s2 * s2
    # u = (4 epsilon s6) r⁻⁶ (s6 r⁻⁶ - 1), 2 du/d(r²) = (attract - repel r⁻⁶) r⁻⁸
    depth = 4 * arb(epsilon) * s6
    repel, attract = 12 * depth * s6, 6 * depth
    one = arb(1)

    def bare(r2):
        inverse = one / r2
        cube = inverse * inverse * inverse
        return (attract - repel * cube) * (cube * inverse)

    if cutoff in ("hard", "shifted"):
        return bare

    def energy(r2):
        inverse = one / r2
        cube = inverse * inverse * inverse
        return depth * cube * (s6 * cube - 1)

    rc, ro = arb(r_cut), arb(r_onset)
    b, a = rc * rc, ro * ro

    if cutoff == "force-shifted":
        slope = rc * bare(b)
        return lambda r2: bare(r2) - slope / r2.sqrt()

    def beyond(r2) -> bool:
        """Whether the pair is past the onset; the switch starts smoothly, but its side must be proven too."""
        if r2 > a:
            return True
        if r2 <= a:
            return False
        raise Undecided

    if cutoff == "switched":
        cube = (b - a) * (b - a) * (b - a)

        def switched(r2):
            if not beyond(r2):
                return bare(r2)
            s = (b - r2) * (b - r2) * (b + 2 * r2 - 3 * a) / cube
            ds = 6 * (b - r2) * (a - r2) / cube
            return bare(r2) * s + 2 * energy(r2) * ds

        return switched

    if cutoff in ("quintic", "cosine"):
        width = rc - ro

        def in_distance(r2):
            if not beyond(r2):
                return bare(r2)
            r = r2.sqrt()
            t = (r - ro) / width
            if cutoff == "quintic":
                s = 1 - t * t * t * (10 - t * (15 - 6 * t))
                ds = -30 * t * t * (1 - t) * (1 - t)
            else:
                s = (1 + t.cos_pi()) / 2
                ds = -(arb.pi() / 2) * t.sin_pi()
            return bare(r2) * s + energy(r2) * ds / (width * r)

        return in_distance
    raise InputError(f"the exact program knows no cutoff {cutoff!r}")
