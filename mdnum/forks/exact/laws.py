"""Cut Lennard-Jones forces in ball arithmetic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mdnum.md.cutoffs import CUTOFFS, AtCutoff


def pull_of(cutoff: str, sigma: float, epsilon: float, r_cut: float, r_onset: float) -> Callable[[Any], Any]:
    """2 du/d(r²) of a pair inside its cutoff, as a function of the ball r².

    The factor of the displacement x_j - x_i in the force on i. Constants are the given doubles, exactly;
    what follows from them is enclosed at the precision in force when this is called.

    Args:
        cutoff: name of a cutoff.
        sigma, r_cut, r_onset: length.
        epsilon: energy.
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

    def energy(r2):
        inverse = one / r2
        cube = inverse * inverse * inverse
        return depth * cube * (s6 * cube - 1)

    rc = arb(r_cut)
    at = AtCutoff(rc, arb(r_onset), energy(rc * rc), rc * bare(rc * rc))
    return CUTOFFS.parse(cutoff).enclose(bare, energy, at)
