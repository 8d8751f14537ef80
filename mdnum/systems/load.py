"""Where system files are, shipped ones by name, a person's own by path; and what comes of reading one."""

from __future__ import annotations

import importlib.resources
import shutil
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from mdnum import units as unit_systems
from mdnum.errors import InputError, expect_path
from mdnum.reading import whole_text
from mdnum.registry import meant
from mdnum.store.files import SIMULATION_FILE, SYSTEM_FILE, disk_errors, replacing, write_text
from mdnum.systems import code, pairs, schema, structures, toml
from mdnum.systems.ball import BallSpec, ValuesControl
from mdnum.systems.toml import Source, apply_overrides, checked, read_overrides

if TYPE_CHECKING:
    from ase import Atoms


STRUCTURE_FILE = "structure.extxyz"
#: Of a system file: words, what is hashed by itself, and what is asked about the run.
_NOT_THE_PROGRAM = {"name", "about", "structure", "gradient", "variants", "fork"}
#: What can be done with a folder whose simulation came from no file.
GIVE_OBJECTS = "Give the simulation itself, made by the same code, from Python"
BALL_SCHEMA = "ball-schema.json"


def shipped_folder(kind: Literal["systems", "demos"] = "systems") -> Path:
    """The folder of shipped files: the packaged copy, else the repository's (editable installs)."""
    package = Path(str(importlib.resources.files("mdnum")))
    packaged = package / f"_{kind}"
    return packaged if packaged.is_dir() else package.parent / kind


def names(world: Literal["md", "ball"] | None = None) -> list[str]:
    """Names of the shipped systems, such as "argon/liquid-864".

    Args:
        world: only those of this world.
    """
    root = shipped_folder()
    found = list(root.glob("*/*.toml"))
    if world is not None:
        found = [path for path in found if _world(path) == world]
    return sorted(path.relative_to(root).with_suffix("").as_posix() for path in found)


def world_of(name: Any) -> str:
    """ "md" or "ball", of a system or simulation, or read from a file unchecked; "md" where that is no TOML.

    Raises:
        InputError: nothing of that name.
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
    """Name and file of a system: a path to a TOML file, a folder that holds system.toml, or a shipped name.

    Raises:
        InputError: nothing of that name; says the nearest shipped one.
    """
    expect_path(name, "Give a shipped name, the path of a system file or its folder, or a loaded system")
    path = Path(name)
    text = str(name)
    if path.is_dir() and (path / SYSTEM_FILE).is_file():
        return path.resolve().name, path / SYSTEM_FILE
    if path.is_dir() and (path / SIMULATION_FILE).is_file():
        raise InputError(
            "was made from Python objects, and no file describes how to recreate them",
            where=text,
            remedy=GIVE_OBJECTS,
        )
    if path.is_file():
        return path.stem, path
    if path.suffix == ".toml":
        raise InputError("no such system file", where=text, remedy="Check the path")
    known = names()
    if text in known:
        return text, shipped_folder() / f"{text}.toml"
    short = [one for one in known if one.split("/")[-1] == text]
    hint = meant(short[0] if short else text, known)
    raise InputError(
        f"there is neither a shipped system nor a file called {text!r}",
        remedy=(
            f"{hint}`mdnum systems list` lists the shipped systems; give your own system as the "
            "path of a .toml file"
        ),
    )


def shown(path: Path) -> str:
    """A path as a message names it: from here where it is below here."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def _made(folder: str | Path) -> Path:
    """A folder, made where it is missing."""
    target = Path(folder)
    with disk_errors(target):
        target.mkdir(parents=True, exist_ok=True)
    return target


@dataclass(frozen=True)
class System:
    """A checked system: what a file says, with the atoms it means.

    Attributes:
        name: such as "argon/liquid-864".
        spec: the file's tables, defaults filled in.
        path: the file, or None.
        atoms: positions in the file's unit of length; momenta in ASE's units (reduced units for lj) when the
            structure has velocities, else none, and velocities are drawn at the start of a run.
    """

    name: str
    spec: schema.SystemSpec
    path: Path | None
    atoms: Atoms

    @property
    def units(self) -> unit_systems.Units:
        """The unit system."""
        return unit_systems.get(self.spec.units)

    @property
    def folder(self) -> Path:
        """Where the files the system names are looked for."""
        return self.path.parent if self.path else Path()

    @property
    def species(self) -> tuple[str, ...]:
        """Chemical symbols present, sorted."""
        return structures.species_of(self.atoms)[0]

    @property
    def draw(self) -> structures.Draw:
        """How the velocities of step 0 are made."""
        dynamics, drawn = self.spec.dynamics, not self.atoms.has("momenta")
        return structures.Draw(float(dynamics.temperature), dynamics.seed, dynamics.remove_drift, drawn)

    @property
    def without_skin(self) -> System:
        """The same with a list that asks the box for no room."""
        neighbors = self.spec.neighbors.model_copy(update={"skin": 0.0})
        return replace(self, spec=self.spec.model_copy(update={"neighbors": neighbors}))

    @property
    def ignored(self) -> list[str]:
        """Columns of the structure's file that look like velocities, where none of it are read."""
        structure = self.spec.structure
        return structures.ignored(structure, self.folder) if structure.velocities == "file" else []

    @property
    def r_cut(self) -> float:
        """The longest interaction (length)."""
        return pairs.longest_radius(self.spec, self.species, self.folder)

    @property
    def program(self) -> dict[str, Any]:
        """Every number and choice but the structure, plain values: what is hashed."""
        made = self.spec.model_dump(mode="json", exclude=_NOT_THE_PROGRAM)
        if made.get("terms") is None:
            made.pop("terms", None)
        for table, potential in self._potentials(made):
            if isinstance(potential, schema.PythonTable):
                table["code"] = [sha256(file.read_bytes()).hexdigest() for file in self._files(potential)]
        return made

    def _potentials(self, data: dict[str, Any]) -> list[tuple[dict[str, Any], Any]]:
        """The table of each potential in the tables of the file, with what it was read as."""
        tables = {"": data} if self.spec.terms is None else data["terms"]
        return [(tables[name]["potential"], one.potential) for name, one in self.spec.interactions.items()]

    def _files(self, potential: Any) -> set[Path]:
        if isinstance(potential, schema.PythonTable):
            return {code.parts(potential.function, self.folder)[0]}
        return {self.folder / potential.file} if isinstance(potential, schema.EmbeddedAtomTable) else set()

    @property
    def tables(self) -> set[Path]:
        """Files the potential reads, or executes."""
        return {file for one in self.spec.interactions.values() for file in self._files(one.potential)}

    def to_toml(self, *, beside: bool = True) -> str:
        """The system file with every default written out.

        Args:
            beside: for the folder that write() makes: it refers to the structure that is put beside it, and
                loading it there gives this system again, bit for bit. Otherwise it refers to the files that
                this system was read from, wherever it is saved.
        """
        spec = self.spec.model_dump(mode="python", exclude_none=True)
        structure = spec["structure"]
        potentials = [table for table, _ in self._potentials(spec)]
        if not beside:
            for table in (structure, *potentials):
                for key in ("file", "function"):
                    if key in table:
                        table[key] = str((self.folder / table[key]).resolve())
            return toml.dump({"name": self.name, **spec})
        kept = {key: structure[key] for key in ("masses", "velocities") if key in structure}
        spec["structure"] = {"file": STRUCTURE_FILE, **kept}
        for table in potentials:
            for key in ("file", "function"):
                if key in table:
                    table[key] = Path(table[key]).name
        return toml.dump({"name": self.name, **spec})

    def write(self, folder: str | Path) -> Path:
        """Write system.toml, structure.extxyz and the potential's tables; returns the TOML file's path."""
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
    """A checked system of the ball.

    Attributes:
        name: such as "ball/drop".
        spec: the file's tables, defaults filled in.
        path: the file, or None.
        variants: the file with some keys changed (spec.variants says which), by name, each checked like it.
    """

    name: str
    spec: BallSpec
    path: Path | None = None
    variants: Mapping[str, BallSpec] = field(default_factory=dict)

    @property
    def program(self) -> dict[str, Any]:
        """Every number and choice, plain values: what is hashed."""
        return self.spec.model_dump(mode="json", exclude=_NOT_THE_PROGRAM)

    @property
    def balls(self) -> int:
        """How many balls there are."""
        return self.spec.balls

    def against(self, changes: Mapping[str, Any], name: str | None = None) -> BallSystem:
        """This system with one more variant.

        Args:
            changes: dotted keys to values; text is read as TOML would read it.
            name: what to call the variant; default the changes themselves.

        Raises:
            InputError: the variant cannot be run, or its name is taken.
        """
        name = name or ", ".join(f"{key}={value}" for key, value in changes.items())
        if name in self.variants:
            raise InputError(f"the variant {name!r} is defined twice", remedy="Define it once")
        given = {".".join(key): value for key, value in read_overrides(changes).items()}
        variant = vary(name, given, self.spec, f"--against {name}")
        tables = {**self.spec.variants, name: given}
        spec = self.spec.model_copy(update={"variants": tables})
        return BallSystem(self.name, spec, self.path, {**self.variants, name: variant})

    def for_steps(self, steps: int) -> BallSystem:
        """This system with another number of steps; a control given by values is cut, or keeps its last.

        Args:
            steps: of a run, at least 1.
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
        """The system file with every default written out; a ball has no other files to be beside."""
        return toml.dump({"name": self.name, **self.spec.model_dump(exclude_none=True)})

    def write(self, folder: str | Path) -> Path:
        """Write system.toml; returns its path."""
        path = _made(folder) / SYSTEM_FILE
        write_text(path, self.to_toml())
        return path


def vary(name: str, changes: Mapping[str, Any], base: BallSpec, where: str) -> BallSpec:
    """The system with keys changed, checked.

    Raises:
        InputError: it cannot be run.
    """
    if not changes:
        raise InputError(
            f"variant {name!r} changes no key",
            where=where,
            remedy="Give a key to change, or remove the variant",
        )
    data = base.model_dump(exclude_none=True, exclude={"variants", "name"})
    values = {toml.dotted(key): value for key, value in changes.items()}
    for key in values:
        if key[0] in ("variants", "name", "about", "world") or key == ("integrator", "steps"):
            raise InputError(
                f"variant {name!r} changes {'.'.join(key)}, which does not affect the arithmetic of a run",
                where=where,
                remedy="Remove it",
            )
    apply_overrides(data, values, BallSpec)
    BallSpec.follow(data, values)
    try:
        spec = checked(BallSpec, data, Source(name, Path(), where))
    except InputError as error:
        raise InputError(f"variant {name!r}: {error.message}", remedy=error.remedy, where=where) from None
    if spec.balls != base.balls:
        raise InputError(
            f"variant {name!r} has {spec.balls} balls and the system {base.balls}: "
            "decisions of different balls cannot be compared",
            where=where,
            remedy="Keep the number of balls",
        )
    return spec


# --- copying ----------------------------------------------------------------------------------------


def copy(name: str | Path, folder: str | Path) -> Path:
    """Copy a shipped system, its structure and its tables, to edit; returns the copied system file.

    Raises:
        InputError: no such system, or a file of that name is there already.
    """
    system: System | BallSystem = load(name)
    if system.path is None:
        raise TypeError("a loaded system already has a path")
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
        raise InputError("already exists", where=str(there[0]), remedy="Choose another folder")
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
    """A system by name or path, checked: a System, or a BallSystem where the file says `world = "ball"`.

    Example:
        >>> mdnum.load("argon/liquid-864").spec.cutoff.kind
        'hard'

    Args:
        name: a shipped name, a path to a TOML file, a folder that holds system.toml, or a loaded system,
            which is returned as it is.
        overrides: dotted key to value, as `--set` gives them: `{"cutoff.kind": "switched"}`; text is read as
            TOML would read it. Changing a kind drops the file's keys that the new kind does not have;
            changing the temperature or seed of an NVE run draws its velocities anew.
        world: refuse systems of the other world.

    Raises:
        InputError: anything that cannot be run, in one line.
    """
    if isinstance(name, System | BallSystem):
        if overrides:
            remedy = "Load it with the overrides, or give its name"
            raise InputError("overrides change a system while it is loaded", where=name.name, remedy=remedy)
        _check_world(name.name, isinstance(name, BallSystem), world)
        return name
    found, path = find(name)
    where = shown(path)
    try:
        text = whole_text(path, where)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot be read ({error})", where=where, remedy="A system file is UTF-8 text"
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
        raise InputError(f"this system is {what}", where=str(name), remedy=f"Use `mdnum {verb} {name}`")


def _is_ball(data: Mapping[str, Any], where: str) -> bool:
    if "world" not in data:
        if "contact" in data:
            raise InputError(
                "key 'world' missing in the system file",
                where=where,
                remedy='Add `world = "ball"` at the top',
            )
        return False
    if data["world"] != "ball":
        raise InputError(
            f'world = {data["world"]!r}; expected "ball"',
            where=where,
            remedy="Omit the key for molecular dynamics",
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
    """The JSON schema of system files that editors use, schema.json or BALL_SCHEMA."""
    root, title = (BallSpec, " of the ball") if file == BALL_SCHEMA else (schema.SystemSpec, "")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **root.model_json_schema(),
        "title": f"mdnum system file{title}",
    }
