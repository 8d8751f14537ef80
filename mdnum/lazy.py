"""Deferred import: names of a package are imported at first use (PEP 562)."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def on_first_use(
    package: str, **others: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package that imports names at first use.

    The names are those imported under `if TYPE_CHECKING` in the package. Imports under `if TYPE_CHECKING`
    must use full module names. Type checkers and Python therefore use the same names.

    Args:
        package: `__name__` of the package.
        others: "module:name" for each name that differs from the name in its module.
    """
    homes = {name: place.split(":") for name, place in others.items()}
    for node in ast.parse(Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            found = [one for one in node.body if isinstance(one, ast.ImportFrom)]
            said = [(str(one.module), alias) for one in found for alias in one.names]
            # what has another name here than in its module is there for type checkers alone
            homes |= {one.name: [home, one.name] for home, one in said if one.asname in (None, one.name)}

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, attribute = homes[name]
        own = module == package  # a module of it
        found = importlib.import_module(f"{package}.{name}" if own else module)
        value = found if own else getattr(found, attribute)
        setattr(sys.modules[package], name, value)
        return value

    names = sorted(homes)
    return get, lambda: names, names
