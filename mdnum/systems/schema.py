"""What a system file may say: frozen pydantic models, one per table, with the unit of every number.

Why strict: a system file decides what is computed, so a misspelled key or a string where a number belongs
is refused (mdnum.systems.load turns each refusal into one line). Lengths, energies and times are in the
units of the file: Å, eV, amu, ps and K for "metal"; multiples of σ, ε, m and τ for "lj".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, model_validator

from mdnum import units as unit_systems

Length = Annotated[float, Field(gt=0, description="length (Å or σ)")]
NonNegative = Annotated[float, Field(ge=0)]
Energy = Annotated[float, Field(gt=0, description="energy (eV or ε)")]
Compare = Literal["r2 <", "r2 <=", "r <", "r <="]
FloatName = Literal["float64", "float32"]

DEFAULT_SKIN = {"metal": 1.0, "lj": 0.3}
"""Skin when the file gives none: LAMMPS uses 2.0 Å and 0.3 σ; 1.0 Å suits the argon-sized systems here."""

ONSET_FRACTION = 0.9
"""A switched cutoff without an onset starts to switch at this fraction of its radius."""


def _tuple(value: Any) -> Any:
    # TOML has arrays only; strict pydantic would refuse a list where a tuple is declared
    return tuple(value) if isinstance(value, list) else value


class Table(BaseModel):
    """Base of every table: frozen, strict, no unknown keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


# --- structure ----------------------------------------------------------------------------------------

Flags = Annotated[tuple[bool, bool, bool], BeforeValidator(_tuple)]
Counts = Annotated[
    tuple[
        Annotated[int, Field(gt=0)],
        Annotated[int, Field(gt=0)],
        Annotated[int, Field(gt=0)],
    ],
    BeforeValidator(_tuple),
]
Triple = Annotated[tuple[float, float, float], BeforeValidator(_tuple)]
Masses = dict[str, Annotated[float, Field(gt=0)]]


class _Structure(Table):
    pbc: Flags | None = Field(
        None, description="periodic along each cell vector; overrides what the structure says"
    )
    masses: Masses | None = Field(
        None,
        description="mass of each species (amu or m); default: the file's, else ASE's for metal and 1 for lj",
    )
    velocities: Literal["file", "drawn"] = Field(
        "file",
        description="file: the structure's velocities when it has any; drawn: always Maxwell-Boltzmann at "
        "dynamics.temperature from dynamics.seed",
    )


class FileStructure(_Structure):
    """A structure read from a file."""

    file: str = Field(
        description="anything ase.io reads, relative to this file; lengths in Å or σ, momenta in ASE's units"
    )
    index: int = Field(-1, description="frame to take from a file of several; -1 is the last")


class BuilderStructure(_Structure):
    """A perfect crystal, built."""

    builder: Literal["fcc", "bcc", "sc", "diamond"] = Field(description="lattice, with its cubic cell")
    symbol: str = Field(description="chemical symbol")
    lattice_constant: Length = Field(description="edge of the cubic cell (Å or σ)")
    repeat: Counts = Field((1, 1, 1), description="cells along x, y and z")
    tilt: Triple = Field(
        (0.0, 0.0, 0.0), description="shear of the whole crystal: xy, xz and yz, length per length"
    )
    rattle: NonNegative = Field(
        0.0, description="standard deviation of a random displacement of every coordinate (Å or σ)"
    )
    seed: int = Field(0, ge=0, description="seed of the rattle")


def _structure_tag(value: Any) -> str:
    if isinstance(value, Mapping):
        return "builder" if "builder" in value else "file"
    return "builder" if isinstance(value, BuilderStructure) else "file"


Structure = Annotated[
    Annotated[FileStructure, Tag("file")] | Annotated[BuilderStructure, Tag("builder")],
    Discriminator(_structure_tag),
]


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
    sigma: Length
    epsilon: Energy


class MorsePair(Table):
    depth: Energy = Field(description="well depth (eV or ε)")
    alpha: float = Field(gt=0, description="stiffness (1/length)")
    r0: Length = Field(description="distance of the minimum (Å or σ)")


class SoftSpherePair(Table):
    sigma: Length
    epsilon: Energy
    alpha: float = Field(2.0, gt=1, description="exponent")


class _PairPotential(Table):
    @model_validator(mode="after")
    def _complete(self) -> Any:
        pairs = getattr(self, "pairs", None)
        _check_pairs(pairs)
        if not pairs:
            missing = [key for key in self.constants if getattr(self, key) is None]
            if missing:
                raise ValueError(f"{' and '.join(missing)} missing, and no pairs table gives them")
        return self

    @property
    def constants(self) -> tuple[str, ...]:
        """Names of the constants of one pair."""
        return tuple(key for key in type(self).model_fields if key not in ("kind", "pairs"))


class LennardJones(_PairPotential):
    """4 ε [(σ/r)^12 - (σ/r)^6]."""

    kind: Literal["lennard-jones"]
    sigma: Length | None = Field(None, description="distance of zero energy (Å or σ)")
    epsilon: Energy | None = Field(None, description="well depth (eV or ε)")
    pairs: dict[str, LennardJonesPair] | None = Field(
        None, description='constants of each pair of species, such as "Ni-P"'
    )


class Morse(_PairPotential):
    """D [(1 - exp(-α (r - r0)))^2 - 1]."""

    kind: Literal["morse"]
    depth: Energy | None = Field(None, description="well depth D (eV or ε)")
    alpha: Annotated[float, Field(gt=0)] | None = Field(None, description="stiffness (1/length)")
    r0: Length | None = Field(None, description="distance of the minimum (Å or σ)")
    pairs: dict[str, MorsePair] | None = Field(
        None, description='constants of each pair of species, such as "Ni-P"'
    )


class SoftSphere(_PairPotential):
    """(ε/α) (1 - r/σ)^α inside σ, nothing outside."""

    kind: Literal["soft-sphere"]
    sigma: Length | None = Field(None, description="diameter (Å or σ)")
    epsilon: Energy | None = Field(None, description="energy scale (eV or ε)")
    alpha: Annotated[float, Field(gt=1)] = Field(2.0, description="exponent; 2 is harmonic, 2.5 Hertzian")
    pairs: dict[str, SoftSpherePair] | None = Field(
        None, description='constants of each pair of species, such as "Ni-P"'
    )


class StillingerWeber(Table):
    """Stillinger-Weber's two- and three-body potential (Phys. Rev. B 31, 5262, 1985)."""

    kind: Literal["stillinger-weber"]
    parameters: Literal["Si"] = Field("Si", description="set of constants; Si: the original silicon")


class Tersoff(Table):
    """Tersoff's bond-order potential (Phys. Rev. B 38, 9902, 1988)."""

    kind: Literal["tersoff"]
    parameters: Literal["Si"] = Field("Si", description="set of constants; Si: Tersoff's T3 silicon")


class EmbeddedAtom(Table):
    """Embedded-atom method from a table."""

    kind: Literal["eam"]
    file: str = Field(description="setfl table (.eam.alloy), relative to this file")


PairPotential = LennardJones | Morse | SoftSphere
ManyBodyPotential = StillingerWeber | Tersoff | EmbeddedAtom
Potential = Annotated[PairPotential | ManyBodyPotential, Discriminator("kind")]


# --- cutoff -------------------------------------------------------------------------------------------


class _Cutoff(Table):
    radius: Length | None = Field(None, description="cutoff radius (Å or σ)")
    in_sigma: Annotated[float, Field(gt=0)] | None = Field(
        None, description="cutoff radius as a multiple of each pair's sigma, instead of radius"
    )
    pairs: dict[str, Length] | None = Field(
        None, description='cutoff radius of single pairs of species, such as "Ni-P" (Å or σ)'
    )
    compare: Compare = Field("r2 <", description="what inside means: the quantity compared, and how")

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
        None,
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


# --- the rest -----------------------------------------------------------------------------------------


class Rebuild(Table):
    """When the list is rebuilt, in the words of LAMMPS's neigh_modify."""

    every: int = Field(1, ge=1, description="consider a rebuild every so many steps")
    delay: int = Field(0, ge=0, description="but never sooner than this many steps after the last one")
    check: bool = Field(
        True,
        description="rebuild only when half the skin is used up; false: blindly, which may lose pairs",
    )


class Neighbors(Table):
    """The Verlet list."""

    skin: NonNegative | None = Field(
        None, description="extra radius of the list (Å or σ); default 1.0 Å for metal, 0.3 σ for lj"
    )
    builder: Literal["auto", "host", "jax-md"] = Field("auto", description="who searches for neighbors")
    rebuild: Rebuild = Field(default_factory=lambda: Rebuild())


class _Dynamics(Table):
    timestep: float = Field(gt=0, description="time step (ps or τ)")
    steps: int = Field(1000, ge=0, description="steps of a run")
    seed: int = Field(0, ge=0, description="seed of drawn velocities and of the noise")
    remove_drift: bool = Field(True, description="take out the center-of-mass velocity at the start")


class NVE(_Dynamics):
    """Constant energy: velocity Verlet."""

    kind: Literal["nve"]
    temperature: NonNegative = Field(
        0.0,
        description="of drawn velocities (K or ε/k), 0 is at rest; unused where the structure has velocities",
    )


class Langevin(_Dynamics):
    """Constant temperature: BAOAB."""

    kind: Literal["langevin"]
    temperature: NonNegative = Field(description="of the bath, and of drawn velocities (K or ε/k)")
    friction: float = Field(gt=0, description="friction coefficient (1/ps or 1/τ)")


Dynamics = Annotated[NVE | Langevin, Discriminator("kind")]


class Precision(Table):
    """Which float plays which role."""

    state: FloatName = Field("float64", description="positions and velocities")
    force: FloatName = Field("float64", description="pair distances, energies and forces")
    decision: FloatName = Field("float64", description="the quantity compared with a threshold")
    accumulate: FloatName = Field("float64", description="sums over pairs")
    reduction: Literal["sequential", "pairwise"] = Field("sequential", description="order of the sums")


class Record(Table):
    """What is kept besides series, flips and epochs."""

    save_every: int = Field(0, ge=0, description="write a trajectory frame every so many steps; 0: none")


class SystemSpec(Table):
    """A system file."""

    name: str | None = Field(None, description="what to call the system; default the file's name")
    about: str = Field("", description="one sentence or more for people, with the source")
    units: Literal["metal", "lj"] = Field(description="metal: Å, eV, amu, ps, K; lj: reduced")
    structure: Structure
    potential: Potential
    cutoff: Cutoff | None = Field(None, description="pair potentials only")
    neighbors: Neighbors = Field(default_factory=lambda: Neighbors())
    dynamics: Dynamics
    precision: Precision = Field(default_factory=lambda: Precision())
    record: Record = Field(default_factory=lambda: Record())

    @model_validator(mode="after")
    def _cutoff_fits_potential(self) -> SystemSpec:
        kind = self.potential.kind
        if isinstance(self.potential, PairPotential):
            if self.cutoff is None:
                raise ValueError(f"table [cutoff] missing; {kind} needs one")
            if self.cutoff.in_sigma is not None and isinstance(self.potential, Morse):
                raise ValueError(
                    "cutoff.in_sigma needs a potential with a sigma; morse has none, give radius"
                )
        elif self.cutoff is not None:
            raise ValueError(f"[cutoff] given, but {kind} carries its own cutoff; remove the table")
        return self

    @property
    def skin(self) -> float:
        """The Verlet skin, the default of the unit system where the file is silent."""
        skin = self.neighbors.skin
        return DEFAULT_SKIN[unit_systems.get(self.units).name] if skin is None else skin


def json_schema() -> dict[str, Any]:
    """The JSON schema of a system file, for editors (systems/schema.json)."""
    schema = SystemSpec.model_json_schema()
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "mdnum system file",
    }
