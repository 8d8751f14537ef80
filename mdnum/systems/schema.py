"""What a system file may say: frozen pydantic models, one per table, with the unit of every number.

Why strict: a system file decides what is computed, so a misspelled key or a string where a number belongs
is refused (mdnum.systems.load turns each refusal into one line). Lengths, energies and times are in the
units of the file: Å, eV, amu, ps and K for "metal"; multiples of σ, ε, m and τ for "lj".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from mdnum import units as unit_systems
from mdnum.systems.interactions import (
    ONSET_FRACTION,
    Cutoff,
    EmbeddedAtom,
    Length,
    LennardJones,
    ManyBodyPotential,
    Morse,
    NonNegative,
    PairPotential,
    Potential,
    SoftSphere,
    StillingerWeber,
    SwitchingCutoff,
    Table,
    Tersoff,
    pair_key,
)

__all__ = [
    "DEFAULT_SKIN",
    "NVE",
    "ONSET_FRACTION",
    "BuilderStructure",
    "Cutoff",
    "Dynamics",
    "EmbeddedAtom",
    "FileStructure",
    "Fork",
    "Langevin",
    "LennardJones",
    "ManyBodyPotential",
    "Morse",
    "Neighbors",
    "PairPotential",
    "Potential",
    "Precision",
    "Rebuild",
    "Record",
    "SoftSphere",
    "StillingerWeber",
    "Structure",
    "SwitchingCutoff",
    "SystemSpec",
    "Tersoff",
    "json_schema",
    "pair_key",
]

FloatName = Literal["float64", "float32"]
StateName = Literal["float64", "float32", "lattice"]
ForceFloatName = Literal["float64", "float32", "bfloat16", "float16"]
ReductionName = Literal[
    "sequential",
    "reversed",
    "permuted",
    "pairwise",
    "blocked",
    "kahan",
    "neumaier",
    "sorted",
    "exact",
    "fixed-point",
]

DEFAULT_SKIN = {"metal": 1.0, "lj": 0.3}
"""Skin when the file gives none: LAMMPS uses 2.0 Å and 0.3 σ; 1.0 Å suits the argon-sized systems here."""


def _tuple(value: Any) -> Any:
    # TOML has arrays only; strict pydantic would refuse a list where a tuple is declared
    return tuple(value) if isinstance(value, list) else value


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
        default=None, description="periodic along each cell vector; overrides what the structure says"
    )
    masses: Masses | None = Field(
        default=None,
        description="mass of each species (amu or m); default: the file's, else ASE's for metal and 1 for lj",
    )
    velocities: Literal["file", "drawn"] = Field(
        default="file",
        description="file: the structure's velocities when it has any; drawn: always Maxwell-Boltzmann at "
        "dynamics.temperature from dynamics.seed",
    )


class FileStructure(_Structure):
    """A structure read from a file."""

    file: str = Field(
        description="anything ase.io reads, relative to this file; lengths in Å or σ, momenta in ASE's units"
    )
    index: int = Field(default=-1, description="frame to take from a file of several; -1 is the last")


class BuilderStructure(_Structure):
    """A perfect crystal, built."""

    builder: Literal["fcc", "bcc", "sc", "diamond"] = Field(description="lattice, with its cubic cell")
    symbol: str = Field(description="chemical symbol")
    lattice_constant: Length = Field(description="edge of the cubic cell (Å or σ)")
    repeat: Counts = Field(default=(1, 1, 1), description="cells along x, y and z")
    tilt: Triple = Field(
        default=(0.0, 0.0, 0.0), description="shear of the whole crystal: xy, xz and yz, length per length"
    )
    rattle: NonNegative = Field(
        default=0.0, description="standard deviation of a random displacement of every coordinate (Å or σ)"
    )
    seed: int = Field(default=0, ge=0, description="seed of the rattle")


def _structure_tag(value: Any) -> str:
    if isinstance(value, Mapping):
        return "builder" if "builder" in value else "file"
    return "builder" if isinstance(value, BuilderStructure) else "file"


Structure = Annotated[
    Annotated[FileStructure, Tag("file")] | Annotated[BuilderStructure, Tag("builder")],
    Discriminator(_structure_tag),
]


class Rebuild(Table):
    """When the list is rebuilt, in the words of LAMMPS's neigh_modify."""

    every: int = Field(default=1, ge=1, description="consider a rebuild every so many steps")
    delay: int = Field(
        default=0, ge=0, description="but never sooner than this many steps after the last one"
    )
    check: bool = Field(
        default=True,
        description="rebuild only when half the skin is used up; false: blindly, which may lose pairs",
    )


class Neighbors(Table):
    """The Verlet list."""

    skin: NonNegative | None = Field(
        default=None, description="extra radius of the list (Å or σ); default 1.0 Å for metal, 0.3 σ for lj"
    )
    builder: Literal["auto", "host", "jax-md"] = Field(
        default="auto", description="who searches for neighbors"
    )
    rebuild: Rebuild = Field(default_factory=lambda: Rebuild())


class _Dynamics(Table):
    timestep: float = Field(gt=0, description="time step (ps or τ)")
    steps: int = Field(default=1000, ge=0, description="steps of a run")
    seed: int = Field(default=0, ge=0, description="seed of drawn velocities and of the noise")
    remove_drift: bool = Field(default=True, description="take out the center-of-mass velocity at the start")


class NVE(_Dynamics):
    """Constant energy: velocity Verlet."""

    kind: Literal["nve"]
    temperature: NonNegative = Field(
        default=0.0,
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

    state: StateName = Field(
        default="float64",
        description="positions and velocities (with sixteen bits a step would move no atom); lattice: whole "
        "numbers, whose decisions and sums have no rounding and whose steps can be taken back exactly",
    )
    force: ForceFloatName = Field(
        default="float64",
        description="pair distances, energies and forces; in bfloat16 and float16 distances are those of the "
        "decision, rounded",
    )
    decision: FloatName = Field(
        default="float64",
        description="the quantity compared with a threshold (with sixteen bits the grid of coordinates would "
        "decide)",
    )
    accumulate: FloatName = Field(
        default="float64", description="sums over pairs (with sixteen bits the small terms would be lost)"
    )
    reduction: ReductionName = Field(
        default="sequential",
        description="order of the sums; exact and fixed-point give the same bits in every order of neighbors",
    )


class Fork(Table):
    """What `mdnum fork` does with this system where the command line does not say."""

    vary: str | None = Field(
        default=None, description='the choice to vary, such as "precision" or "reduction=exact"'
    )
    steps: int | None = Field(default=None, ge=1, description="last step; default dynamics.steps")
    split: float | None = Field(
        default=None, gt=0, description="separation that counts as split (Å or σ); default 0.01 of the cutoff"
    )


class Record(Table):
    """What is kept besides series, flips and epochs."""

    save_every: int = Field(
        default=0, ge=0, description="write a trajectory frame every so many steps; 0: none"
    )


class SystemSpec(Table):
    """A system file."""

    name: str | None = Field(default=None, description="what to call the system; default the file's name")
    about: str = Field(default="", description="one sentence or more for people, with the source")
    units: Literal["metal", "lj"] = Field(description="metal: Å, eV, amu, ps, K; lj: reduced")
    structure: Structure
    potential: Potential
    cutoff: Cutoff | None = Field(default=None, description="pair potentials only")
    neighbors: Neighbors = Field(default_factory=lambda: Neighbors())
    dynamics: Dynamics
    precision: Precision = Field(default_factory=lambda: Precision())
    record: Record = Field(default_factory=lambda: Record())
    fork: Fork | None = Field(default=None, description="a question about this system; not about its runs")

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
