"""Potential constants and cutoff radii for every pair of species.

A system file gives one set of constants, or one set per pair of species. No mixing rule is applied. The file
must list every pair of species. A forgotten cross term is an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mdnum.errors import InputError
from mdnum.systems import schema
from mdnum.systems.schema import Interaction, SystemSpec, pair_key, pair_names

Table = Float64[np.ndarray, "types"]


def pair_constants(spec: SystemSpec | Interaction, species: tuple[str, ...]) -> dict[str, Table]:
    """Return each constant of a pair potential for every pair of species.

    Args:
        spec: a system with a pair potential.
        species: chemical symbols, sorted.

    Returns:
        arrays in the order of `pair_names`, in the file's units, by name: sigma and epsilon; depth, alpha and
        r0; or sigma, epsilon and alpha.

    Raises:
        InputError: a pair of species has no constants.
    """
    potential: Any = spec.potential
    if not isinstance(potential, schema.PairPotentialTable):
        raise TypeError(f"{potential.kind} is not a pair potential")
    if isinstance(potential, schema.PythonTable):
        # its function says what it needs, once it may be executed
        return {}
    whole = len(species) == 1 and getattr(potential, potential.constants[0], None) is not None
    given = {pair_key(*name.split("-")): row for name, row in (potential.pairs or {}).items()}
    rows = {name: given.get(name, potential if whole else None) for name in pair_names(species)}
    missing = [name for name, row in rows.items() if row is None]
    if missing:
        known = ", ".join(potential.pairs) if potential.pairs else "one set for all"
        raise InputError(
            f"the structure contains {', '.join(species)}, but [potential] has no parameters for "
            f"{', '.join(missing)} (parameters given: {known})",
            remedy=f"Add the table [potential.pairs.{missing[0]}], or correct the species of the structure",
        )
    return {
        name: np.array([getattr(row, name) for row in rows.values()], np.float64)
        for name in potential.constants
    }


def cutoff_radii(spec: SystemSpec | Interaction, species: tuple[str, ...]) -> tuple[Table, Table | None]:
    """Return cutoff radius and onset of switching for every pair of species.

    Returns:
        radius and onset, in the order of `pair_constants`; the onset is None for a cutoff that does not
        switch. Pairs with a separate radius keep the ratio onset / radius.

    Raises:
        InputError: a pair of species has no radius.
    """
    cutoff = spec.cutoff
    if cutoff is None:
        raise TypeError("the potential has no [cutoff]")
    names = pair_names(species)
    given = {pair_key(*name.split("-")): radius for name, radius in (cutoff.pairs or {}).items()}
    if cutoff.in_sigma is not None:
        radius = cutoff.in_sigma * pair_constants(spec, species)["sigma"]
    else:
        radius = np.full(len(names), np.nan if cutoff.radius is None else cutoff.radius)
    radius = np.array([given.get(name, own) for name, own in zip(names, radius.tolist(), strict=True)])
    if np.isnan(radius).any():
        message = f"no radius for {names[np.isnan(radius).argmax()]} (radii are given for {', '.join(given)})"
        remedy = "Add this radius, or give the radius of all other pairs as cutoff.radius"
        raise InputError(f"[cutoff.pairs] has {message}", remedy=remedy)
    if not cutoff.switches:
        return radius, None
    if cutoff.onset is None:
        return radius, schema.ONSET_FRACTION * radius
    base = cutoff.base
    assert base is not None
    # one radius for all: keep the onset as written instead of rounding it through the ratio
    scaled = radius * (cutoff.onset / base)
    return radius, np.where(radius == cutoff.radius, cutoff.onset, scaled) if cutoff.radius else scaled


def longest_radius(spec: SystemSpec, species: tuple[str, ...], folder: Path) -> float:
    """Return the largest distance at which two atoms interact directly."""
    potential = spec.potential
    if potential is None or isinstance(potential, schema.PairPotentialTable):
        longest = 0.0
        for one in spec.interactions.values():
            pair_constants(one, species)
            longest = max(longest, float(cutoff_radii(one, species)[0].max()))
        return longest
    return many_body(potential, species, folder).r_cut


def many_body(
    potential: Any, species: Sequence[str], folder: Path, pbc: tuple[bool, bool, bool] = (True, True, True)
) -> Any:
    """Create the many-body potential (a `ManyBody`) that a table describes.

    Raises:
        InputError: the table has no constants for these species, or the potential file cannot be used.
    """
    from mdnum.md import embedded_atom, tetrahedral

    if isinstance(potential, schema.EmbeddedAtomTable):
        return embedded_atom.embedded_atom(folder / potential.file, species, pbc)
    if unknown := [name for name in species if name != potential.parameters]:
        raise InputError(
            f"the structure contains {', '.join(unknown)}, but the {potential.kind} potential has parameters "
            f"only for {potential.parameters}",
            remedy="Correct the structure or the potential",
        )
    return tetrahedral.named(potential.kind, potential.parameters, pbc)
