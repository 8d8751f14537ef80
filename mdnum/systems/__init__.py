"""From a system file to something that runs: schema, loading, checks, and the build.

Importing this package imports neither jax nor jax_md; `build` and `Simulation` are loaded when first used.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from mdnum.systems.ball import BallSpec
from mdnum.systems.ball_system import BallSystem
from mdnum.systems.load import System, copy, load, names, shipped_folder
from mdnum.systems.schema import SystemSpec

if TYPE_CHECKING:
    from mdnum.systems.build import Simulation, build

__all__ = [
    "BallSpec",
    "BallSystem",
    "Simulation",
    "System",
    "SystemSpec",
    "build",
    "copy",
    "load",
    "names",
    "shipped_folder",
]


class _Package(ModuleType):
    """This package, in which `build` is the function, whoever imports the file of that name first."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Python binds an imported submodule to its package; here that would hide the function of its name
        if name == "build" and isinstance(value, ModuleType):
            value = value.build
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name in ("build", "Simulation"):
        return getattr(importlib.import_module("mdnum.systems.build"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
