"""Call energy functions with any arguments over neighbor lists.

Functions for jax-md differ in arguments, box, positions (real or fractional), neighbor lists and return
value. The signature determines the order of the arguments. All other properties are determined by trial calls
(`mdnum.systems.admission`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ase import units
from jax import lax
from jaxtyping import Array

from mdnum.errors import InputError
from mdnum.md import jaxmd
from mdnum.md.manybody import ManyBody

_LISTS = ("neighbor", "neighbors", "nbrs", "nlist", "neighbor_list", "nbr_list")
_GRAPHS = ("graph", "graphs", "graphs_tuple", "batch")
#: Keyword arguments through which a function may receive the box and its strain.
KEYWORDS = ("cell", "box", "perturbation")
#: Supported units of functions: length in Å and energy in eV.
LENGTHS: Mapping[str, float] = {"Å": 1.0, "angstrom": 1.0, "nm": units.nm, "bohr": units.Bohr}
ENERGIES: Mapping[str, float] = {
    "eV": 1.0, "meV": 1e-3, "kcal/mol": units.kcal / units.mol, "kJ/mol": units.kJ / units.mol,
    "hartree": units.Hartree,
}  # fmt: skip


@dataclass(frozen=True)
class Convention:
    """Calling convention of an energy function. Trial calls determine the fields after `keywords`."""

    native: bool = False  # (parameters, positions, neighbor, cell)
    parameters: bool = False  # they come first
    keyword: str = ""  # by which the list is given; empty where it follows the positions
    keywords: tuple[str, ...] = ()  # those of KEYWORDS that it takes
    images: bool = False  # the list has an integer shift for each entry
    # how it follows the box: "cell" (rows), "columns" or "rows" of box=; empty where it keeps its own
    box: str = ""
    strain: bool = False  # whether perturbation= strains what it sees
    fractional: bool = False  # positions are fractional coordinates
    # whether derivatives by fractional coordinates are those by real ones, as jax-md's spaces define them
    real_slope: bool = False
    # "number", the key of a dictionary, or "atoms" for an array of one for each; empty before it is known
    returns: str = "number"

    @property
    def label(self) -> str:
        """Name of the calling convention for messages and reports."""
        base = (
            "mdnum's own" if self.native
            else "multi-image list" if self.images
            else "parameters first" if self.parameters
            else "keyword only" if self.keyword
            else "classical"
        )  # fmt: skip
        return base if self.returns in ("number", "atoms") else f"{base}, dictionary with {self.returns}"


@dataclass(frozen=True)
class Call:
    """An energy function of any calling convention, called with (parameters, positions, neighbor, cell)."""

    function: Callable[..., Any]
    how: Convention
    length: float = 1.0  # its unit of length, in the simulation's
    unit: float = 1.0  # its unit of energy, in the simulation's
    name: str = "energy function"

    def bare(self, parameters: Any, x: Array, neighbor: Any, given: Mapping[str, Array]) -> Any:
        """Return the energy in the units of the energy function.

        Args:
            given: the keywords of the convention; for mdnum's own convention, "cell".
        """
        how = self.how
        args = (parameters, x) if how.parameters or how.native else (x,)
        if how.native:
            args += (neighbor, given["cell"])
        elif not how.keyword:
            args += (neighbor,)
        keywords = {} if how.native else {name: given[name] for name in how.keywords}
        if how.keyword:
            keywords[how.keyword] = neighbor
        # jax-md and what is written like it mixes widths
        with jaxmd.standard_promotion():
            out = jax.named_call(self.function, name=self.name.replace(" ", "_"))(*args, **keywords)
        if not how.returns:
            return out
        return jnp.sum(out if how.returns in ("number", "atoms") else out[how.returns])

    def __call__(self, parameters: Any, x: Array, neighbor: Any, cell: Array, strain: Any = None) -> Array:
        """Return the potential energy in the units of the simulation.

        Args:
            cell: lattice vectors as rows. strain: a further deformation of box and positions, near 1.
        """
        how = self.how
        if not how.strain:
            if strain is not None:
                x, cell = x @ strain, cell @ strain
        else:
            # jax-md's derivative by a box is none at fixed positions; that by a perturbation is
            held = lax.stop_gradient(cell)
            missing = jnp.all(held == 0, axis=1)[:, None]
            whole = jnp.where(missing, jnp.eye(3, dtype=held.dtype), held)
            along = jnp.eye(3, dtype=held.dtype) + jnp.linalg.solve(whole, cell - held)
            x, cell = x @ jnp.linalg.inv(along), held
            strain = along if strain is None else along @ strain
        x, cell = x / self.length, cell / self.length
        given = {"cell": cell, "box": cell if how.box == "rows" else cell.T}
        if how.images:
            neighbor = jaxmd.multi_image(neighbor, x, cell, given["box"])
        if how.strain:
            given["perturbation"] = jnp.asarray(strain).T
        if how.fractional:
            x = (_real_slope if how.real_slope else jnp.matmul)(x, jnp.linalg.inv(cell))
        return self.bare(parameters, x, neighbor, given) * self.unit


@jax.custom_jvp
def _real_slope(x: Array, inverse: Array) -> Array:
    """Return fractional coordinates whose derivatives refer to real positions."""
    return x @ inverse


@_real_slope.defjvp
def _real_slope_jvp(primals, tangents):
    return _real_slope(*primals), tangents[0]


class EnergyFunction(ManyBody):
    """Potential from an energy function over a jax-md neighbor list.

    Attributes:
        parameters: a pytree of arrays; the name of each parameter is its path, `potential.parameters...`.
        function: a function of (parameters, positions (atoms, 3), neighbor, cell (3, 3)) that returns the
            energy, with length and energy in units of the system; or a `Call`, for a function with another
            convention.
        species: chemical symbols that the function supports; empty if unknown.
        start: a function of (key, positions, neighbor) that makes the parameters; None if they are given.
        lists: (allocate, update) of the function's own neighbor lists, used for comparison in trial calls; or
            None.
        unit: declared units of length and energy; empty if they are those of the simulation.
        noise: rounding error of the energy at the trial calls, a power of ten, energy.
        notes: findings of the trial calls as pairs (code, values in JSON); None before the trial calls.
    """

    parameters: Any
    function: Callable[..., Array] = eqx.field(static=True)
    r_cut: float = eqx.field(static=True)
    name: str = eqx.field(static=True, kw_only=True, default="energy function")
    species: tuple[str, ...] = eqx.field(static=True, kw_only=True, default=())
    start: Callable[..., Any] | None = eqx.field(static=True, kw_only=True, default=None)
    lists: Any = eqx.field(static=True, kw_only=True, default=None)
    unit: tuple[str, ...] = eqx.field(static=True, kw_only=True, default=())
    noise: float = eqx.field(static=True, kw_only=True, default=0.0)
    notes: tuple[tuple[str, str], ...] | None = eqx.field(static=True, kw_only=True, default=None)

    @property
    def call(self) -> Call:
        """The energy function together with its calling convention."""
        if isinstance(self.function, Call):
            return self.function
        return Call(self.function, Convention(native=True, box="cell"), name=self.name)

    @property
    def fixed_box(self) -> bool:
        """True if the box was fixed when the function was created."""
        return any(self.pbc) and not self.call.how.box

    def energy(self, positions, neighbor, cell):
        return self.call(self.parameters, positions, neighbor, cell)

    def deformed(self, positions, neighbor, cell, deformation):
        return self.call(self.parameters, positions, neighbor, cell, deformation)


def energy_function(
    given: Any,
    r_cut: float,
    *,
    parameters: Any = None,
    format: jaxmd.Format | None = None,
    units: tuple[str, str] | None = None,
    species: tuple[str, ...] = (),
    name: str = "",
    compare: str = "r <",
) -> EnergyFunction:
    """Make a potential from an energy function over a neighbor list.

    Supported forms are `energy_fn(R, neighbor, **kw)`, `energy_fn(params, R, neighbor, **kw)`,
    `energy_fn(R, *, box=, neighbor=, perturbation=)`, and mdnum's own form
    `f(parameters, positions, neighbor, cell)`. The function is given alone or with jax-md's neighbor
    functions. The function may use neighbor lists with several images. The energy function returns a number,
    a number per atom, or a dictionary with key "total" or "energy". Trial calls find out the form of box
    vectors and positions.

    Example:
        >>> made = jax_md.energy.lennard_jones_neighbor_list(displacement, box)
        >>> mdnum.simulation(atoms, mdnum.energy_function(made, 2.5), units="lj", timestep=0.002)

    Args:
        given: the energy function, or a tuple of it and its neighbor functions (and, between them, a function
            that makes parameters).
        r_cut: longest interaction radius, in the function's unit of length.
        parameters: a pytree of arrays, if the function has parameters; default those included in `given`.
        format: "dense", "sparse" or "ordered-sparse"; default the format of its own list or one that it
            accepts.
        units: units of length and energy of the function, such as ("Å", "kcal/mol"); default those of the
            simulation.
        species: chemical symbols that the function supports; default all.
        name: name of the potential in reports.
        compare: comparison that defines "inside": "r <", "r <=", "r2 <" or "r2 <=".

    Raises:
        InputError: a convention that is not known, or that takes a graph; units that are not known.
    """
    if not (np.isfinite(r_cut) and r_cut > 0):
        raise InputError(f"the cutoff radius is {r_cut}; expected a finite length above 0")
    parts = list(given) if isinstance(given, tuple | list) else [given]
    lists = next((part for part in parts if hasattr(part, "allocate")), None)
    # (neighbor_fn, init_fn, energy_fn), or (energy_fn, neighbor_fn, displacement_fn)
    first = lists is None or parts[0] is not lists
    others = [part for part in parts if part is not lists]
    if not others or not callable(function := others[0 if first else -1]):
        seen = ", ".join(type(part).__name__ for part in parts)
        raise InputError(
            f"expected an energy function, not {seen}", remedy="Give energy_fn, or (neighbor_fn, energy_fn)"
        )
    start = others[0] if not first and len(others) > 1 else None
    if not name:
        # jax-md's are all called alike, but for what makes them
        outer, name = getattr(function, "__qualname__", "").split(".")[0], getattr(function, "__name__", "")
        name = {"<lambda>": "", "fn_mapped": outer, "energy_fn": outer}.get(name, name) or "energy function"
    how = recognized(function, parameters is not None or start is not None, name)
    how = replace(how, images=lists is not None and "MultiImage" in type(lists).__name__)
    if how.parameters and parameters is None and start is None:
        raise InputError(
            f"{name} takes parameters as its first argument, but none were given", remedy="Add parameters=..."
        )
    length, energy = _scales(units, name)
    tree = () if parameters is None else jax.tree.map(jnp.asarray, parameters)
    made = Call(function, how, length, energy, name)
    return EnergyFunction(
        tree, made, float(r_cut) * length, format=format or "any", name=name, species=tuple(species),
        start=start, lists=lists, unit=tuple(units or ()), compare=compare,
    )  # fmt: skip


def recognized(function: Callable[..., Any], parameters: bool, name: str) -> Convention:
    """Derive the calling convention of an energy function from its signature.

    Args:
        parameters: True if there are parameters, or a function that creates parameters.
    """
    try:
        given = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return Convention(parameters=parameters, keywords=KEYWORDS)
    kinds = inspect.Parameter
    placed = [one for one in given if one.kind in (kinds.POSITIONAL_ONLY, kinds.POSITIONAL_OR_KEYWORD)]
    names = [one.name.lower() for one in placed]
    if placed and (names[0] in _GRAPHS or "Graph" in str(placed[0].annotation)):
        raise InputError(
            f"the energy function {name} takes a graph; expected a function of a neighbor list",
            remedy="Wrap it in a function energy(parameters, R, neighbor, cell) that makes the graph "
            "from neighbor.idx and mdnum.md.jaxmd.displacement(cell)",
        )
    open_ended = any(one.kind == kinds.VAR_KEYWORD for one in given)
    allowed = {one.name for one in given}
    keywords = tuple(word for word in KEYWORDS if open_ended or word in allowed)
    place = next((k for k, one in enumerate(names) if one in _LISTS), None)
    if len(names) == 4 and names[3] in ("cell", "lattice"):
        return Convention(native=True, box="cell")
    word = next((one.name for one in given if one.kind == kinds.KEYWORD_ONLY and one.name in _LISTS), "")
    first = parameters if place is None else place == 2
    return Convention(parameters=first or (bool(word) and len(names) > 1), keyword=word, keywords=keywords)


def _scales(units: Any, name: str) -> tuple[float, float]:
    if units is None:
        return 1.0, 1.0
    try:
        length, energy = units
        return LENGTHS[length], ENERGIES[energy]
    except (ValueError, KeyError):
        raise InputError(
            f"the units {units!r} of the energy function {name} are not known",
            remedy=f"Give a length unit ({', '.join(LENGTHS)}) and an energy unit ({', '.join(ENERGIES)})",
        ) from None
