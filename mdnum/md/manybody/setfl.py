"""Reading a single-element setfl table (.eam.alloy), every digit of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError


@dataclass(frozen=True)
class Setfl:
    """An embedded-atom table as the file has it.

    Attributes:
        element: chemical symbol.
        comment: the three lines at the head of the file.
        drho, dr: grid spacings of the density and of the distance (length).
        r_cut: cutoff, length.
        embedding: F on 0, drho, 2 drho, ...; energy.
        density: rho on 0, dr, 2 dr, ...
        r_pair: r phi(r) on 0, dr, 2 dr, ...; length times energy.
    """

    element: str
    comment: tuple[str, ...]
    drho: float
    dr: float
    r_cut: float
    embedding: Float[np.ndarray, "densities"]
    density: Float[np.ndarray, "radii"]
    r_pair: Float[np.ndarray, "radii"]


def read_setfl(path: Path) -> Setfl:
    """Read a table; numbers may be broken into lines in any way.

    jax-md's own reader wants the word setfl in line 1 and no empty line at the end, and rounds everything
    to float32, which costs the forces of copper 4e-4 eV/Å.

    Raises:
        InputError: unreadable, not a setfl table, more than one element, numbers that are missing, left
            over or not finite, or a table that ends before its cutoff.

    Source: the DYNAMO setfl format as LAMMPS documents it (pair_style eam/alloy).
    """
    where = str(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputError("no such potential table", where=where, remedy="Correct potential.file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the potential table cannot be read ({error})", where=where) from error
    try:
        count, *elements = lines[3].split()
        if int(count) != len(elements):
            raise ValueError(f"{count} elements announced, {len(elements)} named")
        first, drho, second, dr, r_cut = (float(word) for word in lines[4].split())
        n_rho, n_r = int(first), int(second)
    except (IndexError, ValueError) as error:
        raise InputError(
            f"this is no setfl table: lines 4 and 5 should name the elements and the grids ({error})",
            where=where,
            remedy="Give a file in LAMMPS's eam/alloy format",
        ) from error
    if len(elements) != 1:
        raise InputError(
            f"a table for {len(elements)} elements ({', '.join(elements)}); one is supported",
            where=where,
            remedy="Give a table of a single element",
        )
    # the line of the element: atomic number, mass, lattice constant, lattice; not needed
    words = " ".join(lines[6:]).split()
    expected = n_rho + 2 * n_r
    if len(words) != expected:
        raise InputError(f"{len(words)} numbers after the element's line, expected {expected}", where=where)
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"a number of the table cannot be read ({error})", where=where) from error
    if not np.isfinite(numbers).all() or min(drho, dr, r_cut) <= 0 or min(n_rho, n_r) < 5:
        raise InputError("the table has numbers that are not finite, or grids that are empty", where=where)
    # many files end one step before their cutoff: the last cubic is carried on, as ASE does it
    if r_cut > n_r * dr * (1 + 1e-9):
        raise InputError(
            f"the table ends at {(n_r - 1) * dr:g}, its cutoff is {r_cut:g}",
            where=where,
            remedy="Lower the cutoff in line 5 or extend the table",
        )
    embedding, density, r_pair = np.split(numbers, [n_rho, n_rho + n_r])
    return Setfl(elements[0], tuple(lines[:3]), drho, dr, r_cut, embedding, density, r_pair)
