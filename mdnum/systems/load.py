"""From a name or a path to a checked system: find the file, read it, apply overrides, make the structure."""

from __future__ import annotations

import importlib.resources
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64
from pydantic import ValidationError

from mdnum import units as unit_systems
from mdnum.errors import InputError
from mdnum.store.atomic import disk_errors
from mdnum.systems import messages, pairs, schema, structures, toml

if TYPE_CHECKING:
    from ase import Atoms

STRUCTURE_FILE = "structure.extxyz"
SYSTEM_FILE = "system.toml"


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
        return tuple(sorted(set(self.atoms.get_chemical_symbols())))

    @property
    def species_index(self) -> Int64[np.ndarray, " atoms"]:
        """Each atom's place in species."""
        return np.searchsorted(np.array(self.species), np.array(self.atoms.get_chemical_symbols()))

    @property
    def velocities(self) -> Float64[np.ndarray, "atoms 3"] | None:
        """Velocities the structure came with (length per internal time), or None."""
        return self.atoms.get_velocities() if self.atoms.has("momenta") else None

    @property
    def r_cut(self) -> float:
        """The longest interaction (length)."""
        return pairs.longest_radius(self.spec, self.species, self.folder)

    @property
    def tables(self) -> set[Path]:
        """Files the potential reads."""
        potential = self.spec.potential
        return {self.folder / potential.file} if isinstance(potential, schema.EmbeddedAtom) else set()

    def to_toml(self, *, beside: bool = True) -> str:
        """The system file with every default written out.

        Args:
            beside: for the folder that write() makes: it refers to the structure that is put beside it, and
                loading it there gives this system again, bit for bit. Otherwise it refers to the files that
                this system was read from, wherever it is saved.
        """
        spec = self.spec.model_dump(mode="python", exclude_none=True)
        structure = spec["structure"]
        if not beside:
            for table in (structure, spec["potential"]):
                if "file" in table:
                    table["file"] = str((self.folder / table["file"]).resolve())
            return toml.dump({"name": self.name, **_kind_first(spec)})
        kept = {key: structure[key] for key in ("masses", "velocities") if key in structure}
        spec["structure"] = {"file": STRUCTURE_FILE, **kept}
        if isinstance(self.spec.potential, schema.EmbeddedAtom):
            spec["potential"]["file"] = Path(self.spec.potential.file).name
        return toml.dump({"name": self.name, **_kind_first(spec)})

    def write(self, folder: str | Path) -> Path:
        """Write system.toml, structure.extxyz and the potential's tables; returns the TOML file's path."""
        target = Path(folder)
        with disk_errors(target):
            target.mkdir(parents=True, exist_ok=True)
            for table in self.tables:
                if table.resolve() != (target / table.name).resolve():
                    shutil.copyfile(table, target / table.name)
            (target / STRUCTURE_FILE).write_text(structures.to_extxyz(self.atoms), encoding="utf-8")
            path = target / SYSTEM_FILE
            path.write_text(self.to_toml(), encoding="utf-8")
        return path


def _kind_first(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Put kind at the head of each table, where a reader looks for it, and name and about at the very top."""
    ordered = {key: spec[key] for key in ("name", "about", "units") if key in spec}
    for key, value in spec.items():
        if isinstance(value, Mapping):
            head = {"kind": value["kind"]} if "kind" in value else {}
            ordered[key] = {**head, **{k: v for k, v in value.items() if k != "kind"}}
        else:
            ordered.setdefault(key, value)
    return ordered


# --- finding ------------------------------------------------------------------------------------------


def shipped_folder() -> Path:
    """The folder of shipped systems: the packaged copy, else the repository's (editable installs)."""
    package = Path(str(importlib.resources.files("mdnum")))
    packaged = package / "_systems"
    return packaged if packaged.is_dir() else package.parent / "systems"


def names() -> list[str]:
    """Names of the shipped systems, such as "argon/liquid-864"."""
    root = shipped_folder()
    return sorted(path.relative_to(root).with_suffix("").as_posix() for path in root.glob("*/*.toml"))


def find(name: str | Path) -> tuple[str, Path]:
    """Name and file of a system: a path to a TOML file, a folder that holds system.toml, or a shipped name.

    Raises:
        InputError: nothing of that name; says the nearest shipped one.
    """
    path = Path(name)
    text = str(name)
    if path.is_dir() and (path / SYSTEM_FILE).is_file():
        return path.resolve().name, path / SYSTEM_FILE
    if path.is_file():
        return path.stem, path
    if path.suffix == ".toml":
        raise InputError("no such system file", where=text, remedy="Check the path")
    known = names()
    if text in known:
        return text, shipped_folder() / f"{text}.toml"
    short = [one for one in known if one.split("/")[-1] == text]
    near = short[0] if short else messages.nearest(text, known)
    hint = f"Did you mean {near}? " if near else ""
    raise InputError(
        f"no system called {text!r}, and no file of that name",
        remedy=f"{hint}`mdnum systems list` names those shipped; your own system is a path to a .toml file",
    )


def copy(name: str | Path, folder: str | Path) -> Path:
    """Copy a shipped system, its structure and its tables, to edit; returns the copied system file.

    Raises:
        InputError: no such system, or a file of that name is there already.
    """
    system = load(name)
    if system.path is None:
        raise TypeError("a loaded system has a path")
    target = Path(folder)
    files = sorted(system.tables)
    if isinstance(system.spec.structure, schema.FileStructure):
        files.append(system.folder / system.spec.structure.file)
    schema_file = shipped_folder() / "schema.json"
    text = system.path.read_text(encoding="utf-8")
    if schema_file.is_file():
        files.append(schema_file)
        text = text.replace("#:schema ../schema.json", "#:schema schema.json")
    goal = target / system.path.name
    there = [path for path in (goal, *(target / file.name for file in files)) if path.exists()]
    there = [path for path in there if path.name != schema_file.name]
    if there:
        raise InputError("is there already", where=str(there[0]), remedy="Choose another folder")
    target.mkdir(parents=True, exist_ok=True)
    for file in files:
        shutil.copyfile(file, target / file.name)
    goal.write_text(text, encoding="utf-8")
    return goal


# --- loading ------------------------------------------------------------------------------------------


def load(name: str | Path, overrides: Mapping[str, Any] | None = None) -> System:
    """A system by name or path, checked.

    Args:
        name: a shipped name, a path to a TOML file, or a folder that holds system.toml.
        overrides: dotted key to value, as `--set` gives them: `{"cutoff.kind": "switched"}`; text is read as
            TOML would read it. Changing a kind drops the file's keys that the new kind does not have;
            changing the temperature or seed of an NVE run draws its velocities anew.

    Raises:
        InputError: anything that cannot be run, in one line.
    """
    found, path = find(name)
    where = _shown(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot be read ({error})", where=where, remedy="A system file is UTF-8 text"
        ) from error
    data = toml.parse(text, where)
    changes = {toml.dotted(key): value for key, value in (overrides or {}).items()}
    values = {key: toml.scalar(value) if isinstance(value, str) else value for key, value in changes.items()}
    for key, value in values.items():
        _override(data, key, value)
    _drop_foreign_keys(data, values)
    _draw_again(data, values)
    try:
        spec = schema.SystemSpec.model_validate(data)
    except ValidationError as error:
        raise messages.explain(error, data, text, where, values) from None
    spec = _resolve(spec)
    try:
        atoms = structures.make(spec.structure, spec.units, path.parent)
        system = System(spec.name or found, spec, path, atoms)
        structures.check(atoms, spec, system.r_cut, system.units.length)
    except InputError as error:
        if error.where:
            raise
        raise InputError(error.message, remedy=error.remedy, where=where) from None
    return system


def _shown(path: Path) -> str:
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def _override(data: dict[str, Any], key: toml.Key, value: Any) -> None:
    table = data
    for depth, part in enumerate(key[:-1]):
        inner = table.setdefault(part, {})
        if not isinstance(inner, dict):
            raise InputError(
                f"{'.'.join(key[: depth + 1])} is a value and not a table",
                where=f"--set {'.'.join(key)}",
                remedy=f"Set {'.'.join(key[: depth + 1])} itself",
            )
        table = inner
    table[key[-1]] = value


_RIVALS: dict[toml.Key, tuple[str, ...]] = {
    # what the command line says replaces the file's other way of saying it
    ("cutoff", "radius"): ("in_sigma", "pairs"),
    ("cutoff", "in_sigma"): ("radius", "pairs"),
    ("structure", "file"): ("builder",),
    ("structure", "builder"): ("file",),
}


def _drop_foreign_keys(data: dict[str, Any], values: Mapping[toml.Key, Any]) -> None:
    """Keys of the file that an override makes meaningless: of another kind, or a rival of its key."""
    for key in values:
        table = data.get(key[0])
        if not isinstance(table, dict):
            continue
        foreign = set(_RIVALS.get(key, ()))
        if {"radius", "in_sigma"} & foreign & set(table):
            # the onset was in the unit of the radius that goes
            foreign.add("onset")
        if key[0] in messages.TAGGED and key[1:] in (("kind",), ("file",), ("builder",)):
            rest = {**data, key[0]: {name: value for name, value in table.items() if name not in foreign}}
            foreign |= messages.keys_of_any_kind(key[0]) - set(messages.known_keys(key[:1], rest))
        for name in foreign & set(table):
            if not any(given[:2] == (key[0], name) for given in values):
                del table[name]


def _draw_again(data: dict[str, Any], values: Mapping[toml.Key, Any]) -> None:
    """A temperature or seed asked for on the command line must not be silently ignored."""
    structure, dynamics = data.get("structure"), data.get("dynamics")
    if not isinstance(structure, dict) or not isinstance(dynamics, dict) or dynamics.get("kind") != "nve":
        return
    asked = {("dynamics", "temperature"), ("dynamics", "seed")} & set(values)
    if asked and ("structure", "velocities") not in values:
        structure["velocities"] = "drawn"


def _resolve(spec: schema.SystemSpec) -> schema.SystemSpec:
    """The defaults that depend on other keys, written out."""
    update: dict[str, Any] = {"neighbors": spec.neighbors.model_copy(update={"skin": spec.skin})}
    cutoff = spec.cutoff
    if isinstance(cutoff, schema.SwitchingCutoff) and cutoff.onset is None:
        base = cutoff.radius if cutoff.radius is not None else cutoff.in_sigma
        if base is not None:
            update["cutoff"] = cutoff.model_copy(update={"onset": schema.ONSET_FRACTION * base})
    return spec.model_copy(update=update)
