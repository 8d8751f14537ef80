"""Pair potentials, which return the energy and its slope as functions of r²."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import fields, replace
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ase.data import atomic_numbers
from jaxtyping import Array, Float, Integer, Num
from scipy.linalg import block_diag

import mdnum.numerics  # noqa: F401 (float64 must be on before the first array exists)
from mdnum.errors import InputError
from mdnum.md.cutoffs import AtCutoff, Cutoff
from mdnum.numerics.host import by_numpy
from mdnum.registry import Registry

if TYPE_CHECKING:
    PerType = Any
else:
    #: A parameter of a pair potential: in input, a number or a number for each pair of species; in a
    #: simulation, an array with one entry per pair type.
    PerType = Float[Array, "types"] | float | int | Mapping[str, float]


def of_type(leaf: Num[Array, "types"], types: Integer[Array, "..."] | None) -> Num[Array, "..."]:
    """Return the array entries of given pair types, without bounds checks. None means a single type."""
    return leaf[0] if types is None else leaf.at[types].get(mode="promise_in_bounds")


class PairPotential(eqx.Module):
    """Base class of pair potentials without a cutoff. The fields are the parameters, by pair type.

    Example:
        >>> class Inverse(mdnum.PairPotential):
        ...     name = "inverse"
        ...     strength: Any
        ...
        ...     def evaluate(self, r2):
        ...         return self.strength / r2, -self.strength / (r2 * r2)
    """

    name: ClassVar[str]
    #: Parameters shared by all pairs, such as the weights of a network: any pytree of arrays.
    shared: ClassVar[Any] = ()
    #: Parameters with one entry per species, by name; for a pair, the values of both species are used.
    by_species: ClassVar[Any] = ()

    @abstractmethod
    def evaluate(self, r2: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return energy u and slope du/d(r²) at squared distances. Parameters broadcast against r2."""

    def reference(
        self, r: Float[np.ndarray, "pairs"], **constants: Any
    ) -> tuple[Float[np.ndarray, "pairs"], Float[np.ndarray, "pairs"]]:
        """Return u(r) and du/dr, computed by numpy as a reference for `evaluate`.

        Args:
            r: distances, length.
            constants: parameters of the pair; shared parameters come from the potential.
        """
        made = self.typed.with_leaves(jax.tree.map(lambda one: jnp.asarray([one]), constants))
        along = np.ones(len(r))
        energy, slope = by_numpy(lambda r: jax.jvp(lambda r: made.evaluate(r * r)[0], (r,), (along,)), r)
        return np.asarray(energy), np.asarray(slope)

    def of(self, types: Integer[Array, "..."] | None) -> PairPotential:
        """Return the potential of given pair types. `types` is None for a single type."""
        own, shared = self.typed.split()
        return eqx.combine(jax.tree.map(lambda leaf: of_type(leaf, types), own), shared)

    @property
    def typed(self) -> PairPotential:
        """The potential, with two values per pair type for every per-species parameter."""
        return self

    def split(self) -> tuple[Any, Any]:
        """Return two copies: one with the parameters per pair type, one with the shared parameters."""
        return self, jax.tree.map(lambda _: None, self)

    @property
    def leaves(self) -> dict[str, Any]:
        """Parameters with one value per pair type, by name, each of shape (types,)."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def with_leaves(self, leaves: Mapping[str, Any]) -> PairPotential:
        """Return a copy of the potential with other parameter values."""
        return replace(self, **leaves)

    def constants(self, kind: int) -> dict[str, Any]:
        """Return the parameters of one pair type. A per-species parameter has two values."""
        return jax.tree.map(lambda leaf: float(leaf[kind]), dict(self.typed.leaves))


class LennardJones(PairPotential):
    """4 epsilon ((sigma/r)^12 - (sigma/r)^6); sigma: length, epsilon: energy.

    Example:
        >>> LennardJones(sigma=3.405, epsilon=0.0103235)
        >>> LennardJones(sigma={"Ar-Ar": 3.405, "Ar-Kr": 3.5, "Kr-Kr": 3.6}, epsilon=0.0103235)
    """

    name = "lennard-jones"
    sigma: PerType  # length, shape (types,)
    epsilon: PerType  # energy, shape (types,)

    def evaluate(self, r2):
        inverse = 1 / r2
        s2 = self.sigma * self.sigma * inverse
        s6 = s2 * s2 * s2
        return 4 * self.epsilon * (s6 * (s6 - 1)), -12 * self.epsilon * (s6 * (s6 + s6 - 1)) * inverse


class Morse(PairPotential):
    """depth (exp(-2 alpha (r - r0)) - 2 exp(-alpha (r - r0))); depth: energy, alpha: 1/length, r0: length.

    Example:
        >>> Morse(depth=0.3429, alpha=1.3588, r0=2.866)
    """

    name = "morse"
    # depth: energy; alpha: 1/length; r0: length; each of shape (types,)
    depth: PerType
    alpha: PerType
    r0: PerType

    def evaluate(self, r2):
        r = jnp.sqrt(r2)
        e = jnp.exp(-self.alpha * (r - self.r0))
        # a quotient does not wait for the exponential
        return self.depth * (e * (e - 2)), -self.depth * self.alpha * (e * (e - 1)) * (1 / r)


class SoftSphere(PairPotential):
    """epsilon/alpha (1 - r/sigma)^alpha for r < sigma, else 0; sigma: length, epsilon: energy, alpha > 1.

    Example:
        >>> SoftSphere(sigma=1.0, epsilon=1.0, alpha=2.0)
    """

    name = "soft-sphere"
    # sigma: length; epsilon: energy; alpha: exponent above 1; each of shape (types,)
    sigma: PerType
    epsilon: PerType
    alpha: PerType

    def evaluate(self, r2):
        r = jnp.sqrt(r2)
        overlap = jnp.maximum(1 - r / self.sigma, 0)
        # a zero overlap is kept away from the power, whose derivatives are not finite there
        touching = overlap > 0
        power = jnp.where(touching, jnp.where(touching, overlap, 1) ** (self.alpha - 1), 0)
        return (
            self.epsilon / self.alpha * power * overlap,
            -self.epsilon / self.sigma * power / (r + r),
        )


class PairFunction(PairPotential):
    """User-defined pair energy `u(r, **parameters)` or `u(r2, **parameters)`, differentiated by jax.

    Example:
        >>> def morse(r, depth, alpha, r0):
        ...     e = jnp.exp(-alpha * (r - r0))
        ...     return depth * (e * e - 2 * e)
        >>> PairFunction(morse, depth=0.2, alpha=1.4, r0=2.9)
        >>> def mixed(r, sigma, species):
        ...     (a, b), (z1, z2) = sigma, species
        ...     return z1 * z2 * jnp.exp(-2 * r / (a + b))
        >>> PairFunction(mixed, sigma={"Na": 1.2, "Cl": 1.8})

    Args:
        function: a function of jax operations, elementwise in its first argument, which is the distance
            (length) if named `r`, or the squared distance if named `r2`. If an argument `species` is not
            given, its value is the atomic numbers of both atoms, as two floats.
        parameters: values by name. A number, or a number for each pair of species ({"Ni-P": 0.2, ...}),
            becomes a parameter with one entry per pair type. For a number per species ({"Ni": 2.2, "P": 1.9})
            the function receives the values of both atoms, as a tuple. Arrays, lists, dictionaries and
            modules of arrays, such as the weights of a network, are shared by all pairs. A list of numbers is
            converted to an array.

    Raises:
        InputError: the first argument is neither r nor r2, or the parameters do not match the function.
    """

    function: Callable[..., Any] = eqx.field(static=True)
    parameters: dict[str, Any]  # in a simulation, arrays with one entry per pair type, or two such
    shared: dict[str, Any]  # pyright: ignore[reportIncompatibleVariableOverride]
    by_species: dict[str, Any]  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, function: Callable[..., Any], **parameters: Any):
        self.function = function
        arguments = list(inspect.signature(function).parameters)
        if "species" in arguments[1:]:
            parameters = {"species": atomic_numbers, **parameters}
        self.parameters = {key: value for key, value in parameters.items() if _is_by_type(value)}
        self.by_species = {key: value for key, value in parameters.items() if _is_by_species(value)}
        own = self.parameters | self.by_species
        self.shared = {key: value for key, value in parameters.items() if key not in own}
        if arguments[:1] not in (["r"], ["r2"]):
            raise InputError(
                "the first argument of the pair function is called "
                f"{arguments[0] if arguments else 'nothing'!r}; expected r, the distance, or r2, its square",
                where=_name_of(function),
                remedy="Rename the first argument of the function to r or r2",
            )
        try:
            inspect.signature(function).bind(0.0, **parameters)
        except TypeError as error:
            raise InputError(
                f"{error}; the pair function takes the parameters {', '.join(arguments[1:])}",
                where=_name_of(function),
                remedy="Give a value for every parameter of the function by name",
            ) from None

    name = property(lambda self: _name_of(self.function))  # type: ignore[assignment]

    def evaluate(self, r2):
        ones, parameters = jnp.ones_like(r2), self.typed.leaves | self.shared
        if self._of_square:
            return jax.jvp(lambda q: self.function(q, **parameters), (r2,), (ones,))
        r = jnp.sqrt(r2)
        energy, slope = jax.jvp(lambda r: self.function(r, **parameters), (r,), (ones,))
        return energy, slope * (0.5 / r)

    def energy(self, r2: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the energy at squared distances, equal to the first value of `evaluate`."""
        parameters = self.typed.leaves | self.shared
        return self.function(r2 if self._of_square else jnp.sqrt(r2), **parameters)

    @property
    def _of_square(self) -> bool:
        return next(iter(inspect.signature(self.function).parameters)) == "r2"

    @property
    def typed(self):
        both = {
            key: tuple(leaf[side] for side in np.triu_indices(len(leaf)))
            for key, leaf in self.by_species.items()
        }
        return self._with(parameters=self.parameters | both, by_species={}) if both else self

    def split(self):
        shared = {"shared": jax.tree.map(lambda _: None, self.shared)}
        own = {key: jax.tree.map(lambda _: None, getattr(self, key)) for key in ("parameters", "by_species")}
        return self._with(**shared), self._with(**own)

    @property
    def leaves(self):
        return self.parameters

    def with_leaves(self, leaves):
        parts = {part: getattr(self, part) for part in ("parameters", "by_species", "shared")}
        return self._with(
            **{part: {key: leaves.get(key, old) for key, old in own.items()} for part, own in parts.items()}
        )

    def _with(self, **parts: Any) -> PairFunction:
        made = copy(self)
        for key, value in parts.items():
            object.__setattr__(made, key, value)
        return made


def _is_by_type(value: Any) -> bool:
    """Return True if a parameter is one number or has a number per pair of species."""
    if isinstance(value, Mapping):
        return bool(value) and all(isinstance(key, str) and "-" in key for key in value)
    return isinstance(value, int | float | np.generic) or (eqx.is_array_like(value) and np.ndim(value) == 0)


def _is_by_species(value: Any) -> bool:
    """Return True for a parameter that has a number for each chemical symbol."""
    return (
        isinstance(value, Mapping)
        and bool(value)
        and all(key in atomic_numbers and np.ndim(one) == 0 for key, one in value.items())
    )


def _name_of(function: Callable[..., Any]) -> str:
    return getattr(function, "__name__", None) or type(function).__name__


#: All pair potentials by name; a package can add one by an entry point of this group. The fields of a class
#: are the parameters of a pair, as in system files.
POTENTIALS: Registry[PairPotential] = Registry("potential", "mdnum.potentials", kind=PairPotential)
for _potential in (LennardJones, Morse, SoftSphere):
    POTENTIALS.add(_potential.name, _potential)


class SumPotential(PairPotential):
    """Sum of potential terms with the same cutoff decision for each pair. Energies and slopes are tuples."""

    names: tuple[str, ...] = eqx.field(static=True)
    parts: tuple[PairPotential, ...]

    name = property(lambda self: " + ".join(self.names))  # type: ignore[assignment]

    def evaluate(self, r2):
        made = [part.evaluate(r2) for part in self.parts]
        return tuple(energy for energy, _ in made), tuple(slope for _, slope in made)

    @property
    def typed(self):
        return replace(self, parts=tuple(part.typed for part in self.parts))

    def split(self):
        each = zip(*(part.split() for part in self.parts), strict=True)
        own, shared = (replace(self, parts=tuple(parts)) for parts in each)
        return own, shared


class Together(Cutoff):
    """Cutoffs of terms with the same cutoff decision for each pair."""

    def __init__(self, ends: tuple[Cutoff, ...]):
        self.ends = ends

    name = property(lambda self: " + ".join(end.name for end in self.ends))  # type: ignore[assignment]
    smoothness = property(lambda self: min(end.smoothness for end in self.ends))  # type: ignore[assignment]
    switches = property(lambda self: any(end.switches for end in self.ends))  # type: ignore[assignment]

    def _each(self, at: AtCutoff):
        rest = zip(at.r_onset, at.energy, at.slope, strict=True)
        return zip(self.ends, (AtCutoff(at.r_cut, *own) for own in rest), strict=True)

    def cut(self, r2, u, w, at, weights=None):
        """Return the sum of `Cutoff.cut` over all terms, each times its weight (default 1)."""
        rows = zip(self._each(at), u, w, strict=True)
        made: list[Any] = [end.cut(r2, energy, slope, own) for (end, own), energy, slope in rows]
        for k, weight in enumerate(weights or ()):
            made[k] = made[k] if weight is None else tuple(weight * part for part in made[k])
        return tuple(reduce(add, parts) for parts in zip(*made, strict=True))

    def jumps(self, at):
        return [jump for end, own in self._each(at) for jump in end.jumps(own)]


class CutPotential(eqx.Module):
    """Pair potential with a cutoff, or a sum of terms with one cutoff decision per pair."""

    potential: PairPotential  # bare potential, parameters per pair type
    cutoff: Cutoff = eqx.field(static=True)  # how it ends
    r_cut: Float[Array, "types"]  # cutoff per pair type, length, shape (types,)
    # onset of switching per pair type (equal to r_cut where there is none), shape (types,); of several terms
    # a tuple
    r_onset: Any
    # of several terms: factors of the atoms, whose product multiplies a pair's energy, shape (atoms,) in the
    # user's order, or None for 1
    weights: tuple[Any, ...] = ()

    @classmethod
    def of_terms(cls, terms: Mapping[str, CutPotential]) -> CutPotential:
        """Combine terms with equal cutoff radii, given by name, into one potential."""
        parts = list(terms.values())
        _, bare, ends, onsets, weights = zip(*(one.rows[0] for one in parts), strict=True)
        weights = weights if any(one.weights for one in parts) else ()
        return cls(SumPotential(tuple(terms), bare), Together(ends), parts[0].r_cut, onsets, weights)

    @property
    def parts(self) -> tuple[CutPotential, ...]:
        """Potentials of all channels, one per cutoff radius. A `CutPotential` has one channel."""
        return (self,)

    @property
    def rows(self) -> list[tuple[str, PairPotential, Cutoff, Any, Any]]:
        """All terms: name ("" for a single term), potential, cutoff, onset, and weights (or None)."""
        # eqx.tree_at looks at a tree whose empty tuples are leaves
        weights = self.weights if isinstance(self.weights, tuple) else ()
        if not isinstance(self.potential, SumPotential) or not isinstance(self.cutoff, Together):
            return [("", self.potential, self.cutoff, self.r_onset, (*weights, None)[0])]
        weights = weights or (None,) * len(self.r_onset)
        parts = (self.potential.parts, self.cutoff.ends, self.r_onset, weights)
        return list(zip(self.potential.names, *parts, strict=True))

    @property
    def terms(self) -> dict[str, CutPotential]:
        """Terms of the potential by name, with their weights. A single potential has the name ""."""
        return {
            name: CutPotential(part, end, self.r_cut, onset, () if weight is None else (weight,))
            for name, part, end, onset, weight in self.rows
        }

    @property
    def pair_types(self) -> int:
        """Number of pair types."""
        return self.r_cut.shape[0]

    @property
    def typed(self) -> CutPotential:
        """The potential, with two values per pair type for every per-species parameter."""
        return replace(self, potential=self.potential.typed)

    def at_cutoff(self) -> AtCutoff:
        """Return energy and slope of the bare potential at r_cut, per pair type."""
        energy, w = self.potential.evaluate(self.r_cut * self.r_cut)
        return AtCutoff(self.r_cut, self.r_onset, energy, jax.tree.map(lambda w: 2 * self.r_cut * w, w))

    def evaluate(self, r2, types, at: AtCutoff, *weights):
        """Return the energy u and du/d(r²) of pairs inside the cutoff.

        Args:
            r2: squared distances.
            types: pair type of each pair, or None where there is only one.
            at: result of `at_cutoff()`, computed once outside the loop.
            weights: for terms with weights, a tuple of the factors of each pair.
        """
        u, w = self.potential.of(types).evaluate(r2)
        here = jax.tree.map(lambda leaf: of_type(leaf, types), at)
        return self.cutoff.cut(r2, u, w, here, *weights)

    def jumps(self) -> Float[np.ndarray, "2 terms types"]:
        """Return jumps of energy and radial force at the cutoff, by term and pair type."""
        # in numpy: to jax each operation on these few numbers is a program to compile
        made = self.cutoff.jumps(jax.tree.map(np.asarray, self).at_cutoff())
        return np.array(made).swapaxes(0, 1)

    def astype(self, dtype) -> CutPotential:
        """Return the potential with parameters as jax arrays of the given dtype."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), self)


class Channels(eqx.Module):
    """Sum of pair potentials with different cutoff radii. Each pair has one cutoff decision per radius.

    Cutoff decisions are numbered consecutively over the pair types of all radii (channels).
    """

    parts: tuple[CutPotential, ...]

    @classmethod
    def of_terms(cls, terms: Mapping[str, CutPotential], *, apart: bool = False) -> CutPotential | Channels:
        """Combine terms by name. Terms with equal cutoff radii share a channel, unless `apart` is true.

        Raises:
            InputError: the name of a term cannot be used in a key of a system file.
        """
        for name in terms:
            if not name.replace("_", "").replace("-", "").isalnum():
                message = f"a term is called {name!r}; expected letters, digits, - and _"
                raise InputError(message, where="terms", remedy="Give the term another name")
        groups: dict[bytes, dict[str, CutPotential]] = {}
        for name, term in terms.items():
            groups.setdefault(name.encode() if apart else np.asarray(term.r_cut).tobytes(), {})[name] = term
        parts = tuple(CutPotential.of_terms(group) for group in groups.values())
        return parts[0] if len(parts) == 1 else cls(parts)

    @property
    def terms(self) -> dict[str, CutPotential]:
        """Potential terms of all channels by name, with their weights."""
        return {name: term for part in self.parts for name, term in part.terms.items()}

    @property
    def potential(self) -> SumPotential:
        """Sum of the bare potentials of all terms."""
        return SumPotential(tuple(self.terms), tuple(term.potential for term in self.terms.values()))

    @property
    def cutoff(self) -> Together:
        """Cutoffs of all terms, as a single object."""
        return Together(tuple(term.cutoff for term in self.terms.values()))

    @property
    def weights(self) -> tuple[Any, ...]:
        """Weights of the terms of all channels, in the order of the channels."""
        return tuple(weight for part in self.parts for weight in part.weights)

    @property
    def r_cut(self) -> Float[Array, "kinds"]:
        """Cutoff radius (a length) for each channel and pair type."""
        return jnp.concatenate([part.r_cut for part in self.parts])

    def jumps(self) -> Float[np.ndarray, "2 terms kinds"]:
        """Return energy and radial-force jumps at the cutoff, by term, channel and type."""
        sides = zip(*(part.jumps() for part in self.parts), strict=True)
        return np.stack([np.asarray(block_diag(*one)) for one in sides])

    def astype(self, dtype) -> Channels:
        """Return a copy with all parameters as jax arrays of the given dtype."""
        return Channels(tuple(part.astype(dtype) for part in self.parts))


def each_term(
    model: CutPotential | Channels, change: Callable[[CutPotential], CutPotential]
) -> CutPotential | Channels:
    """Return a copy of the potential with a function applied to every term. Not for use inside jit."""
    made = {name: change(term) for name, term in model.terms.items()}
    return made[""] if "" in made else Channels.of_terms(made)


def pair_type(first, second, species: int):
    """Return the index of an unordered pair of species, by rows of the upper triangle."""
    low, high = np.minimum(first, second), np.maximum(first, second)
    return low * species - low * (low - 1) // 2 + (high - low)
