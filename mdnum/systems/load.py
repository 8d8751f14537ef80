"""Find and load system files: shipped systems by name, other files by path."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from mdnum import units as unit_systems
from mdnum.errors import InputError, expect_path
from mdnum.plain import shipped_folder, shipped_systems
from mdnum.reading import whole_text
from mdnum.registry import meant
from mdnum.store.files import SIMULATION_FILE, SYSTEM_FILE, disk_errors, replacing, write_text
from mdnum.systems import code, pairs, schema, structures, toml
from mdnum.systems.ball import BallSpec, ValuesControl
from mdnum.systems.toml import Source, apply_overrides, checked, read_overrides

if TYPE_CHECKING:
    from ase import Atoms


STRUCTURE_FILE = "structure.extxyz"
#: Keys of a system file: texts, values with a separate digest, and requests for the run.
_NOT_THE_PROGRAM = {"name", "about", "structure", "gradient", "variants", "fork"}
#: Remedy for a folder whose simulation was not built from a file.
GIVE_OBJECTS = "Give the simulation itself, made by the same code, from Python"
BALL_SCHEMA = "ball-schema.json"


def names(world: Literal["md", "ball"] | None = None) -> list[str]:
    """Return the names of the shipped systems, such as "argon/liquid-864".

    Args:
        world: "md" or "ball" to return only the systems of this kind.
    """
    root = shipped_folder()
    return [name for name in shipped_systems() if world in (None, _world(root / f"{name}.toml"))]


def world_of(name: Any) -> str:
    """Return "ball" for a bouncing-ball system, otherwise "md". The file is not validated.

    Raises:
        InputError: no system has this name.
    """
    if not isinstance(name, str | Path):
        return "ball" if isinstance(name, BallSystem) else "md"
    try:
        return str(_world(find(name)[1]))
    except (ValueError, RecursionError):
        # whoever loads it says where the mistake is
        return "md"


def _world(path: Path) -> str:
    return tomllib.loads(whole_text(path, path)).get("world", "md")


def find(name: str | Path) -> tuple[str, Path]:
    """Find the name and file of a system from a TOML file, a folder with system.toml, or a shipped name.

    Raises:
        InputError: no system has this name; the message suggests the most similar shipped name.
    """
    expect_path(name, "Give a shipped name, the path of a system file or its folder, or a loaded system")
    path = Path(name)
    text = str(name)
    if path.is_dir() and (path / SYSTEM_FILE).is_file():
        return path.resolve().name, path / SYSTEM_FILE
    if path.is_dir() and (path / SIMULATION_FILE).is_file():
        raise InputError(
            "the run was built from Python objects, which cannot be loaded from its folder",
            where=text,
            remedy=GIVE_OBJECTS,
        )
    if path.is_file():
        return path.stem, path
    if path.suffix == ".toml":
        raise InputError("the system file does not exist", where=text, remedy="Check the path")
    known = names()
    if text in known:
        return text, shipped_folder() / f"{text}.toml"
    short = [one for one in known if one.split("/")[-1] == text]
    hint = meant(short[0] if short else text, known)
    raise InputError(
        f"there is neither a shipped system nor a file called {text!r}",
        remedy=(
            f"{hint}List the shipped systems with `mdnum systems list`, or give your own system as the path "
            "of a .toml file"
        ),
    )


def shown(path: Path) -> str:
    """Return a path for messages, relative to the working directory if possible."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def _made(folder: str | Path) -> Path:
    """Create a missing folder, and return its path."""
    target = Path(folder)
    with disk_errors(target):
        target.mkdir(parents=True, exist_ok=True)
    return target


@dataclass(frozen=True)
class System:
    """A validated molecular-dynamics system: the tables of its system file, and its atoms.

    Attributes:
        name: name of the system, such as "argon/liquid-864".
        spec: tables of the file, with defaults filled in.
        path: path of the file, or None.
        atoms: positions in the file's unit of length; momenta in ASE's units (reduced units for lj) if the
            structure has velocities; otherwise velocities are drawn at the start of a run.
    """

    name: str
    spec: schema.SystemSpec
    path: Path | None
    atoms: Atoms

    @property
    def units(self) -> unit_systems.Units:
        """Unit system of the system file: "metal" or "lj"."""
        return unit_systems.get(self.spec.units)

    @property
    def folder(self) -> Path:
        """Folder that contains the files to which the system file refers."""
        return self.path.parent if self.path else Path()

    @property
    def species(self) -> tuple[str, ...]:
        """Chemical symbols of the species in the structure, sorted."""
        return structures.species_of(self.atoms)[0]

    @property
    def draw(self) -> structures.Draw:
        """Settings for drawing the random velocities of step 0."""
        dynamics, drawn = self.spec.dynamics, not self.atoms.has("momenta")
        return structures.Draw(float(dynamics.temperature), dynamics.seed, dynamics.remove_drift, drawn)

    @property
    def without_skin(self) -> System:
        """The same system with a Verlet skin of 0, for small boxes."""
        neighbors = self.spec.neighbors.model_copy(update={"skin": 0.0})
        return replace(self, spec=self.spec.model_copy(update={"neighbors": neighbors}))

    @property
    def ignored(self) -> list[str]:
        """Columns of the structure file that resemble velocities but are not read."""
        structure = self.spec.structure
        return structures.ignored(structure, self.folder) if structure.velocities == "file" else []

    @property
    def r_cut(self) -> float:
        """Largest distance at which two atoms interact directly, in length units."""
        return pairs.longest_radius(self.spec, self.species, self.folder)

    @property
    def program(self) -> dict[str, Any]:
        """All settings of the system except its structure, as plain values for hashing."""
        made = self.spec.model_dump(mode="json", exclude=_NOT_THE_PROGRAM)
        if made.get("terms") is None:
            made.pop("terms", None)
        for table, potential in self._potentials(made):
            if isinstance(potential, schema.PythonTable):
                table["code"] = [sha256(file.read_bytes()).hexdigest() for file in self._files(potential)]
        return made

    def _potentials(self, data: dict[str, Any]) -> list[tuple[dict[str, Any], Any]]:
        """Return each potential's table in the system file, together with its validated model."""
        tables = {"": data} if self.spec.terms is None else data["terms"]
        return [(tables[name]["potential"], one.potential) for name, one in self.spec.interactions.items()]

    def _files(self, potential: Any) -> set[Path]:
        if isinstance(potential, schema.PythonTable):
            return {code.parts(potential.function, self.folder)[0]}
        return {self.folder / potential.file} if isinstance(potential, schema.EmbeddedAtomTable) else set()

    @property
    def tables(self) -> set[Path]:
        """Files that are read or executed to create the potential."""
        return {file for one in self.spec.interactions.values() for file in self._files(one.potential)}

    def to_toml(self, *, beside: bool = True) -> str:
        """Return the text of the system file, with all default values included.

        Args:
            beside: True if the text is stored in the folder that write() creates. The text then refers to the
                structure file in this folder, and loading it there recreates the system bit for bit. If
                False, the text refers to the original files of this system by absolute paths.
        """
        spec = self.spec.model_dump(mode="python", exclude_none=True)
        structure, tables = spec["structure"], [table for table, _ in self._potentials(spec)]
        if beside:
            kept = {key: structure[key] for key in ("masses", "velocities") if key in structure}
            spec["structure"] = {"file": STRUCTURE_FILE, **kept}
        for table in tables if beside else (structure, *tables):
            for key in {"file", "function"} & table.keys():
                table[key] = Path(table[key]).name if beside else str((self.folder / table[key]).resolve())
        return toml.dump({"name": self.name, **spec})

    def write(self, folder: str | Path) -> Path:
        """Write system.toml, structure.extxyz and the potential's tables. Return the path of system.toml."""
        target = _made(folder)
        with disk_errors(target):
            for table in self.tables:
                if table.resolve() != (target / table.name).resolve():
                    with replacing(target / table.name) as file:
                        file.write(table.read_bytes())
        path = target / SYSTEM_FILE
        write_text(target / STRUCTURE_FILE, structures.to_extxyz(self.atoms))
        write_text(path, self.to_toml())
        return path


@dataclass(frozen=True)
class BallSystem:
    """A validated bouncing-ball system: the tables of its system file, and its variants.

    Attributes:
        name: name of the system, such as "ball/drop".
        spec: tables of the file, with defaults filled in.
        path: path of the file, or None.
        variants: validated tables with some keys changed (listed in spec.variants), by name of the variant.
    """

    name: str
    spec: BallSpec
    path: Path | None = None
    variants: Mapping[str, BallSpec] = field(default_factory=dict)

    @property
    def program(self) -> dict[str, Any]:
        """All parameters and settings of the system, as plain values, for hashing."""
        return self.spec.model_dump(mode="json", exclude=_NOT_THE_PROGRAM)

    @property
    def balls(self) -> int:
        """Number of balls in the system."""
        return self.spec.balls

    def against(self, changes: Mapping[str, Any], name: str | None = None) -> BallSystem:
        """Return this bouncing-ball system with an additional variant.

        Args:
            changes: dotted keys to values; text is parsed as a TOML value.
            name: name of the variant; default the text of the changes.

        Raises:
            InputError: the variant cannot be run, or a variant with this name exists already.
        """
        name = name or ", ".join(f"{key}={value}" for key, value in changes.items())
        if name in self.variants:
            raise InputError(f"the variant {name!r} is defined twice", remedy="Define each variant once")
        given = {".".join(key): value for key, value in read_overrides(changes).items()}
        variant = vary(name, given, self.spec, f"--against {name}")
        tables = {**self.spec.variants, name: given}
        spec = self.spec.model_copy(update={"variants": tables})
        return BallSystem(self.name, spec, self.path, {**self.variants, name: variant})

    def for_steps(self, steps: int) -> BallSystem:
        """Return this system with another number of steps. Each step has one control acceleration.

        Args:
            steps: number of steps of a run, at least 1.
        """
        update: dict[str, Any] = {
            "integrator": self.spec.integrator.model_copy(update={"steps": steps}),
        }
        control = self.spec.flight.control
        if isinstance(control, ValuesControl):
            values = control.values[:steps]
            values += values[-1:] * (steps - len(values))
            update["flight"] = self.spec.flight.model_copy(
                update={"control": control.model_copy(update={"values": values})}
            )
        return replace(self, spec=self.spec.model_copy(update=update))

    def to_toml(self, *, beside: bool = True) -> str:
        """Return the text of the system file, with all default values. `beside` has no effect."""
        return toml.dump({"name": self.name, **self.spec.model_dump(exclude_none=True)})

    def write(self, folder: str | Path) -> Path:
        """Write the system file system.toml. Return its path."""
        path = _made(folder) / SYSTEM_FILE
        write_text(path, self.to_toml())
        return path


def vary(name: str, changes: Mapping[str, Any], base: BallSpec, where: str) -> BallSpec:
    """Change the values of some keys of a system. Return the validated tables.

    Raises:
        InputError: the changed system cannot be run.
    """
    if not changes:
        raise InputError(
            f"the variant {name!r} changes no key of the system",
            where=where,
            remedy="Add a changed key to the variant, or remove the variant",
        )
    data = base.model_dump(exclude_none=True, exclude={"variants", "name"})
    values = {toml.dotted(key): value for key, value in changes.items()}
    for key in values:
        if key[0] in ("variants", "name", "about", "world") or key == ("integrator", "steps"):
            raise InputError(
                f"variant {name!r} changes {'.'.join(key)}, which does not affect the arithmetic of a run",
                where=where,
                remedy="Remove this key from the variant",
            )
    apply_overrides(data, values, BallSpec)
    BallSpec.follow(data, values)
    try:
        spec = checked(BallSpec, data, Source(name, Path(), where))
    except InputError as error:
        raise InputError(f"variant {name!r}: {error.message}", remedy=error.remedy, where=where) from None
    if spec.balls != base.balls:
        raise InputError(
            f"the variant {name!r} has {spec.balls} balls, but the system has {base.balls}, so their "
            "contact decisions cannot be compared",
            where=where,
            remedy="Use the same number of balls in the variant and in the system",
        )
    return spec


# --- copying ----------------------------------------------------------------------------------------


def copy(name: str | Path, folder: str | Path) -> Path:
    """Copy a shipped system with its structure and potential tables, for editing. Return the new system file.

    Raises:
        InputError: the system does not exist, or a file with this name already exists.
    """
    system: System | BallSystem = load(name)
    if system.path is None:
        raise TypeError("the system was not loaded from a file, so there is no file to copy")
    target = Path(folder)
    is_ball = isinstance(system, BallSystem)
    files = [] if is_ball else sorted(system.tables)
    if not is_ball and isinstance(system.spec.structure, schema.FileStructure):
        files.append(system.folder / system.spec.structure.file)
    schema_file = shipped_folder() / (BALL_SCHEMA if is_ball else "schema.json")
    text = system.path.read_text(encoding="utf-8")
    if schema_file.is_file():
        files.append(schema_file)
        text = text.replace(f"#:schema ../{schema_file.name}", f"#:schema {schema_file.name}")
    goal = target / system.path.name
    there = [path for path in (goal, *(target / file.name for file in files)) if path.exists()]
    there = [path for path in there if path.name != schema_file.name]
    if there:
        raise InputError(
            "a file with this name already exists in the output folder",
            where=str(there[0]),
            remedy="Choose another folder",
        )
    target.mkdir(parents=True, exist_ok=True)
    for file in files:
        shutil.copyfile(file, target / file.name)
    goal.write_text(text, encoding="utf-8")
    return goal


# --- loading ------------------------------------------------------------------------------------------


Named = System | BallSystem | str | Path


@overload
def load(name: Named, overrides: Mapping[str, Any] | None = None, *, world: Literal["md"]) -> System: ...
@overload
def load(
    name: Named, overrides: Mapping[str, Any] | None = None, *, world: Literal["ball"]
) -> BallSystem: ...
@overload
def load(name: Named, overrides: Mapping[str, Any] | None = None) -> Any: ...
def load(
    name: Named,
    overrides: Mapping[str, Any] | None = None,
    *,
    world: Literal["md", "ball"] | None = None,
) -> System | BallSystem:
    """Load and validate a system. Return a BallSystem if its file has `world = "ball"`, otherwise a System.

    Example:
        >>> mdnum.load("argon/liquid-864").spec.cutoff.kind
        'hard'

    Args:
        name: a shipped name, a path to a TOML file, a folder that contains system.toml, or a loaded system,
            which is returned unchanged.
        overrides: dotted key to value, as given by `--set`: `{"cutoff.kind": "switched"}`; text is parsed as
            a TOML value. A changed kind removes keys that the new kind does not have; a changed temperature
            or seed of an NVE run draws new velocities.
        world: "md" or "ball" to reject systems of the other kind.

    Raises:
        InputError: the system cannot be run; the message is one line.
    """
    if isinstance(name, System | BallSystem):
        if overrides:
            remedy = "Load it with the overrides, or give its name"
            raise InputError("keys of a loaded system cannot be overridden", where=name.name, remedy=remedy)
        _check_world(name.name, isinstance(name, BallSystem), world)
        return name
    found, path = find(name)
    where = shown(path)
    try:
        text = whole_text(path, where)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"the system file cannot be read ({error})", where=where, remedy="Save the file as UTF-8 text"
        ) from error
    data = toml.parse(text, where)
    values = read_overrides(overrides)
    source = Source(found, path, where, text, values)
    is_ball = _is_ball(data, where)
    _check_world(name, is_ball, world)
    root = BallSpec if is_ball else schema.SystemSpec
    apply_overrides(data, values, root)
    root.follow(data, values)
    spec = checked(root, data, source)
    return _ball(spec, source) if isinstance(spec, BallSpec) else _md(spec, source)


def _check_world(name: str | Path, is_ball: bool, world: str | None) -> None:
    if world is not None and is_ball != (world == "ball"):
        verb, what = ("ball", "a ball") if is_ball else ("run", "molecular dynamics")
        raise InputError(f"the system is {what}", where=str(name), remedy=f"Use `mdnum {verb} {name}`")


def _is_ball(data: Mapping[str, Any], where: str) -> bool:
    if "world" not in data:
        if "contact" in data:
            raise InputError(
                "the system file has a table [contact], but no key `world`",
                where=where,
                remedy='Add `world = "ball"` at the top of the file',
            )
        return False
    if data["world"] != "ball":
        raise InputError(
            f'world = {data["world"]!r}; expected "ball"',
            where=where,
            remedy="For a molecular-dynamics system, omit the key `world`",
        )
    return True


def _md(spec: schema.SystemSpec, source: Source) -> System:
    spec = spec.resolved
    try:
        atoms = structures.make(spec.structure, spec.units, source.path.parent)
        system = System(spec.name or source.name, spec, source.path, atoms)
        smallest = max(_smallest(one.potential, spec.units) for one in spec.interactions.values())
        structures.check(atoms, system.r_cut, spec.skin, smallest, system.units.length)
    except InputError as error:
        if error.where:
            raise
        raise InputError(error.message, remedy=error.remedy, where=source.where) from None
    return system


def _smallest(potential: Any, units: str) -> float:
    sigmas = [potential.sigma] if getattr(potential, "sigma", None) is not None else []
    rows = (getattr(potential, "pairs", None) or {}).values()
    sigmas += [row.sigma for row in rows if hasattr(row, "sigma")]
    return structures.smallest_distance(potential.kind, units, sigmas)


def _ball(spec: BallSpec, source: Source) -> BallSystem:
    variants = {
        name: vary(name, changes, spec, source.place(("variants", name)))
        for name, changes in spec.variants.items()
    }
    return BallSystem(spec.name or source.name, spec, source.path, variants)


def json_schema(file: str) -> dict[str, Any]:
    """Return the JSON schema of system files. Editors use the schema to check and complete keys."""
    root, title = (BallSpec, " of the ball") if file == BALL_SCHEMA else (schema.SystemSpec, "")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **root.model_json_schema(),
        "title": f"mdnum system file{title}",
    }
