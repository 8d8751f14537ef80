"""Metadata of parquet files: the unit and meaning of each column, and the run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import pyarrow as pa

from mdnum.plain import beside
from mdnum.units import named

_DECLARED: Mapping[str, Mapping[str, Sequence[str]]] = beside(__file__)


def meaning(table: str, column: str, own: Mapping[str, Mapping[str, Any]] | None = None) -> Sequence[str]:
    """Return the unit (such as "energy/length") and the description of a column; "" if unknown."""
    if own is not None:
        said = _found(own.get(table, {}), column)
        return (_found(_DECLARED["columns"], said) if isinstance(said, str) else said) or ("", "")
    return _found(_DECLARED.get(table, {}), column) or _found(_DECLARED["columns"], column) or ("", "")


def _found(declared: Mapping[str, Any], column: str) -> Any:
    patterns = (one for one in declared if "*" in one and fnmatchcase(column, one))
    return declared.get(column) or next(map(declared.__getitem__, patterns), None)


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def described(schema: pa.Schema, table: str, about: Mapping[str, Any], own: Any = None) -> pa.Schema:
    """Return a parquet schema with metadata of the run (keys `mdnum.*`) and of the columns.

    `mdnum.columns` repeats the metadata of columns as JSON. Some programs cannot read column metadata.

    Args:
        about: version, kind, system, run and units of the folder; empty values are omitted.
        own: as in `meaning`.
    """
    fields, known = [], {}
    for field in schema:
        quantity, text = meaning(table, field.name, own)
        held = {"unit": named(quantity, about["units"]), "description": text}
        known[field.name] = {key: word for key, word in held.items() if word}
        fields.append(field.with_metadata(known[field.name]))
    words = {key: value if isinstance(value, str) else _json(value) for key, value in about.items()}
    words |= {"table": table, "columns": _json(known)}
    return pa.schema(fields, {f"mdnum.{key}": word for key, word in words.items() if word})
