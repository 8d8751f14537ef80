"""Many-body potentials: an energy over a neighbor list, and what follows from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.jaxmd import Format, NeighborList, displacement, neighbor_vectors, standard_promotion, upstream


@dataclass(frozen=True)
class Smoothness:
    """What happens to the energy when a pair crosses r_cut."""

    # continuous derivatives of the energy at r_cut: -1 where the energy itself jumps, 0 where only the force
    # does, math.inf where every derivative vanishes
    order: float
    energy_jump: float  # largest jump of the energy at one crossing, energy
    force_jump: float  # largest jump of a force at one crossing, energy/length


#: Nothing is promised.
_UNKNOWN = Smoothness(-1, float("nan"), float("nan"))


class ManyBody(eqx.Module):
    """A potential whose energy is not a sum over pairs.

    Decisions are made outside: the list given holds the pairs that count, and an entry replaced by the
    number of atoms is a pair that does not. Every potential also tests r < r_cut itself, so that a list with
    a skin gives the same energy.

    Attributes:
        pbc: which axes are periodic.
        name: as in a system file.
        format: the neighbor list format that energy takes.
        smoothness: at r_cut.
        sources: papers of the form and its constants.
        r_cut: longest interaction radius, length; a field, or computed from the constants.
    """

    pbc: tuple[bool, bool, bool] = eqx.field(static=True, kw_only=True, default=(True, True, True))
    name: str = eqx.field(static=True, kw_only=True, default="")
    format: Format = eqx.field(static=True, kw_only=True, default="dense")
    smoothness: Smoothness = eqx.field(static=True, kw_only=True, default=_UNKNOWN)
    sources: tuple[str, ...] = eqx.field(static=True, kw_only=True, default=())

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Potential energy; differentiable with respect to positions and cell.

        Args:
            positions: length; they need not lie in the cell.
            neighbor: a list in this potential's format, both directions, no atom its own neighbor.
            cell: lattice vectors as rows, length.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no energy")

    def forces(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, "atoms 3"]:
        """Minus the gradient of the energy, energy/length."""
        return -jax.grad(self.energy)(positions, neighbor, cell)

    def evaluate(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> tuple[Float[Array, ""], Float[Array, "atoms 3"], Float[Array, "3 3"]]:
        """Energy, forces and stress in one pass.

        Returns:
            energy; forces (atoms, 3); stress (3, 3), energy/length³ in ASE's sign: (1/V) dE/d(strain),
            positive where the cell wants to shrink. It means something only for a cell with a volume.
        """
        identity = jnp.eye(3, dtype=positions.dtype)

        def strained(points: Array, strain: Array) -> Array:
            # the symmetric part alone: the energy does not see rotations, its rounding does
            map_ = identity + 0.5 * (strain + strain.T)
            return self.energy(points @ map_, neighbor, cell.astype(points.dtype) @ map_)

        zero = jnp.zeros((3, 3), positions.dtype)
        energy, (slope, virial) = jax.value_and_grad(strained, argnums=(0, 1))(positions, zero)
        return energy, -slope, virial / jnp.abs(jnp.linalg.det(cell)).astype(positions.dtype)


# --- stillinger and Weber's silicon, through jax-md's energy function ---------------------------------

# jax_md.quantity adds a length of 1e-7 to both lengths before it divides by them, which bends every cosine by
# 1e-7 and the forces of rattled silicon by 3e-7. In units of 2^-24 Å it is 6e-15 Å, below rounding, and a
# power of two costs no digit. (Not more: jax-md also takes two neighbors closer than 1e-5 of that unit for
# one.)
_UNIT = 2.0**24


def leaves_by_path(potential: Any) -> dict[str, Any]:
    """The arrays of a potential by where they are in it, such as "pair.values"."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(potential)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def quantities_of(potential: Any) -> dict[str, Any]:
    """The parameters of a many-body potential: its arrays and its constants, by name."""
    found = {name: leaf for name, leaf in leaves_by_path(potential).items() if eqx.is_inexact_array(leaf)}
    for field in fields(potential):
        value = getattr(potential, field.name)
        # constants that a formula holds; the radius of a table is where it ends, and not one of them
        if type(value) is float and field.name != "r_cut":
            found[field.name] = jnp.asarray(value, jnp.float64)
    return found


def with_quantities(potential: Any, values: Mapping[str, Any]) -> Any:
    """The potential with other quantities; inside jit too."""
    names, tree = list(leaves_by_path(potential)), jax.tree.structure(potential)
    leaves = [values.get(name, leaf) for name, leaf in zip(names, jax.tree.leaves(potential), strict=True)]
    whole = jax.tree.unflatten(tree, leaves)
    # constants are static fields, so that a module would warn of an array; here they only live for a trace
    out = object.__new__(type(potential))
    for field in fields(potential):
        static = field.name in values and field.name not in names
        object.__setattr__(out, field.name, values[field.name] if static else getattr(whole, field.name))
    return out


class StillingerWeber(ManyBody):
    """Two- and three-body potential for tetrahedral semiconductors.

    Smooth at its cutoff to every order: a flip changes neither energy nor force.

    Source: Stillinger and Weber, Phys. Rev. B 31, 5262 (1985), eqs. 2.3 to 2.7; checked against a plain
    numpy evaluation of those equations (tests/support/oracles_manybody.py).
    """

    epsilon: float = eqx.field(static=True, default=2.1683)  # energy scale, energy
    sigma: float = eqx.field(static=True, default=2.0951)  # length scale, length
    a: float = eqx.field(static=True, default=1.80)  # cutoff in sigma
    # A, B: strength of the pair term and of its repulsion (p = 4, q = 0)
    A: float = eqx.field(static=True, default=7.049556277)
    B: float = eqx.field(static=True, default=0.6022245584)
    strength: float = eqx.field(static=True, default=21.0)  # lambda, of the angular term
    gamma: float = eqx.field(static=True, default=1.20)  # decay of the angular term
    name: str = eqx.field(static=True, kw_only=True, default="stillinger-weber")
    smoothness: Smoothness = eqx.field(static=True, kw_only=True, default=Smoothness(math.inf, 0.0, 0.0))
    sources: tuple[str, ...] = eqx.field(
        static=True, kw_only=True, default=("F. H. Stillinger and T. A. Weber, Phys. Rev. B 31, 5262 (1985)",)
    )

    @property
    def r_cut(self) -> Any:
        """a sigma, length."""
        return self.a * self.sigma

    def energy(self, positions, neighbor, cell):
        vector = displacement(cell, self.pbc)

        def apart(Ra, Rb, **_):
            # a padded slot may be the atom itself; at distance zero jax-md's derivatives by sigma, A and B
            # are NaN, and its mask comes after
            d = vector(Ra, Rb) * _UNIT
            return jnp.where(jnp.all(d == 0), 2 * self.r_cut * _UNIT, d)

        # numbers stay Python floats here: nothing on this path downcasts them, and they take R's dtype
        _, total = upstream().energy.stillinger_weber_neighbor_list(
            apart,
            1.0,
            sigma=self.sigma * _UNIT,
            A=self.A,
            B=self.B,
            lam=self.strength,
            gamma=self.gamma,
            epsilon=self.epsilon,
            cutoff=self.r_cut * _UNIT,
            neighbor_list_fn=lambda *_, **__: None,
        )
        # jax-md mixes dtypes; the result has the dtype of the positions all the same
        with standard_promotion():
            return total(positions, neighbor)


# --- tersoff's bond-order potential, written out because jax-md's cannot be mended from outside -------

# exp() of more than this is clipped, at the value LAMMPS and ASE chose
_LARGEST_EXPONENT = 69.0776


class Tersoff(ManyBody):
    """Bond-order potential for one element; the constants default to silicon, set Si(C), "T3".

    Energy and force go to zero at r_cut = R + D, the slope of the force does not: smooth to first order.
    Where the crossing atom is a bond's only third neighbor the bond order starts as (r_cut - r)^(2n), so
    for n < 1 the force is continuous but infinitely steep there (dilute silicon; not the crystal).

    Source: Tersoff, Phys. Rev. B 38, 9902 (1988), eqs. 1 to 3 and table I, in LAMMPS's notation; checked
    against ase.calculators.tersoff and a plain numpy evaluation (tests/support/oracles_manybody.py).
    """

    # A, B: repulsion and attraction, energy
    A: float = eqx.field(static=True, default=1830.8)
    B: float = eqx.field(static=True, default=471.18)
    # lambda1, lambda2, lambda3: decay of repulsion, attraction and of the bond order, 1/length
    lambda1: float = eqx.field(static=True, default=2.4799)
    lambda2: float = eqx.field(static=True, default=1.7322)
    lambda3: float = eqx.field(static=True, default=1.7322)
    m: int = eqx.field(static=True, default=3)  # exponent of the bond order's distance term, 1 or 3
    # beta, n: bond order
    beta: float = eqx.field(static=True, default=1.0999e-6)
    n: float = eqx.field(static=True, default=0.78734)
    # c, d, h: angle; gamma: factor of the angular function
    c: float = eqx.field(static=True, default=1.0039e5)
    d: float = eqx.field(static=True, default=16.218)
    h: float = eqx.field(static=True, default=-0.59826)
    gamma: float = eqx.field(static=True, default=1.0)
    # R, D: middle and half width of the taper, length
    R: float = eqx.field(static=True, default=2.85)
    D: float = eqx.field(static=True, default=0.15)
    name: str = eqx.field(static=True, kw_only=True, default="tersoff")
    smoothness: Smoothness = eqx.field(static=True, kw_only=True, default=Smoothness(1, 0.0, 0.0))
    sources: tuple[str, ...] = eqx.field(
        static=True, kw_only=True, default=("J. Tersoff, Phys. Rev. B 38, 9902 (1988), set Si(C)",)
    )

    def __post_init__(self) -> None:
        if self.m not in (1, 3):
            raise InputError(f"Tersoff's exponent m is 1 or 3; got {self.m}")

    @property
    def r_cut(self) -> Any:
        """R + D, length."""
        return self.R + self.D

    def taper(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """1 up to R - D, 0 from R + D on, a quarter sine squared between (0 at the end to the last bit)."""
        # (1 - sin(pi x / 2)) / 2 with x = (r - R) / D, in the form that does not cancel where it vanishes
        inward = jnp.clip((self.r_cut - r) / (2 * self.D), 0.0, 1.0)
        return jnp.sin(0.5 * np.pi * inward) ** 2

    def energy(self, positions, neighbor, cell):
        idx = neighbor.idx
        vectors = neighbor_vectors(positions, idx, cell, self.pbc)
        # the argument is masked, not the result: a padded slot gets a harmless vector before any root
        listed = idx < positions.shape[0]
        apart = jnp.sum(vectors * vectors, axis=-1)
        inside = listed & (apart > 0) & (apart < self.r_cut * self.r_cut)
        r = jnp.sqrt(jnp.where(inside, apart, 1.0))
        unit = jnp.where(inside[..., None], vectors, 0.0) / r[..., None]
        weight = jnp.where(inside, self.taper(r), 0.0)

        # axes: atom i, neighbor j, neighbor k
        cosine = (
            unit[:, :, None, 0] * unit[:, None, :, 0]
            + unit[:, :, None, 1] * unit[:, None, :, 1]
            + unit[:, :, None, 2] * unit[:, None, :, 2]
        )
        off = (self.h - cosine) ** 2
        # c²/d² - c²/(d² + off) over a common denominator: the two differ in the ninth digit only
        angular = self.gamma * (1.0 + (self.c / self.d) ** 2 * off / (self.d**2 + off))
        stretch = self.lambda3 * (r[:, :, None] - r[:, None, :])
        stretch = stretch**self.m
        spread = jnp.exp(jnp.clip(stretch, -_LARGEST_EXPONENT, _LARGEST_EXPONENT))
        others = inside[:, :, None] & inside[:, None, :] & ~jnp.eye(idx.shape[1], dtype=bool)
        zeta = jnp.sum(jnp.where(others, weight[:, None, :] * angular * spread, 0.0), axis=-1)

        # a bond without third neighbors has zeta = 0, where the power has no finite slope
        bonded = zeta > 0
        crowding = (self.beta * jnp.where(bonded, zeta, 1.0)) ** self.n
        order = jnp.where(bonded, (1.0 + crowding) ** (-0.5 / self.n), 1.0)
        repulsion = self.A * jnp.exp(-self.lambda1 * r)
        attraction = self.B * jnp.exp(-self.lambda2 * r)
        return 0.5 * jnp.sum(weight * (repulsion - order * attraction))


# --- any energy function over a neighbor list, jax-md's too -------------------------------------------


class EnergyFunction(ManyBody):
    """An energy with parameters in any pytree, over a neighbor list of jax-md.

    Attributes:
        parameters: a pytree of arrays; each is a parameter `potential.parameters...` by its path.
        function: (parameters, positions (atoms, 3), neighbor, cell (3, 3)) to energy, length and energy units
            of the system. It must test r < r_cut itself.
    """

    parameters: Any
    function: Callable[..., Array] = eqx.field(static=True)
    r_cut: float = eqx.field(static=True)
    name: str = eqx.field(static=True, kw_only=True, default="energy function")

    def energy(self, positions, neighbor, cell):
        return self.function(self.parameters, positions, neighbor, cell)

    def check_cell(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> None:
        """Raise if the function does not follow the cell it is given.

        jax_md.space's own displacements swallow the keyword and keep the box they were made with: energies
        look right and stresses are silently wrong. Shifting one atom by a lattice vector of a slightly
        larger cell must not change the energy in that cell.

        Raises:
            InputError: it does not.
        """
        larger = cell * 1.03125
        axis = next((axis for axis in range(3) if self.pbc[axis]), None)
        if axis is None:
            return
        points = np.asarray(positions)
        moved = points.copy()
        moved[0] += np.asarray(larger)[axis]
        energy = eqx.filter_jit(self.energy)
        here, there = (float(energy(jnp.asarray(one), neighbor, larger)) for one in (points, moved))
        if not abs(here - there) <= 1e-6 * max(abs(here), 1.0):
            raise InputError(
                f"{self.name}: the energy function ignores the cell it is given (a move by a lattice vector "
                f"changes the energy from {here:g} to {there:g})",
                remedy="build it on mdnum.md.jaxmd.displacement instead of a space of jax_md.space",
            )


def from_jax_md(
    energy_fn: Callable[..., Array], r_cut: float, format: Format = "dense", **declared: Any
) -> EnergyFunction:
    """Wrap a jax-md energy function `energy_fn(positions, neighbor, cell=...)`.

    Build it on `mdnum.md.jaxmd.displacement(cell, pbc)` (a space of jax_md.space ignores the cell it is
    given: energies look right, stresses are silently wrong; `check_cell` tells) and hand its constants in as
    `mdnum.md.jaxmd.scalar(...)`: anything else becomes float32 in silence. The function must test r < r_cut
    itself, or its energy depends on when the list was built.

    Args:
        energy_fn: the second of the pair that jax-md's `*_neighbor_list` functions return.
        r_cut: longest interaction radius, length.
        format: neighbor list format that it takes.
        declared: other attributes of ManyBody; of a smoothness not given nothing is promised.
    """
    if not (np.isfinite(r_cut) and r_cut > 0):
        raise InputError(f"an interaction radius above 0 is needed; got {r_cut}")
    declared = {"name": "jax-md"} | declared
    named = jax.named_call(energy_fn, name=declared["name"])
    function = lambda _, positions, neighbor, cell: named(positions, neighbor, cell=cell)  # noqa: E731
    return EnergyFunction((), function, float(r_cut), format=format, **declared)


# --- named sets of constants: a system file's `parameters` --------------------------------------------

_PERIODIC = (True, True, True)
_STILLINGER_WEBER: dict[str, dict[str, Any]] = {"Si": {}}
_TERSOFF: dict[str, dict[str, Any]] = {
    "Si": {},
    # silicon of the multicomponent paper: lambda3 = 0 and three constants rounded otherwise
    "Si-1989": {
        "lambda3": 0.0,
        "beta": 1.1000e-6,
        "d": 16.217,
        "h": -0.59825,
        "sources": ("J. Tersoff, Phys. Rev. B 39, 5566 (1989), table I, silicon",),
    },
}


def stillinger_weber(parameters: str = "Si", pbc: tuple[bool, bool, bool] = _PERIODIC) -> StillingerWeber:
    """Stillinger-Weber with a named set of constants.

    Raises:
        InputError: no such set.
    """
    return StillingerWeber(**_constants("Stillinger-Weber", _STILLINGER_WEBER, parameters), pbc=pbc)


def tersoff(parameters: str = "Si", pbc: tuple[bool, bool, bool] = _PERIODIC) -> Tersoff:
    """Tersoff with a named set of constants: Si (1988, set Si(C), "T3") or Si-1989.

    Raises:
        InputError: no such set.
    """
    return Tersoff(**_constants("Tersoff", _TERSOFF, parameters), pbc=pbc)


def _constants(noun: str, sets: dict[str, dict[str, Any]], name: str) -> dict[str, Any]:
    if name not in sets:
        are = "are" if len(sets) > 1 else "is"
        raise InputError(f"no {noun} constants called {name!r}; known {are} {' and '.join(sets)}")
    return sets[name]


# --- the embedded-atom method from a single-element setfl table (.eam.alloy), every digit of it ---------


@dataclass(frozen=True)
class Setfl:
    """An embedded-atom table as the file has it."""

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
    """Read a table; numbers may be broken into lines in any way, and keep every digit.

    jax-md's own reader rounds everything to float32, which costs the forces of copper 4e-4 eV/Å.

    Args:
        symbols: of the atoms, to be compared with the table's element.

    Raises:
        InputError: unreadable, not a setfl table, more than one element or another one, numbers that are
            missing, left over or not finite, or a table that ends before its cutoff.

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
    if others := sorted(set(symbols) - set(elements)):
        raise InputError(
            f"a table for {elements[0]}, but the structure holds {', '.join(others)}",
            where=where,
            remedy="Correct the structure or potential.file",
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


# --- A cubic spline on an even grid, with the coefficients of scipy and the evaluation of jax ---------


class Spline(eqx.Module):
    """Piecewise cubic through a table, twice continuously differentiable ("not-a-knot" ends).

    The interpolant of scipy's InterpolatedUnivariateSpline(k=3), hence of ASE's EAM. Outside the table the
    first and last cubic are carried on; see `inside`.
    """

    # of 1, t, t², t³ per interval, t the distance from its left end, shape (4, intervals)
    coefficients: Float[Array, "4 intervals"]
    # start, step: of the grid
    start: float = eqx.field(static=True)
    step: float = eqx.field(static=True)
    intervals: int = eqx.field(static=True)  # how many

    @classmethod
    def through(cls, values: Float[np.ndarray, "points"], step: float, start: float = 0.0) -> Spline:
        """The spline through values at start, start + step, ..."""
        from scipy.interpolate import CubicSpline

        # fitted on the whole numbers: knots like i * step are rounded, and their differences more so
        fitted = CubicSpline(np.arange(len(values), dtype=np.float64), values, bc_type="not-a-knot")
        powers = np.asarray(step, np.float64) ** np.arange(4)[:, None]
        return cls(jnp.asarray(fitted.c[::-1] / powers), float(start), float(step), len(values) - 1)

    @property
    def end(self) -> float:
        """The last point of the table."""
        return self.start + self.intervals * self.step

    def __call__(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Value at x; differentiable."""
        offset = x - self.start
        which = jnp.clip(jnp.floor(offset / self.step), 0, self.intervals - 1)
        t = offset - which * self.step
        c0, c1, c2, c3 = self.coefficients.astype(x.dtype)[:, which.astype(jnp.int32)]
        return c0 + t * (c1 + t * (c2 + t * c3))

    def on_host(
        self, x: Float[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Value and slope at x without a compiler, value with the bits of jax operation by operation."""
        offset = x - self.start
        which = np.clip(np.floor(offset / self.step), 0, self.intervals - 1)
        t = offset - which * self.step
        c0, c1, c2, c3 = np.asarray(self.coefficients)[:, which.astype(np.int32)]
        return c0 + t * (c1 + t * (c2 + t * c3)), c1 + t * (c2 + t * c3) + t * (c2 + t * c3 + t * c3)

    def inside(self, x: Float[Array, "..."]) -> Array:
        """Whether x lies on the table, a rounding's breadth included."""
        slack = 1e-9 * self.step
        return (x >= self.start - slack) & (x <= self.end + slack)


# --- the embedded-atom method from a table, through jax-md's energy function and float64 splines ------


class EmbeddedAtom(ManyBody):
    """E = sum_i F(rho_i) + 1/2 sum_ij phi(r_ij), rho_i = sum_j density(r_ij), for one element.

    jax-md's sums are right once it gets a list without self entries; its own list has them and counts every
    atom's density at r = 0, and its splines round the table to float32 and return 0 beyond it.

    Error: a density off the embedding table makes the energy NaN, forces too. The spline's own error against
    the form it tabulates is the table's, not counted here.

    Source: Daw and Baskes, Phys. Rev. B 29, 6443 (1984); checked against ase.calculators.eam and a plain
    evaluation in extended precision (tests/support/oracles_manybody.py).
    """

    # pair, density, embedding: phi, density and F as splines
    pair: Spline
    density: Spline
    embedding: Spline
    r_cut: float = eqx.field(static=True)
    name: str = eqx.field(static=True, kw_only=True, default="eam")
    file: str = eqx.field(static=True, kw_only=True, default="")  # the table that it was read from

    def charge(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """Density of an atom at distance r; 0 at r = 0 (the atom itself) and from r_cut on."""
        counts = (r > 0) & (r < self.r_cut)
        return jnp.where(counts, self.density(jnp.where(counts, r, 1.0)), 0.0)

    def phi(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """Pair energy at distance r; 0 at r = 0 and from r_cut on."""
        counts = (r > 0) & (r < self.r_cut)
        return jnp.where(counts, self.pair(jnp.where(counts, r, 1.0)), 0.0)

    def embed(self, rho: Float[Array, "..."]) -> Float[Array, "..."]:
        """Energy of an atom in a density; NaN off the table."""
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
    """The embedded-atom potential of a setfl table, read as `read_setfl` does."""
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
    """Jumps at r_cut, at most: a crossing changes one pair term and the densities of two atoms."""
    steepest = np.max(np.abs(embedding.on_host(table.drho * np.arange(len(table.embedding)))[1]))
    at = np.array([table.r_cut])
    energy, force = (
        (abs(of_pair) + 2 * steepest * abs(of_density)).item()
        for of_pair, of_density in zip(pair.on_host(at), density.on_host(at), strict=True)
    )
    # a cubic spline has a second derivative to lose, and a jump below 1e-6 is a table's rounding
    order = -1 if energy > 1e-6 else 0 if force > 1e-6 else 1
    return Smoothness(order, energy, force)
