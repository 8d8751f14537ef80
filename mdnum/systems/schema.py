"""Schema of a molecular-dynamics system file: one pydantic model per table.

Validation is strict: a misspelled key or a string in place of a number is an error. Quantities are in the
units of the file: Å, eV, amu, ps and K for "metal", and reduced Lennard-Jones units for "lj".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_args

from pydantic import ConfigDict, Discriminator, Field, Tag, create_model, model_validator

from mdnum import units as unit_systems
from mdnum.systems.toml import Key, Named, NonNegative, Positive, TomlTable, from_array, loaded

Length = Annotated[float, Field(gt=0, description="length (Å or σ)")]
Energy = Annotated[float, Field(gt=0, description="energy (eV or ε)")]
Compare = Literal["r2 <", "r2 <=", "r <", "r <="]

#: Default onset of a switched cutoff, as a fraction of its radius.
ONSET_FRACTION = 0.9


# --- potential ----------------------------------------------------------------------------------------


def pair_key(a: str, b: str) -> str:
    """Return the name of a pair of species, such as "Ni-P". The order of the species has no effect."""
    return "-".join(sorted((a, b)))


def pair_names(symbols: Sequence[str]) -> list[str]:
    """Return the names of all pairs of species in the order of pair types ("Ni-Ni", "Ni-P", "P-P")."""
    return [f"{a}-{b}" for a, b in combinations_with_replacement(symbols, 2)]


def _check_pairs(pairs: Mapping[str, Any] | None) -> None:
    seen: dict[str, str] = {}
    for name in pairs or {}:
        parts = name.split("-")
        if len(parts) != 2 or not all(part.isalpha() for part in parts):
            raise ValueError(f"the pair {name!r} is not two species joined by a hyphen, such as 'Ni-P'")
        key = pair_key(*parts)
        if key in seen:
            raise ValueError(f"the pair of species {name!r} is given twice, the first time as {seen[key]!r}")
        seen[key] = name


class LennardJonesPair(TomlTable):
    """Lennard-Jones constants of one pair of species."""

    sigma: Length = Field(description="distance of zero energy (Å or σ)")
    epsilon: Energy = Field(description="well depth (eV or ε)")


class MorsePair(TomlTable):
    """Morse constants of one pair of species."""

    depth: Energy = Field(description="well depth D (eV or ε)")
    alpha: float = Field(gt=0, description="stiffness (1/length)")
    r0: Length = Field(description="distance of the minimum (Å or σ)")


class SoftSpherePair(TomlTable):
    """Soft-sphere constants of one pair of species."""

    sigma: Length = Field(description="diameter (Å or σ)")
    epsilon: Energy = Field(description="energy scale (eV or ε)")
    alpha: float = Field(default=2.0, gt=1, description="exponent; 2 is harmonic, 2.5 Hertzian")


class PairPotentialTable(TomlTable):
    """A pair potential. Its constants apply to all pairs, or to one pair of species."""

    if TYPE_CHECKING:
        kind: str
        pairs: Mapping[str, Any] | None

    @model_validator(mode="after")
    def _complete(self) -> Any:
        pairs = getattr(self, "pairs", None)
        _check_pairs(pairs)
        if not pairs:
            missing = [key for key in self.constants if getattr(self, key, None) is None]
            if missing:
                raise ValueError(f"no value of {', '.join(missing)} was given, either here or in [pairs]")
        return self

    @property
    def constants(self) -> tuple[str, ...]:
        """Names of the constants of the potential for one pair of species."""
        return tuple(key for key in type(self).model_fields if key not in ("kind", "pairs"))


def _pair_table(name: str, kind: str, row: type[TomlTable], description: str) -> Any:
    """Create the schema of a pair potential."""
    columns: dict[str, Any] = {"kind": (Literal[kind], ...)}
    for key, field in row.model_fields.items():
        value: Any = Annotated[field.annotation, *field.metadata]
        given = Field(default=None, description=field.description)
        columns[key] = (value | None, given) if field.is_required() else (field.annotation, field)
    rows = Field(default=None, description='constants of each pair of species, such as "Ni-P"')
    columns["pairs"] = (dict[str, row] | None, rows)
    return create_model(name, __base__=PairPotentialTable, __doc__=description, **columns)


LennardJonesTable = _pair_table(
    "LennardJonesTable", "lennard-jones", LennardJonesPair, "4 ε [(σ/r)^12 - (σ/r)^6]."
)
MorseTable = _pair_table("MorseTable", "morse", MorsePair, "D [(1 - exp(-α (r - r0)))^2 - 1].")
SoftSphereTable = _pair_table(
    "SoftSphereTable", "soft-sphere", SoftSpherePair, "(ε/α) (1 - r/σ)^α inside σ, nothing outside."
)


class ManyBodyTable(TomlTable):
    """A many-body potential with its own cutoff."""

    if TYPE_CHECKING:
        kind: str
        parameters: str


class StillingerWeberTable(ManyBodyTable):
    """Two- and three-body potential of Stillinger and Weber (Phys. Rev. B 31, 5262, 1985)."""

    kind: Literal["stillinger-weber"]
    parameters: Literal["Si"] = Field(default="Si", description="set of constants; Si: the original silicon")


class TersoffTable(ManyBodyTable):
    """Bond-order potential of Tersoff (Phys. Rev. B 38, 9902, 1988)."""

    kind: Literal["tersoff"]
    parameters: Literal["Si"] = Field(default="Si", description="set of constants; Si: Tersoff's T3 silicon")


class EmbeddedAtomTable(ManyBodyTable):
    """Embedded-atom potential, read from a tabulated potential file."""

    kind: Literal["eam"]
    file: str = Field(description="setfl table (.eam.alloy), relative to this file")


class PythonTable(PairPotentialTable):
    """A pair potential u(r, ...) or u(r2, ...) in a Python file, which is executed only with permission."""

    kind: Literal["python"]
    function: str = Field(description='file and name, "mine.py:morse", relative to this file')
    parameters: dict[str, Any] = Field(
        default_factory=dict,
        description='by name: a number, one for each pair of species such as "Ni-P", or lists and tables of '
        "numbers that all pairs share",
    )

    @property
    def constants(self) -> tuple[str, ...]:
        """Names of constants: always empty, because the Python function defines its own parameters."""
        return ()


_MANY_BODY = (StillingerWeberTable, TersoffTable, EmbeddedAtomTable)
_PAIRS = (LennardJonesTable, MorseTable, SoftSphereTable, PythonTable)


def _kinds(*tables: type[TomlTable]) -> list[str]:
    return [get_args(table.model_fields["kind"].annotation)[0] for table in tables]


def _other_than(*tables: type[TomlTable]) -> Any:
    """Return the type of the key `kind` in tables of other packages."""
    return Field(json_schema_extra={"not": {"enum": [*_kinds(*tables)]}})


class OtherRow(TomlTable):
    """Constants of one pair of species for a pair potential from another package."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float]


class OtherTable(PairPotentialTable):
    """A pair potential from another package. Its keys are the fields of its class."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float]

    kind: str = _other_than(*_PAIRS, *_MANY_BODY)
    pairs: dict[str, OtherRow] | None = Field(
        default=None, description='constants of each pair of species, such as "Ni-P"'
    )

    @property
    def constants(self) -> tuple[str, ...]:
        """Names of the constants of the potential for one pair of species."""
        return tuple(field.name for field in fields(loaded(_POTENTIALS)[self.kind]))

    @model_validator(mode="after")
    def _known(self) -> Any:
        for row in (self, *(self.pairs or {}).values()):
            _check_names(row.__pydantic_extra__, self.constants)
        return self


def _check_names(given: Mapping[str, Any], known: Sequence[str]) -> None:
    if unknown := set(given) - set(known):
        raise ValueError(f"unknown key {', '.join(sorted(unknown))}; known keys are {', '.join(known)}")


def _or_other(tables: Sequence[type[TomlTable]], other: type[TomlTable], registry: str) -> Any:
    """Return a union type of tables by kind, including kinds of other packages."""
    tags = dict(zip(_kinds(*tables), tables, strict=True))

    def kind_of(value: Any) -> Any:
        kind = value.get("kind") if isinstance(value, Mapping) else getattr(value, "kind", None)
        if not isinstance(kind, str) or kind in tags:
            return kind
        return "other" if kind in loaded(registry) else kind

    options = [Annotated[table, Tag(kind)] for kind, table in tags.items()]
    return Annotated[Union[*options, Annotated[other, Tag("other")]], Discriminator(kind_of)]


_POTENTIALS = "mdnum.md.potentials:POTENTIALS"
Potential = _or_other((*_PAIRS, *_MANY_BODY), OtherTable, _POTENTIALS)


# --- cutoff -------------------------------------------------------------------------------------------


def _switches(kind: Any) -> bool:
    # imported here, because a file of the ball needs no molecular dynamics
    from mdnum.md.cutoffs import CUTOFFS

    return kind not in CUTOFFS or CUTOFFS[kind].switches


class CutoffTable(TomlTable):
    """The kind of cutoff of a pair potential, and its radius."""

    kind: Annotated[str, Named("mdnum.md.cutoffs:CUTOFFS")]
    radius: Length | None = Field(default=None, description="cutoff radius (Å or σ)")
    in_sigma: Positive | None = Field(
        default=None, description="cutoff radius as a multiple of each pair's sigma, instead of radius"
    )
    pairs: dict[str, Length] | None = Field(
        default=None, description='cutoff radius of single pairs of species, such as "Ni-P" (Å or σ)'
    )
    compare: Compare = Field(default="r2 <", description="what inside means: the quantity compared, and how")
    onset: Positive | None = Field(
        default=None,
        description="for kinds that switch: where switching starts, in the unit of radius (or of in_sigma); "
        "default 0.9 of it; pairs with a radius of their own keep onset/radius",
    )

    @property
    def switches(self) -> bool:
        """True if this cutoff has a switching function."""
        return _switches(self.kind)

    @property
    def base(self) -> float | None:
        """Cutoff radius to compare the onset with, as a length or a multiple of sigma."""
        return self.radius if self.radius is not None else self.in_sigma

    @staticmethod
    def foreign_keys(table: Mapping[str, Any]) -> set[str]:
        """Return the keys of a cutoff table that its kind does not have."""
        kind = table.get("kind")
        return set() if _switches(kind) else {"onset"}

    @model_validator(mode="after")
    def _one_radius(self) -> Any:
        _check_pairs(self.pairs)
        if self.radius is not None and self.in_sigma is not None:
            raise ValueError("the cutoff radius is given twice, by radius and by in_sigma; remove one key")
        if self.base is None and not self.pairs:
            raise ValueError("no cutoff radius was given; add “radius” or “in_sigma”, or the table “pairs”")
        if self.onset is None:
            return self
        if not self.switches:
            raise ValueError(f"onset is given, but {self.kind} cutoffs have no switching range; remove onset")
        if self.base is None:
            raise ValueError(
                "onset needs the key radius or in_sigma, because the onset of each pair scales with it"
            )
        if self.onset >= self.base:
            raise ValueError(f"the switching onset {self.onset:g} is not below the cutoff {self.base:g}")
        return self


# --- structure, lists, dynamics, precision ---------------------------------------------------------------
FloatName = Literal["float64", "float32"]
#: Default skin: LAMMPS uses 2.0 Å and 0.3 σ; 1.0 Å suits the argon-sized systems of mdnum.
DEFAULT_SKIN = {"metal": 1.0, "lj": 0.3}

Flags = Annotated[tuple[bool, bool, bool], from_array]
Count = Annotated[int, Field(gt=0)]
Triple = Annotated[tuple[float, float, float], from_array]


class _Structure(TomlTable):
    pbc: Flags | None = Field(
        default=None, description="periodic along each cell vector; overrides what the structure says"
    )
    masses: dict[str, Positive] | None = Field(
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
    """A perfect crystal that is generated from its lattice type and lattice constant."""

    builder: Literal["fcc", "bcc", "sc", "diamond"] = Field(description="lattice, with its cubic cell")
    symbol: str = Field(description="chemical symbol")
    lattice_constant: Length = Field(description="edge of the cubic cell (Å or σ)")
    repeat: Annotated[tuple[Count, Count, Count], from_array] = Field(
        default=(1, 1, 1), description="cells along x, y and z"
    )
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


class RebuildTable(TomlTable):
    """The rule of list rebuilds, with the options of LAMMPS's neigh_modify."""

    every: int = Field(default=1, ge=1, description="consider a rebuild every so many steps")
    delay: int = Field(
        default=0, ge=0, description="but never sooner than this many steps after the last one"
    )
    check: bool = Field(
        default=True,
        description="rebuild only when half the skin is used up; false: blindly, which may lose pairs",
    )


class NeighborsTable(TomlTable):
    """Settings of the Verlet neighbor list."""

    skin: NonNegative | None = Field(
        default=None, description="extra radius of the list (Å or σ); default 1.0 Å for metal, 0.3 σ for lj"
    )
    builder: Annotated[str, Named("mdnum.md.neighbors:BUILDERS", "auto")] = Field(
        default="auto",
        description="who searches for neighbors; auto: host on a CPU, device on an accelerator",
    )
    rebuild: RebuildTable = Field(default_factory=lambda: RebuildTable())


class _Dynamics(TomlTable):
    timestep: float = Field(gt=0, description="time step (ps or τ)")
    steps: int = Field(default=1000, ge=0, description="steps of a run")
    seed: int = Field(default=0, ge=0, description="seed of drawn velocities and of the noise")
    remove_drift: bool = Field(default=True, description="take out the center-of-mass velocity at the start")


class NVETable(_Dynamics):
    """Dynamics at constant energy with the velocity Verlet integrator."""

    kind: Literal["nve"]
    temperature: NonNegative = Field(
        default=0.0,
        description="of drawn velocities (K or ε/k), 0 is at rest; unused where the structure has velocities",
    )


class LangevinTable(_Dynamics):
    """Langevin dynamics at constant temperature (the BAOAB integrator)."""

    kind: Literal["langevin"]
    temperature: NonNegative = Field(description="of the bath, and of drawn velocities (K or ε/k)")
    friction: float = Field(gt=0, description="friction coefficient (1/ps or 1/τ)")


class _ThermostatTable(_Dynamics):
    temperature: Positive = Field(description="of the thermostat, and of drawn velocities (K or ε/k)")
    relaxation: Positive = Field(description="relaxation time of the temperature (ps or τ)")


class _BarostatTable(_ThermostatTable):
    pressure: float = Field(description="pressure (GPa or ε/σ³)")
    pressure_relaxation: Positive = Field(description="relaxation time of the pressure (ps or τ)")
    box: Literal["isotropic", "full"] = Field(
        default="isotropic", description="isotropic: the volume alone; full: all lengths and angles"
    )


Links = Annotated[int, Field(ge=1, le=20, description="thermostats of a chain")]


class NoseHooverTable(_ThermostatTable):
    """Dynamics at constant temperature with a Nosé-Hoover chain."""

    kind: Literal["nose-hoover"]
    chain: Links = 3


class CSVRTable(_ThermostatTable):
    """Dynamics at constant temperature with stochastic velocity rescaling."""

    kind: Literal["csvr"]


class MTKTable(_BarostatTable):
    """Dynamics at constant pressure and temperature by the method of Martyna, Tobias and Klein."""

    kind: Literal["mtk"]
    chain: Links = 3


class CellRescalingTable(_BarostatTable):
    """Dynamics at constant pressure and temperature with stochastic cell rescaling."""

    kind: Literal["cell-rescaling"]
    compressibility: Positive = Field(
        description="estimate of the isothermal compressibility (1/GPa or σ³/ε); it sets a rate, no average"
    )


_DYNAMICS = (NVETable, LangevinTable, NoseHooverTable, CSVRTable, MTKTable, CellRescalingTable)


class OtherDynamics(_Dynamics):
    """An integrator from another package. Its keys are the fields of its class."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, bool | int | float | str]

    kind: str = _other_than(*_DYNAMICS)
    temperature: NonNegative = Field(
        default=0.0, description="of a thermostat, and of drawn velocities (K or ε/k)"
    )

    @model_validator(mode="after")
    def _known(self) -> Any:
        keys, given = loaded(_INTEGRATORS)[self.kind].keys(), self.__pydantic_extra__
        _check_names(given, sorted(keys.keys() - type(self).model_fields))
        needed = [key for key, field in keys.items() if field.default is MISSING and key != "seed"]
        if missing := [key for key in needed if key not in given.keys() | self.model_fields_set]:
            raise ValueError(f"values of {', '.join(missing)} are missing")
        return self


_INTEGRATORS = "mdnum.md.integrators:INTEGRATORS"
Dynamics = _or_other(_DYNAMICS, OtherDynamics, _INTEGRATORS)


class DynamicsAlone(TomlTable):
    """The dynamics table of a simulation made from objects."""

    dynamics: Dynamics


class PrecisionTable(TomlTable):
    """The floating-point format of each quantity, such as positions, forces and energies."""

    state: Literal["float64", "float32", "lattice"] = Field(
        default="float64",
        description="positions and velocities (with sixteen bits a step would move no atom); lattice: "
        "fixed-point numbers, decisions and sums without rounding, steps that can be reversed exactly",
    )
    force: Literal["float64", "float32", "bfloat16", "float16"] = Field(
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
    reduction: Annotated[str, Named("mdnum.numerics.reductions:REDUCTIONS")] = Field(
        default="sequential",
        description="order of the sums; exact and fixed-point give the same bits in every order of neighbors",
    )


class ForkTable(TomlTable):
    """Options of `mdnum fork` for this system. The command line overrides them."""

    vary: str | None = Field(
        default=None,
        description='the choice to vary, such as "precision", "reduction=exact" or "contact=earlier"',
    )
    steps: int | None = Field(default=None, ge=1, description="last step; default the steps of a run")
    split: Positive | None = Field(
        default=None,
        description="separation that counts as split (Å or σ, m); default 0.01 of the cutoff, of a ball 0.01 "
        "of the highest start",
    )


class RecordTable(TomlTable):
    """Data that a run records besides time series, flips and list rebuilds."""

    save_every: int = Field(
        default=0, ge=0, description="write a trajectory frame every so many steps; 0: none"
    )


class Interaction(NamedTuple):
    """A potential and its cutoff, without the other tables of a system file."""

    potential: Any  # a table of `Potential`
    cutoff: CutoffTable | None


def check_interaction(potential: Any, cutoff: CutoffTable | None) -> None:
    """Raise ValueError if a potential and a cutoff cannot be combined."""
    kind = potential.kind
    if isinstance(potential, PairPotentialTable):
        if cutoff is None:
            raise ValueError(f"the table [cutoff] is missing, but {kind} needs a cutoff; add the table")
        if cutoff.in_sigma is not None and "sigma" not in potential.constants:
            raise ValueError(f"cutoff.in_sigma is given, but {kind} has no sigma; give cutoff.radius")
    elif cutoff is not None:
        raise ValueError(f"the table [cutoff] is given, but {kind} includes its own cutoff; remove it")


class TermTable(TomlTable):
    """A pair potential with its cutoff, for a sum of potentials."""

    potential: Potential
    cutoff: CutoffTable | None = None
    weight: dict[str, float] | None = Field(
        default=None, description="of the atoms of each species; a pair's energy is multiplied by both"
    )

    @model_validator(mode="after")
    def _cutoff_fits_potential(self) -> TermTable:
        if not isinstance(self.potential, PairPotentialTable):
            raise ValueError(
                f"the term {self.potential.kind} is not a pair potential; only pair potentials can be added"
            )
        check_interaction(self.potential, self.cutoff)
        return self


def _with_onset(cutoff: CutoffTable | None) -> CutoffTable | None:
    if cutoff is not None and cutoff.switches and cutoff.onset is None and cutoff.base is not None:
        return cutoff.model_copy(update={"onset": ONSET_FRACTION * cutoff.base})
    return cutoff


def _one_of(made: dict[str, Any]) -> None:
    """In the JSON schema, replace the type "table or null" by "table", for editors."""
    made |= made.pop("anyOf")[0]


class SystemSpec(TomlTable):
    """The contents of a molecular-dynamics system file."""

    name: str | None = Field(default=None, description="what to call the system; default the file's name")
    about: str = Field(default="", description="one sentence or more for people, with the source")
    units: Literal["metal", "lj"] = Field(description="metal: Å, eV, amu, ps, K; lj: reduced")
    structure: Structure
    potential: Potential | None = Field(default=None, json_schema_extra=_one_of)
    cutoff: CutoffTable | None = Field(default=None, description="pair potentials only")
    terms: dict[str, TermTable] | None = Field(
        default=None, description="pair potentials that add, by name, instead of potential and cutoff"
    )
    neighbors: NeighborsTable = Field(default_factory=lambda: NeighborsTable())
    dynamics: Dynamics
    precision: PrecisionTable = Field(default_factory=lambda: PrecisionTable())
    record: RecordTable = Field(default_factory=lambda: RecordTable())
    fork: ForkTable | None = Field(
        default=None, description="a question about this system; not about its runs"
    )

    @model_validator(mode="after")
    def _cutoff_fits_potential(self) -> SystemSpec:
        if (self.potential is None) != bool(self.terms) or (self.terms and self.cutoff):
            raise ValueError(
                "give [potential] (and [cutoff] for a pair potential), or else tables [terms.NAME.potential]"
            )
        if self.potential is not None:
            check_interaction(self.potential, self.cutoff)
        if len({one.cutoff.compare for one in self.interactions.values() if one.cutoff}) > 1:
            raise ValueError("the potential terms differ in cutoff.compare; expected one value in all terms")
        return self

    @property
    def interactions(self) -> dict[str, Interaction]:
        """Potential and cutoff of each term by name. A single potential has the name ""."""
        if self.terms is None:
            return {"": Interaction(self.potential, self.cutoff)}
        return {name: Interaction(one.potential, one.cutoff) for name, one in self.terms.items()}

    @property
    def compare(self) -> str:
        """Comparison for pairs inside the cutoff, such as "r2 <"."""
        return next((one.cutoff.compare for one in self.interactions.values() if one.cutoff), "r <")

    @property
    def skin(self) -> float:
        """Skin of the Verlet list; the default depends on the unit system."""
        skin = self.neighbors.skin
        return DEFAULT_SKIN[unit_systems.get(self.units).name] if skin is None else skin

    @property
    def resolved(self) -> SystemSpec:
        """Tables of the system file, including default values that depend on other keys."""
        update: dict[str, Any] = {"neighbors": self.neighbors.model_copy(update={"skin": self.skin})}
        update["cutoff"] = _with_onset(self.cutoff)
        if self.terms is not None:
            update["terms"] = {
                name: one.model_copy(update={"cutoff": _with_onset(one.cutoff)})
                for name, one in self.terms.items()
            }
        return self.model_copy(update=update)

    @staticmethod
    def follow(data: dict[str, Any], values: Mapping[Key, Any]) -> None:
        """Request new random velocities for an NVE system with a new temperature or seed."""
        structure, dynamics = data.get("structure"), data.get("dynamics")
        if not isinstance(structure, dict) or not isinstance(dynamics, dict) or dynamics.get("kind") != "nve":
            return
        asked = {("dynamics", "temperature"), ("dynamics", "seed")} & set(values)
        if asked and ("structure", "velocities") not in values:
            structure["velocities"] = "drawn"
