"""Layout of a run folder: declared by a command, stored in the manifest."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from types import MappingProxyType
from typing import Any

#: Types of columns with the corresponding Python types; a `word` is one of a few texts.
TYPES: Mapping[str, tuple[type, ...]] = MappingProxyType({
    "int32": (int,), "int64": (int,), "float64": (float, int), "bool": (bool,), "string": (str,),
    "word": (str,),
})  # fmt: skip
_KIND = re.compile(r"[a-z][a-z0-9_-]{0,39}")
_COMMAND = re.compile(r"[a-z][a-z0-9_-]{0,39}( [a-z0-9_-]{1,40}){0,3}")
# names of tables become names of files
_TABLE = re.compile(r"[a-z][a-z_]{0,39}\??")
_COLUMN = re.compile(rf"([A-Za-z_]\w{{0,63}})(\?)?(?::({'|'.join(TYPES)}))?", re.ASCII)
_MOST_TABLES, _MOST_COLUMNS = 100, 1000


@dataclass(frozen=True)
class Layout:
    """Layout of a run folder: its command, its tables, and the file from which it is resumed.

    Args:
        kind: name of the kind.
        command: command that makes such folders, without `mdnum`.
        tables: names of columns by table, separated by spaces. `name:type` is a column with a type of
            `TYPES`, float64 by default. `name?` is a column that may be unknown when the table is written,
            and is then null. A folder has every table, with rows or without, except those whose own name ends
            in a question mark.
        usual: values of columns that rows leave out, by table.
        resumes_from: the file from which the command resumes; empty if it cannot be resumed.
        further: files other than tables that are read or shown, as patterns separated by spaces.
        described: [unit, description] of columns, by table, or the name of a column of store/columns.toml
            with the same meaning; None if that file describes all of them.

    Raises:
        ValueError: a name, type or value is not valid for a folder.
    """

    kind: str
    command: str
    tables: Mapping[str, str] = field(default_factory=dict)
    usual: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    resumes_from: str = ""
    further: str = ""
    described: Mapping[str, Mapping[str, str | Sequence[str]]] | None = None

    def __post_init__(self) -> None:
        matched = (_KIND.fullmatch(self.kind), _COMMAND.fullmatch(self.command))
        if not all(matched) or self.resumes_from not in ("", "checkpoint.npz", "answers.json"):
            raise ValueError(
                f"invalid kind {self.kind!r}, command {self.command!r} or resumes_from {self.resumes_from!r}"
            )
        if len(self.further) > _MOST_COLUMNS:
            raise ValueError(f"the list `further` is too long: {self.further[:100]!r}")
        if len(self.tables) > _MOST_TABLES or not all(map(_TABLE.fullmatch, self.tables)):
            raise ValueError(f"the layout has too many or wrongly named tables: {list(self.tables)[:3]}")
        _ = self._columns
        for table, texts in (self.described or {}).items():
            for column, said in texts.items():
                if "*" not in column and column not in self.columns(table):
                    raise ValueError(f"{table}.{column} has a description, but the table has no such column")
                if (len(said) != 2 and type(said) is not str) or len("".join(said)) > _MOST_COLUMNS:
                    raise ValueError(f"{table}.{column} = {said!r:.100}; expected a list [unit, description]")
        for table, values in self.usual.items():
            for column, value in values.items():
                kind, _ = self.columns(table)[column]
                if type(value) not in TYPES[kind] or (type(value) is int and abs(value) >= 1 << 31):
                    raise ValueError(f"{value!r} in column {table}.{column} is not of type {kind}")

    @cached_property
    def always(self) -> tuple[str, ...]:
        """Names of the tables that every folder of this kind has."""
        return tuple(name for name in self.tables if not name.endswith("?"))

    def keeps(self, name: str) -> bool:
        """Return True for a file of the layout that is not a table. Its digest is then checked."""
        fixed = ("summary.json", self.resumes_from)
        return name in fixed or any(fnmatchcase(name, pattern) for pattern in self.further.split())

    def columns(self, table: str) -> Mapping[str, tuple[str, bool]]:
        """Return the type of each column of a table, and whether values can be null."""
        return self._columns.get(table, {})

    @cached_property
    def _columns(self) -> Mapping[str, Mapping[str, tuple[str, bool]]]:
        found: dict[str, Mapping[str, tuple[str, bool]]] = {}
        for table, text in self.tables.items():
            words = text.split()
            matches = [_COLUMN.fullmatch(word) for word in words]
            if len(words) > _MOST_COLUMNS or not all(matches):
                raise ValueError(f"invalid columns of table {table!r}: {text[:100]!r}")
            found[table.rstrip("?")] = {
                one[1]: (one[3] or "float64", bool(one[2])) for one in matches if one is not None
            }
        return found

    @property
    def spelled(self) -> dict[str, str]:
        """Declared tables with their column types, in the format of the manifest."""
        spelled = {}
        for table in self.tables:
            columns = self.columns(table.rstrip("?")).items()
            spelled[table] = " ".join(f"{name}{'?' * free}:{kind}" for name, (kind, free) in columns)
        return spelled
