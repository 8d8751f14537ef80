"""Caps on neighbors and the reach of an interaction in words; names of units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdnum.audit.base import Subject
from mdnum.audit.probes import FARTHEST
from mdnum.audit.provoke import Crowd
from mdnum.audit.thresholds import PairWalk
from mdnum.references.findings import finding
from mdnum.units import METAL

_STEEP = 5.0
"""A switch whose curvature is this many times that of the well is what limits the time step."""


@dataclass(frozen=True)
class Words:
    """Names of units.

    Attributes:
        scale: from the energy unit to the one that jumps are told in.
    """

    length: str
    energy: str
    small: str
    scale: float
    force: str
    curvature: str
    third: str


def units_of(subject: Subject) -> Words:
    """How to name what a subject's numbers are in."""
    units = getattr(subject, "units", METAL)
    small, scale = ("meV", 1e3) if units.energy == "eV" else (units.energy, 1.0)
    energy, length = units.energy, units.length
    force = f"{energy}/{length}"
    return Words(length, energy, small, scale, force, f"{force}²", f"{force}³")


def together(text: str) -> str:
    """Text that a narrow column does not break."""
    return text.replace(" ", "\u00a0").replace("-", "\u2011")


def count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def caps(one: Crowd, kT: float, units: Words) -> list[dict[str, str]]:
    found: list[dict[str, str]] = []
    energy = "the energy by nothing"
    if one.energy:
        energy = f"the energy by {one.energy * units.scale:.3g} {units.small} ({one.energy / kT:.2g} kT)"
    if one.kept:
        found.append(
            finding(
                "NEIGHBOR_CAP",
                "error",
                f"only the {one.kept} nearest neighbors are kept",
                f"An atom of {one.species} was given {one.neighbors} neighbors within {one.radius:.6g} "
                f"{units.length}. When another comes nearer than the {one.kept}-th of them (at "
                f"{one.distance:.6g} {units.length}), a force jumps by {one.force:.4g} {units.force} and "
                f"{energy}: neighbors inside the cutoff are dropped, and which ones changes abruptly.",
                f"Raise the cap above the most neighbors that ever come within {one.radius:.4g} "
                f"{units.length}, and make exceeding it an error.",
            )
        )
    if one.order_from:
        found.append(
            finding(
                "NEIGHBOR_CAP_BY_ORDER",
                "error",
                f"from {one.order_from} neighbors on, the energy depends on the order of the atoms",
                f"With {one.order_from} atoms of {one.species} around another within {one.radius:.6g} "
                f"{units.length}, permuting the atoms changes the energy by up to "
                f"{one.order_energy * units.scale:.4g} {units.small} ({one.order_energy / kT:.2g} kT) and "
                "a force "
                f"by {one.order_force:.4g} {units.force}; with {one.order_from - 1} it does not. Some "
                "neighbors are dropped, by their place in a list.",
                "Raise the largest number of neighbors, and make exceeding it an error.",
            )
        )
    return found


def _no_end(walk: PairWalk, kT: float, units: Words) -> str:
    """What was searched for an end that was not found, and no more."""
    scanned = f"Up to {walk.scanned:.4g} {units.length} they were scanned step by step"
    if walk.further is None:
        return (
            f"{scanned}; at {FARTHEST:g} {units.length} the two still feel one another. What is farther out "
            "was not looked at: they may have a cutoff there."
        )
    further = walk.further
    if not further.left:
        return (
            f"{scanned}, and farther out at a few places: what they feel is lost in rounding at "
            f"{further.reached:.4g} {units.length}."
        )
    told = (
        f"{scanned}, and from there to {further.reached:.4g} {units.length} at a few places: there the two "
        f"still feel one another (a force of {abs(further.force):.2g} {units.force}). "
    )
    if not np.isfinite(further.left):
        return told + "It does not fall off; a cutoff farther out was not looked for."
    size = f"{further.left * units.scale:.2g} {units.small}"
    kTs = f" ({further.left / kT:.1g} kT)" if kT else ""
    return told + (
        f"As it falls off there, {size}{kTs} are left: a cutoff farther out was not looked for, and would be "
        "a jump of no more than that."
    )


def reach(walk: PairWalk, units: Words, kT: float) -> list[dict[str, str]]:
    found: list[dict[str, str]] = []
    if walk.cutoff is None and np.abs(walk.energy).max() > 0:
        found.append(
            finding(
                "NO_CUTOFF",
                "info",
                f"{walk.pair.name} interact at every distance tried",
                _no_end(walk, kT, units),
            )
        )
    steep = _steepness(walk)
    if steep is not None and steep[0] > _STEEP:
        found.append(
            finding(
                "STEEP_SWITCH",
                "warning",
                "the interaction is switched off so steeply that it is nearly a step",
                f"Near {steep[1]:.4g} {units.length} the curvature of the pair {walk.pair.name} is "
                f"{steep[0]:.2g} times "
                "that at the bottom of their well: atoms that pass there feel a spring that much stiffer, "
                "and forces that no bond explains.",
                "Switch over a wider range, or choose a time step for this curvature.",
            )
        )
    if walk.left_out:
        found.append(
            finding(
                "MANY_KINKS",
                "info",
                "more places stand out than were looked at",
                f"Along {walk.pair.name}, {count(walk.left_out, 'more place')} stood out of the scan; a "
                "table that is interpolated looks like this. Those that stand out most were looked at, as "
                "many as the time allowed.",
            )
        )
    return found


def _steepness(walk: PairWalk) -> tuple[float, float] | None:
    """(largest curvature beyond the well over that at its bottom, where); None without a well."""
    curvature = -np.gradient(walk.force, walk.distance)
    bottom = int(np.argmin(walk.energy))
    if walk.energy[bottom] >= 0 or bottom < 2 or curvature[bottom] <= 0:
        return None
    # at a place where the force jumps, a difference is no curvature
    sharp = [one.radius for one in walk.thresholds if one.order <= 1]
    width = 2 * (walk.distance[1] - walk.distance[0])
    beyond = walk.distance > 1.1 * walk.distance[bottom]
    for radius in sharp:
        beyond &= np.abs(walk.distance - radius) > width
    if not beyond.any():
        return None
    worst = int(np.argmax(np.where(beyond, np.abs(curvature), 0.0)))
    return float(abs(curvature[worst]) / curvature[bottom]), float(walk.distance[worst])
