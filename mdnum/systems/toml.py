"""TOML text: reading it with an error that names the line, finding a key's line, writing it.

The standard library reads TOML but neither writes it nor remembers where a key stood; both are small for
the tables a system file holds.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mdnum.errors import InputError

Key = tuple[str, ...]
#: Name of the system file in a folder.
SYSTEM_FILE = "system.toml"

#: Depth of tables and arrays beyond which a file is refused.
_DEEPEST = 20
# what is valid in TOML and acted on by a terminal, or reorders what is read
_UNPRINTED = re.compile("[\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\U000e0000-\U000e007f]")
_BARE = re.compile(r"^[A-Za-z0-9_-]+$")
_PART = re.compile(r"""\s*(?:"((?:[^"\\]|\\.)*)"|'([^']*)'|([A-Za-z0-9_-]+))\s*""")


def parse(text: str, where: str | Path) -> dict[str, Any]:
    """The tables in a TOML text.

    Raises:
        InputError: not TOML; names the line and shows it.
    """
    try:
        tables = tomllib.loads(text)
        if _is_deep(tables):
            raise RecursionError
        return tables
    except RecursionError:
        raise InputError(
            f"tables or arrays are nested more than {_DEEPEST} deep",
            where=str(where),
            remedy="No table of a system file is deeper than three",
        ) from None
    except ValueError as error:
        seen = str(error)
        match = re.search(r"\(at line (\d+), column (\d+)\)", seen)
        lines = text.splitlines()
        number = int(match.group(1)) if match else max(1, len(lines))
        what = re.sub(r"\s*\(at .*\)$", "", seen)
        line = lines[number - 1].strip() if 0 < number <= len(lines) else ""
        shown = f" in `{line}`" if line else ""
        raise InputError(
            f"not TOML: {what}{shown}",
            where=f"{where}:{number}",
            remedy='Text goes in "double quotes", tables are [in brackets], arrays are [1, 2, 3]',
        ) from None


def scalar(text: str) -> Any:
    """A value from the command line, read as TOML would read it, or as plain text where that fails.

    `switched` and `"switched"` are the same; `0.5` is a number, `true` a truth value, `[2, 2, 2]` an array.
    """
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return parsed["value"] if set(parsed) == {"value"} and not _is_deep(parsed) else text


def _is_deep(value: Any) -> bool:
    """Whether tables and arrays hold one another more often than anybody writes down."""
    level = [value]
    for _ in range(_DEEPEST):
        level = [
            item
            for outer in level
            for item in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(item, dict | list)
        ]
        if not level:
            return False
    return True


def dotted(text: str) -> Key:
    """The parts of a dotted key such as `potential.pairs.Ni-P.sigma`.

    Raises:
        InputError: not a dotted key.
    """
    parts, end = _dotted_prefix(text)
    if not parts or end != len(text):
        raise InputError(
            f"{text!r} is not a key",
            remedy="Write table.key=value, such as cutoff.radius=8.5",
            where="--set",
        )
    return parts


def _dotted_prefix(text: str) -> tuple[Key, int]:
    parts: list[str] = []
    position = 0
    while match := _PART.match(text, position):
        parts.append(next(group for group in match.groups() if group is not None))
        position = match.end()
        if position >= len(text) or text[position] != ".":
            return tuple(parts), position
        position += 1
    return (), 0


def line_of(text: str, key: Key) -> int | None:
    """The line (from 1) at which a key is set, else the line of the nearest table around it, else None."""
    best: tuple[int, int] | None = None
    table: Key = ()
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith("["):
            table, _ = _dotted_prefix(stripped.strip("[").split("]")[0])
            found = table
        else:
            parts, end = _dotted_prefix(stripped)
            if not parts or not stripped[end:].startswith("="):
                continue
            found = table + parts
        depth = len(found)
        if depth and key[:depth] == found and (best is None or depth > best[0]):
            best = depth, number
    return best[1] if best else None


def dump(tables: Mapping[str, Any]) -> str:
    """TOML text of nested tables; None means absent, floats keep every bit.

    Scalars come first in each table, as TOML asks; empty tables are left out.
    """
    lines: list[str] = []
    _dump_table((), tables, lines)
    return "\n".join(lines).strip() + "\n"


def _dump_table(path: Key, table: Mapping[str, Any], lines: list[str]) -> None:
    simple = {k: v for k, v in table.items() if v is not None and not isinstance(v, Mapping)}
    nested = {k: v for k, v in table.items() if isinstance(v, Mapping)}
    if path and simple:
        lines += ["", f"[{'.'.join(_key(part) for part in path)}]"]
    lines += [f"{_key(key)} = {_value(value)}" for key, value in simple.items()]
    for key, value in nested.items():
        _dump_table((*path, key), value, lines)


def _key(key: str) -> str:
    return key if _BARE.match(key) else _string(key)


def _string(text: str) -> str:
    # TOML knows the escapes of JSON, and \U for what JSON writes as two halves
    escaped = json.dumps(text, ensure_ascii=False)
    return _UNPRINTED.sub(lambda found: f"\\U{ord(found[0]):08X}", escaped)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    raise TypeError(f"no TOML for {type(value).__name__}")
