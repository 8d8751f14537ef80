"""`mdnum systems`: list, show, check and copy system files."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import typer

from mdnum.cli import output

_SYSTEM = typer.Argument(metavar="SYSTEM", help="A name from `mdnum systems list`, or a TOML file.")


def list_systems(as_json: bool = output.JSON_OPTION) -> int:
    """List the systems that come with mdnum."""
    from mdnum import systems

    rows = []
    for name in systems.names():
        system = systems.load(name)
        rows.append({"name": name, **_size(system), "about": system.spec.about})
    if as_json:
        output.print_json({"systems": rows})
    else:
        lines = [(row["name"], _sized(row), row["about"].partition(". ")[0]) for row in rows]
        output.print_table("", ("name", "size", "about"), lines)
    return output.EXIT_FINE


def show(
    system: str = _SYSTEM,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Print a system file with every default filled in."""
    loaded = _load(system, settings)
    text = loaded.to_toml(beside=False)
    if as_json:
        output.print_json(tomllib.loads(text))
    else:
        output.say(text.rstrip())
    return output.EXIT_FINE


def check(
    system: str = _SYSTEM,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Read a system file and its structure, and say whether it can be run."""
    loaded = _load(system, settings)
    document = {"system": loaded.name, "ok": True, **_size(loaded), "path": loaded.path}
    if as_json:
        output.print_json(document)
    else:
        output.say(f"{loaded.name}: fine, {_sized(document)}")
    return output.EXIT_FINE


def copy(
    system: str = _SYSTEM,
    target: Path = typer.Argument(Path(), metavar="[DIR]", help="Where to; here by default."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Copy a system file and its structure, to change and run."""
    from mdnum import systems

    copied = systems.copy(system, target)
    if as_json:
        output.print_json({"system": system, "path": copied})
    else:
        output.say(f"wrote {copied}")
    return output.EXIT_FINE


def _size(system: Any) -> dict[str, int]:
    """How many there are of what the system is made of."""
    atoms = getattr(system, "atoms", None)
    return {"balls": system.balls} if atoms is None else {"atoms": len(atoms)}


def _sized(row: dict[str, Any]) -> str:
    noun = "atom" if "atoms" in row else "ball"
    number = row[f"{noun}s"]
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _load(system: str, settings: list[str] | None) -> Any:
    from mdnum import systems

    return systems.load(system, output.parse_overrides(settings))
