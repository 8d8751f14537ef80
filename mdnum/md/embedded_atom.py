"""Embedded-atom potential from a single-element setfl table (.eam.alloy), in full precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.jaxmd import displacement, standard_promotion, upstream
from mdnum.md.manybody import ManyBody, Smoothness


@dataclass(frozen=True)
class Setfl:
    """Contents of a setfl file: the tabulated functions of an embedded-atom potential."""

    element: str  # chemical symbol
    comment: tuple[str, ...]  # the three lines at the head of the file
    # drho, dr: grid spacings of the density and of the distance (length)
    drho: float
    dr: float
    r_cut: float  # cutoff, length
    embedding: Float[np.ndarray, "densities"]  # F on 0, drho, 2 drho, ...; energy
    density: Float[np.ndarray, "radii"]  # rho on 0, dr, 2 dr, ...
    r_pair: Float[np.ndarray, "radii"]  # r phi(r) on 0, dr, 2 dr, ...; length times energy


def read_setfl(path: Path, symbols: Sequence[str] = ()) -> Setfl:
    """Read a setfl table with all digits; line breaks between numbers are ignored.

    The reader of jax-md rounds numbers to float32. Forces in copper then have errors of 4e-4 eV/Å.

    Args:
        symbols: chemical symbols of the atoms, which must agree with the element of the table.

    Raises:
        InputError: the file is unreadable or not a setfl table, has more than one element or another element,
            has missing, additional or non-finite numbers, or ends before its cutoff.

    Source: the DYNAMO setfl format as LAMMPS documents it (pair_style eam/alloy).
    """
    where = str(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputError("potential table not found", where=where, remedy="Check potential.file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the potential table cannot be read ({error})", where=where) from error
    try:
        count, *elements = lines[3].split()
        if int(count) != len(elements):
            raise ValueError(f"line 4 states that there are {count} elements, but names {len(elements)}")
        first, drho, second, dr, r_cut = (float(word) for word in lines[4].split())
        n_rho, n_r = int(first), int(second)
    except (IndexError, ValueError) as error:
        raise InputError(
            f"this is not a setfl table: line 4 must list elements, line 5 grid sizes and spacings ({error})",
            where=where,
            remedy="Give a file in the eam/alloy format of LAMMPS",
        ) from error
    if len(elements) != 1:
        raise InputError(
            f"the potential table contains {len(elements)} elements ({', '.join(elements)}), but mdnum "
            "supports only tables of one element",
            where=where,
            remedy="Give a table for a single element",
        )
    if others := sorted(set(symbols) - set(elements)):
        raise InputError(
            f"the potential table is for {elements[0]}, but the structure also contains {', '.join(others)}",
            where=where,
            remedy="Correct the structure, or give another table with the key potential.file",
        )
    # the line of the element: atomic number, mass, lattice constant, lattice; not needed
    words = " ".join(lines[6:]).split()
    expected = n_rho + 2 * n_r
    if len(words) != expected:
        raise InputError(f"the table has {len(words)} numbers after line 6; expected {expected}", where=where)
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"a number in the potential table cannot be read ({error})", where=where) from error
    if not np.isfinite(numbers).all() or min(drho, dr, r_cut) <= 0 or min(n_rho, n_r) < 5:
        raise InputError("the potential table contains invalid numbers or too few grid points", where=where)
    # many files end one step before their cutoff: the last cubic is carried on, as ASE does it
    if r_cut > n_r * dr * (1 + 1e-9):
        raise InputError(
            f"the potential table ends at r = {(n_r - 1) * dr:g}, before its cutoff {r_cut:g}",
            where=where,
            remedy="Lower the cutoff in line 5 of the table, or extend the table",
        )
    embedding, density, r_pair = np.split(numbers, [n_rho, n_rho + n_r])
    return Setfl(elements[0], tuple(lines[:3]), drho, dr, r_cut, embedding, density, r_pair)


# --- A cubic spline on an even grid, with the coefficients of scipy and the evaluation of jax ---------


class Spline(eqx.Module):
    """Piecewise cubic interpolation of a table, twice continuously differentiable ("not-a-knot" ends).

    The spline equals scipy's InterpolatedUnivariateSpline(k=3), which ASE's EAM uses. Outside the table, the
    first and last cubic continue; see `inside`.
    """

    # of 1, t, t², t³ per interval, t the distance from its left end, shape (4, intervals)
    coefficients: Float[Array, "4 intervals"]
    # start, step: of the grid
    start: float = eqx.field(static=True)
    step: float = eqx.field(static=True)
    intervals: int = eqx.field(static=True)  # how many

    @classmethod
    def through(cls, values: Float[np.ndarray, "points"], step: float, start: float = 0.0) -> Spline:
        """Return the spline through values at start, start + step, ..."""
        from scipy.interpolate import CubicSpline

        # fitted on the whole numbers: knots like i * step are rounded, and their differences more so
        fitted = CubicSpline(np.arange(len(values), dtype=np.float64), values, bc_type="not-a-knot")
        powers = np.asarray(step, np.float64) ** np.arange(4)[:, None]
        return cls(jnp.asarray(fitted.c[::-1] / powers), float(start), float(step), len(values) - 1)

    @property
    def end(self) -> float:
        """Value of x at the last entry of the spline's table."""
        return self.start + self.intervals * self.step

    def __call__(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the value of the spline at x; the function is differentiable."""
        offset = x - self.start
        which = jnp.clip(jnp.floor(offset / self.step), 0, self.intervals - 1)
        t = offset - which * self.step
        c0, c1, c2, c3 = self.coefficients.astype(x.dtype)[:, which.astype(jnp.int32)]
        return c0 + t * (c1 + t * (c2 + t * c3))

    def on_host(
        self, x: Float[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Return value and slope at x by numpy. The value equals jax's bit for bit."""
        offset = x - self.start
        which = np.clip(np.floor(offset / self.step), 0, self.intervals - 1)
        t = offset - which * self.step
        c0, c1, c2, c3 = np.asarray(self.coefficients)[:, which.astype(np.int32)]
        return c0 + t * (c1 + t * (c2 + t * c3)), c1 + t * (c2 + t * c3) + t * (c2 + t * c3 + t * c3)

    def inside(self, x: Float[Array, "..."]) -> Array:
        """Return True if x is inside the table, up to rounding error."""
        slack = 1e-9 * self.step
        return (x >= self.start - slack) & (x <= self.end + slack)


# --- the embedded-atom method from a table, through jax-md's energy function and float64 splines ------


class EmbeddedAtom(ManyBody):
    """E = sum_i F(rho_i) + 1/2 sum_ij phi(r_ij), rho_i = sum_j density(r_ij), for one element.

    The EAM energy of jax-md requires a neighbor list in which no atom is its own neighbor. In jax-md, each
    atom is its own neighbor, which adds the density at r = 0. The splines of jax-md use float32 and are 0
    outside the table.

    Error: energy and forces are NaN if an electron density is outside the embedding table. The error of the
    spline itself is not included.

    Checked against ase.calculators.eam and a plain evaluation in extended precision
    (tests/support/oracles_manybody.py). Source: Daw and Baskes, Phys. Rev. B 29, 6443 (1984).
    """

    # pair, density, embedding: phi, density and F as splines
    pair: Spline
    density: Spline
    embedding: Spline
    r_cut: float = eqx.field(static=True)
    name: str = eqx.field(static=True, kw_only=True, default="eam")
    file: str = eqx.field(static=True, kw_only=True, default="")  # the table that it was read from

    def charge(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the electron density at distance r from an atom. 0 at r = 0 and beyond r_cut."""
        counts = (r > 0) & (r < self.r_cut)
        return jnp.where(counts, self.density(jnp.where(counts, r, 1.0)), 0.0)

    def phi(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the pair energy at distance r. 0 at r = 0 and beyond r_cut."""
        counts = (r > 0) & (r < self.r_cut)
        return jnp.where(counts, self.pair(jnp.where(counts, r, 1.0)), 0.0)

    def embed(self, rho: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the embedding energy at a given density. NaN outside the table."""
        # a factor and not a selection: it makes the slope NaN too, and forces with it
        on = self.embedding.inside(rho)
        return self.embedding(rho * jnp.where(on, 1.0, jnp.nan).astype(rho.dtype))

    def energy(self, positions, neighbor, cell):
        _, total = upstream().energy.eam_neighbor_list(
            displacement(cell, self.pbc),
            1.0,
            charge_fn=self.charge,
            embedding_fn=self.embed,
            pairwise_fn=self.phi,
            cutoff=self.r_cut,
            neighbor_list_fn=lambda *_, **__: None,
        )
        # jax-md mixes dtypes; the result has the dtype of the positions all the same
        with standard_promotion():
            return total(positions, neighbor)


def embedded_atom(
    path: Path | str, symbols: Sequence[str] = (), pbc: tuple[bool, bool, bool] = (True, True, True)
) -> EmbeddedAtom:
    """Make the embedded-atom potential defined by a setfl file (see `read_setfl`)."""
    table = read_setfl(Path(path), symbols)
    r = table.dr * np.arange(len(table.r_pair))
    # the file holds r phi: phi at r = 0 is unknown, so its spline starts one step later, as ASE's does
    pair = Spline.through(table.r_pair[1:] / r[1:], table.dr, start=table.dr)
    density = Spline.through(table.density, table.dr)
    embedding = Spline.through(table.embedding, table.drho)
    return EmbeddedAtom(
        pair,
        density,
        embedding,
        table.r_cut,
        smoothness=_smoothness(table, pair, density, embedding),
        sources=tuple(line for line in table.comment if line.strip()),
        pbc=pbc,
        file=str(path),
    )


def _smoothness(table: Setfl, pair: Spline, density: Spline, embedding: Spline) -> Smoothness:
    """Return upper limits of the energy and force jumps if a pair crosses r_cut."""
    steepest = np.max(np.abs(embedding.on_host(table.drho * np.arange(len(table.embedding)))[1]))
    at = np.array([table.r_cut])
    energy, force = (
        (abs(of_pair) + 2 * steepest * abs(of_density)).item()
        for of_pair, of_density in zip(pair.on_host(at), density.on_host(at), strict=True)
    )
    # a cubic spline has a second derivative to lose, and a jump below 1e-6 is a table's rounding
    order = -1 if energy > 1e-6 else 0 if force > 1e-6 else 1
    return Smoothness(order, energy, force)
