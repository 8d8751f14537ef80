"""Schemas that allow no key which they do not name, and documents in which a key has another name."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any


def closed(schema: Any) -> Any:
    """As it is, but for keys that might be added: those that a schema does not name are wrong."""
    if isinstance(schema, list):
        return [closed(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    made = {key: closed(value) for key, value in schema.items()}
    if isinstance(schema.get("properties"), dict) and "type" in schema:
        made.setdefault("additionalProperties", False)
    return made


def records(schema: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every object of a schema, with its path."""
    kinds = schema.get("type", [])
    if "object" in ([kinds] if isinstance(kinds, str) else kinds):
        yield path, schema
    for name, each in schema.get("properties", {}).items():
        yield from records(each, f"{path}.{name}".strip("."))
    for word, key in (("[]", "items"), ("<>", "additionalProperties")):
        if isinstance(schema.get(key), dict):
            yield from records(schema[key], path + word)
    for each in schema.get("anyOf", ()):
        yield from records(each, path)


def renamed(document: Any, path: str) -> Any:
    """A document in which what stands at a path ("rules.0.flips") has another name."""
    made = copy.deepcopy(document)
    *way, name = path.split(".")
    place = made
    for step in way:
        place = place[int(step)] if isinstance(place, list) else place[step]
    place[f"{name}_"] = place.pop(name)
    return made
