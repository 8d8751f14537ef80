"""Where system files are: shipped ones by name, a person's own by path."""

from __future__ import annotations

import importlib.resources
import tomllib
from pathlib import Path
from typing import Literal

from mdnum.errors import InputError
from mdnum.systems import messages

SYSTEM_FILE = "system.toml"


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


def world_of(name: str | Path) -> str:
    """ "md" or "ball", read from a system's file without checking it; "md" where that is no TOML.

    Raises:
        InputError: nothing of that name.
    """
    try:
        return str(_world(find(name)[1]))
    except (ValueError, RecursionError):
        # whoever loads it says where the mistake is
        return "md"


def _world(path: Path) -> str:
    return tomllib.loads(path.read_text(encoding="utf-8")).get("world", "md")


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


def shown(path: Path) -> str:
    """A path as a message names it: from here where it is below here."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)
