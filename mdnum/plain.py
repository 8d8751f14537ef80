"""Conversion of results to plain values for JSON, TOML and terminals."""

from __future__ import annotations

import dataclasses
import functools
import math
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, dataclass_transform

T = TypeVar("T")


@functools.cache
def beside(module: str) -> dict[str, Any]:
    """Return the tables of the TOML file next to a module (`__file__`). Do not change them."""
    return tomllib.loads(Path(module).with_suffix(".toml").read_text(encoding="utf-8"))


def shipped_folder(kind: Literal["systems", "demos"] = "systems") -> Path:
    """Return the folder of shipped files. Editable installs use the repository."""
    package = Path(__file__).parent
    packaged = package / f"_{kind}"
    return packaged if packaged.is_dir() else package.parent / kind


def shipped_systems() -> list[str]:
    """Return the names of the shipped systems, such as "argon/liquid-864"."""
    root = shipped_folder()
    return sorted(path.relative_to(root).with_suffix("").as_posix() for path in root.glob("*/*.toml"))


#: Keys of every document of a result, in addition to `schema` and `kind`.
HEAD = ("status", "seconds", "headline", "verdict", "findings")


def headed(kind: str, document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON document with a header of schema (in mdnum/schemas), kind and version."""
    head = {"schema": f"mdnum/{kind}/1", "kind": kind}
    return {**head, **document, **head}


def plain(value: Any) -> Any:
    """Convert a value for JSON. Arrays become lists, and non-finite numbers become None.

    Raises:
        TypeError: the value cannot be converted.
    """
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    tolist = getattr(value, "tolist", None)  # numpy and jax arrays and scalars, without importing either
    if tolist is not None:
        return plain(tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Iterable):
        return [plain(item) for item in value]
    raise TypeError(f"an object of type {type(value).__name__} cannot be converted to plain data")


@dataclass_transform(frozen_default=True)
def result(kind: type[T]) -> type[T]:
    """Make a class a frozen dataclass. The repr shows numbers, short texts and types."""

    def __repr__(self: Any) -> str:
        values = ((one.name, getattr(self, one.name)) for one in dataclasses.fields(self))
        return f"{kind.__name__}({', '.join(f'{name}={_short(value)}' for name, value in values)})"

    kind.__repr__ = __repr__
    return dataclasses.dataclass(frozen=True)(kind)


def _short(value: Any) -> str:
    shown = value is None or isinstance(value, int | float | Path) or (type(value) is str and len(value) < 80)
    return repr(value) if shown else f"<{type(value).__name__}>"
