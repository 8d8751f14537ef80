"""Names of a package that are imported when they are first used (PEP 562)."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def on_first_use(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package that imports nothing of its own.

    Args:
        package: its `__name__`.
        modules: names, with spaces between them, by the module in the package that has them; "new=old" where
            it calls them otherwise, and the module's own name for the module itself.
    """
    homes = {
        word.partition("=")[0]: (module, word.rpartition("=")[2])
        for module, words in modules.items()
        for word in words.split()
    }

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, attribute = homes[name]
        found = importlib.import_module(f"{package}.{module}")
        value = found if attribute == module else getattr(found, attribute)
        setattr(sys.modules[package], name, value)
        return value

    names = sorted(homes)
    return get, lambda: names, names
