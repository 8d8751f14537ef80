"""The tables [potential] and [cutoff] of a system file, one model per kind.

Lengths and energies are in the units of the file: Å and eV, or σ and ε.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, model_validator

Length = Annotated[float, Field(gt=0, description="length (Å or σ)")]
NonNegative = Annotated[float, Field(ge=0)]
Energy = Annotated[float, Field(gt=0, description="energy (eV or ε)")]
Compare = Literal["r2 <", "r2 <=", "r <", "r <="]

ONSET_FRACTION = 0.9
"""A switched cutoff without an onset starts to switch at this fraction of its radius."""


#: Smallest size of a number but 0; what is computed with it squares it.
_SMALLEST = 1e-150
_LARGEST_INT = 2**62


def _numbers_in(value: Any) -> Iterator[float]:
    """The numbers of a value of a table, those in arrays and in free keys included."""
    if isinstance(value, Mapping):
        value = tuple(value.values())
    for item in value if isinstance(value, tuple) else (value,):
        if isinstance(item, int | float) and not isinstance(item, bool):
            yield item


class Table(BaseModel):
    """Base of every table: frozen, strict, no unknown keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _in_range(self) -> Any:
        for name in type(self).model_fields:
            for value in _numbers_in(getattr(self, name)):
                if isinstance(value, int) and abs(value) > _LARGEST_INT:
                    raise ValueError(f"{name} = {value}; expected a whole number of at most 2^62")
                # a tolerance is compared and not squared, and what tolerances can be is checked with them
                if value and name != "tol" and not _SMALLEST <= abs(value) <= 1 / _SMALLEST:
                    raise ValueError(
                        f"{name} = {value:g}; expected 0 or a size from {_SMALLEST:g} to {1 / _SMALLEST:g}, "
                        "whose square is a number, too"
                    )
        return self


# --- potential ----------------------------------------------------------------------------------------


def pair_key(a: str, b: str) -> str:
    """The one spelling under which a pair of species is looked up: "Ni-P" for either order."""
    return "-".join(sorted((a, b)))


def _check_pairs(pairs: Mapping[str, Any] | None) -> None:
    seen: dict[str, str] = {}
    for name in pairs or {}:
        parts = name.split("-")
        if len(parts) != 2 or not all(part.isalpha() for part in parts):
            raise ValueError(f"pair {name!r} is not two species joined by a hyphen, such as 'Ni-P'")
        key = pair_key(*parts)
        if key in seen:
            raise ValueError(f"pairs {seen[key]!r} and {name!r} are the same pair")
        seen[key] = name


class LennardJonesPair(Table):
    """Constants of one pair of species, Lennard-Jones."""

    sigma: Length
    epsilon: Energy


class MorsePair(Table):
    """Constants of one pair of species, Morse."""

    depth: Energy = Field(description="well depth (eV or ε)")
    alpha: float = Field(gt=0, description="stiffness (1/length)")
    r0: Length = Field(description="distance of the minimum (Å or σ)")


class SoftSpherePair(Table):
    """Constants of one pair of species, soft sphere."""

    sigma: Length
    epsilon: Energy
    alpha: float = Field(default=2.0, gt=1, description="exponent")


class _PairPotential(Table):
    @model_validator(mode="after")
    def _complete(self) -> Any:
        pairs = getattr(self, "pairs", None)
        _check_pairs(pairs)
        if not pairs:
            missing = [key for key in self.constants if getattr(self, key) is None]
            if missing:
                raise ValueError(f"{', '.join(missing)} missing, and no pairs table gives them")
        return self

    @property
    def constants(self) -> tuple[str, ...]:
        """Names of the constants of one pair."""
        return tuple(key for key in type(self).model_fields if key not in ("kind", "pairs"))


class LennardJones(_PairPotential):
    """4 ε [(σ/r)^12 - (σ/r)^6]."""

    kind: Literal["lennard-jones"]
    sigma: Length | None = Field(default=None, description="distance of zero energy (Å or σ)")
    epsilon: Energy | None = Field(default=None, description="well depth (eV or ε)")
    pairs: dict[str, LennardJonesPair] | None = Field(
        default=None, description='constants of each pair of species, such as "Ni-P"'
    )


class Morse(_PairPotential):
    """D [(1 - exp(-α (r - r0)))^2 - 1]."""

    kind: Literal["morse"]
    depth: Energy | None = Field(default=None, description="well depth D (eV or ε)")
    alpha: Annotated[float, Field(gt=0)] | None = Field(default=None, description="stiffness (1/length)")
    r0: Length | None = Field(default=None, description="distance of the minimum (Å or σ)")
    pairs: dict[str, MorsePair] | None = Field(
        default=None, description='constants of each pair of species, such as "Ni-P"'
    )


class SoftSphere(_PairPotential):
    """(ε/α) (1 - r/σ)^α inside σ, nothing outside."""

    kind: Literal["soft-sphere"]
    sigma: Length | None = Field(default=None, description="diameter (Å or σ)")
    epsilon: Energy | None = Field(default=None, description="energy scale (eV or ε)")
    alpha: Annotated[float, Field(gt=1)] = Field(
        default=2.0, description="exponent; 2 is harmonic, 2.5 Hertzian"
    )
    pairs: dict[str, SoftSpherePair] | None = Field(
        default=None, description='constants of each pair of species, such as "Ni-P"'
    )


class StillingerWeber(Table):
    """Stillinger-Weber's two- and three-body potential (Phys. Rev. B 31, 5262, 1985)."""

    kind: Literal["stillinger-weber"]
    parameters: Literal["Si"] = Field(default="Si", description="set of constants; Si: the original silicon")


class Tersoff(Table):
    """Tersoff's bond-order potential (Phys. Rev. B 38, 9902, 1988)."""

    kind: Literal["tersoff"]
    parameters: Literal["Si"] = Field(default="Si", description="set of constants; Si: Tersoff's T3 silicon")


class EmbeddedAtom(Table):
    """Embedded-atom method from a table."""

    kind: Literal["eam"]
    file: str = Field(description="setfl table (.eam.alloy), relative to this file")


PairPotential = LennardJones | Morse | SoftSphere
ManyBodyPotential = StillingerWeber | Tersoff | EmbeddedAtom
Potential = Annotated[PairPotential | ManyBodyPotential, Discriminator("kind")]


# --- cutoff -------------------------------------------------------------------------------------------


class _Cutoff(Table):
    radius: Length | None = Field(default=None, description="cutoff radius (Å or σ)")
    in_sigma: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="cutoff radius as a multiple of each pair's sigma, instead of radius"
    )
    pairs: dict[str, Length] | None = Field(
        default=None, description='cutoff radius of single pairs of species, such as "Ni-P" (Å or σ)'
    )
    compare: Compare = Field(default="r2 <", description="what inside means: the quantity compared, and how")

    @model_validator(mode="after")
    def _one_radius(self) -> Any:
        _check_pairs(self.pairs)
        if self.radius is not None and self.in_sigma is not None:
            raise ValueError("radius and in_sigma both given; keep one")
        if self.radius is None and self.in_sigma is None and not self.pairs:
            raise ValueError("radius missing; give radius, in_sigma or a pairs table")
        onset = getattr(self, "onset", None)
        base = self.radius if self.radius is not None else self.in_sigma
        if onset is not None and base is None:
            raise ValueError("onset needs radius or in_sigma beside it; pairs scale it with their own radius")
        if onset is not None and base is not None and onset >= base:
            raise ValueError(f"onset {onset:g} is not below the radius {base:g}")
        return self


class SwitchingCutoff(_Cutoff):
    """Base of the cutoffs that switch off between an onset and the radius."""

    onset: Annotated[float, Field(gt=0)] | None = Field(
        default=None,
        description="where switching starts, in the unit of radius (or of in_sigma); "
        "default 0.9 of it; pairs with a radius of their own keep onset/radius",
    )


class HardCutoff(_Cutoff):
    """Truncated, not shifted: the energy jumps by u(radius) at every crossing."""

    kind: Literal["hard"]


class ShiftedCutoff(_Cutoff):
    """Energy shifted to zero at the radius; the force still jumps."""

    kind: Literal["shifted"]


class ForceShiftedCutoff(_Cutoff):
    """Energy and force shifted to zero at the radius."""

    kind: Literal["force-shifted"]


class SwitchedCutoff(SwitchingCutoff):
    """The C1 switch of jax-md, HOOMD and ASE's smooth=True, from onset to radius."""

    kind: Literal["switched"]


class QuinticCutoff(SwitchingCutoff):
    """A C2 quintic switch from onset to radius."""

    kind: Literal["quintic"]


class CosineCutoff(SwitchingCutoff):
    """A cosine switch from onset to radius."""

    kind: Literal["cosine"]


Cutoff = Annotated[
    HardCutoff | ShiftedCutoff | ForceShiftedCutoff | SwitchedCutoff | QuinticCutoff | CosineCutoff,
    Discriminator("kind"),
]
