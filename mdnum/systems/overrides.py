"""Values from the command line put into the tables of a file, without the keys they make meaningless."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mdnum.errors import InputError
from mdnum.systems import toml
from mdnum.systems.grammar import Grammar

_RIVALS: dict[toml.Key, tuple[str, ...]] = {
    # what the command line says replaces the file's other way of saying it
    ("cutoff", "radius"): ("in_sigma", "pairs"),
    ("cutoff", "in_sigma"): ("radius", "pairs"),
    ("structure", "file"): ("builder",),
    ("structure", "builder"): ("file",),
    ("start", "height"): ("boundary",),
    ("start", "spread"): ("spread_ulps",),
    ("start", "spread_ulps"): ("spread",),
}


def read(overrides: Mapping[str, Any] | None) -> dict[toml.Key, Any]:
    """Dotted keys to values; text is read as TOML would read it.

    Raises:
        InputError: a key that is none.
    """
    changes = {toml.dotted(key): value for key, value in (overrides or {}).items()}
    return {key: toml.scalar(value) if isinstance(value, str) else value for key, value in changes.items()}


def apply(data: dict[str, Any], values: Mapping[toml.Key, Any], grammar: Grammar) -> None:
    """Put values into the tables, and drop the keys of another kind than the one they choose.

    Raises:
        InputError: a key below one that is a value and no table.
    """
    for key, value in values.items():
        _override(data, key, value)
    for key in values:
        _drop_foreign_keys(data, key, values, grammar)


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


def _drop_foreign_keys(
    data: dict[str, Any], key: toml.Key, values: Mapping[toml.Key, Any], grammar: Grammar
) -> None:
    path = key[:-1]
    table: Any = data
    for part in path:
        table = table.get(part) if isinstance(table, dict) else None
    if not path or not isinstance(table, dict):
        return
    foreign = set(_RIVALS.get(key, ()))
    if {"radius", "in_sigma"} & foreign & set(table):
        # the onset was in the unit of the radius that goes
        foreign.add("onset")
    if grammar.is_tag(key, data) or key in (("structure", "file"), ("structure", "builder")):
        rest = {
            **data,
            path[0]: {name: value for name, value in data[path[0]].items() if name not in foreign},
        }
        foreign |= grammar.foreign_keys(path, rest)
    for name in foreign & set(table):
        if not any(given[: len(path) + 1] == (*path, name) for given in values):
            del table[name]
