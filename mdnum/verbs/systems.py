"""`mdnum systems`: list, show, check and copy system files."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mdnum import systems
from mdnum.plain import headed
from mdnum.report.finding import conclude
from mdnum.report.words import many
from mdnum.systems.structures import ATOMS_IN_CELL
from mdnum.verbs import Reply


def listed() -> Reply:
    """Execute `mdnum systems list`."""
    texts = {name: systems.shipped_folder() / f"{name}.toml" for name in systems.names()}
    rows = [{"name": name, **_size_in(file)} for name, file in texts.items()]
    lines = [(row["name"], _sized(row), row["about"].partition(". ")[0]) for row in rows]
    return Reply(headed("systems-list", {"systems": rows}), [("", ("name", "size", "about"), lines)])


def show(system: str, overrides: Mapping[str, str] | None = None) -> Reply:
    """Execute `mdnum systems show SYSTEM`."""
    text = systems.load(system, overrides).to_toml(beside=False)
    return Reply(headed("systems-show", tomllib.loads(text)), [text.rstrip()])


def check(system: str, overrides: Mapping[str, str] | None = None) -> Reply:
    """Execute `mdnum systems check SYSTEM`."""
    loaded: Any = systems.load(system, overrides)
    from mdnum.verbs.check import structure_findings

    found = list(structure_findings(loaded)) if hasattr(loaded, "atoms") else []
    document = {"system": loaded.name, "ok": True, **_size(loaded), "path": loaded.path}
    words = f"{loaded.name}: {'can be run, with a warning' if found else 'fine'}, {_sized(document)}"
    return Reply(
        conclude(found, headline=words, judged=True).judged("systems-check", document), [words, *found]
    )


def copy(system: str, target: Path | None = None) -> Reply:
    """Execute `mdnum systems copy SYSTEM [DIR]`."""
    copied = systems.copy(system, target or Path())
    return Reply(headed("systems-copy", {"system": system, "path": copied}), [f"wrote {copied}"])


def _size_in(file: Path) -> dict[str, Any]:
    """Read the number of atoms or balls and the description from a shipped system file.

    Building all systems would import jax and ASE. Such imports take seconds.
    """
    table = tomllib.loads(file.read_text(encoding="utf-8"))
    about, start, structure = table["about"], table.get("start", {}), table.get("structure", {})
    if "file" in structure:
        with (file.parent / structure["file"]).open(encoding="ascii") as rows:
            return {"atoms": int(rows.readline()), "about": about}
    if structure:
        cells = math.prod(structure.get("repeat", ()))
        return {"atoms": cells * ATOMS_IN_CELL[structure["builder"]], "about": about}
    boundary = "boundary" in start and start["boundary"]["terms"] + 1
    lists = [len(value) for value in start.values() if isinstance(value, list)]
    return {"balls": boundary or max(lists, default=start.get("balls", 1)), "about": about}


def _size(system: Any) -> dict[str, int]:
    """Return the number of atoms, or of balls, of a loaded system."""
    atoms = getattr(system, "atoms", None)
    return {"balls": system.balls} if atoms is None else {"atoms": len(atoms)}


def _sized(row: Mapping[str, Any]) -> str:
    return many(row["atoms"], "atom") if "atoms" in row else many(row["balls"], "ball")
