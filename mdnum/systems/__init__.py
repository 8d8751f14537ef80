"""From a system file to something that runs: schema, loading, checks, and the build.

Importing this package imports neither jax nor jax_md; `build` and `Simulation` are loaded when first used.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from mdnum.systems.ball import BallSpec
from mdnum.systems.load import BallSystem, System, copy, load, names, shipped_folder
from mdnum.systems.schema import SystemSpec

if TYPE_CHECKING:
    from mdnum.systems.build import build
    from mdnum.systems.build_ball import BallSimulation, build_ball
    from mdnum.systems.simulation import Simulation

__all__ = [
    "BallSimulation",
    "BallSpec",
    "BallSystem",
    "Simulation",
    "System",
    "SystemSpec",
    "build",
    "build_ball",
    "copy",
    "load",
    "names",
    "shipped_folder",
]


_LATER = {
    "build": "mdnum.systems.build",
    "Simulation": "mdnum.systems.simulation",
    "build_ball": "mdnum.systems.build_ball",
    "BallSimulation": "mdnum.systems.build_ball",
}


class _Package(ModuleType):
    """This package, in which `build` and `build_ball` are the functions, whoever imports their files."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Python binds an imported submodule to its package; here that would hide the function of its name
        if name in ("build", "build_ball") and isinstance(value, ModuleType):
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    home = _LATER.get(name)
    if home is not None:
        return getattr(importlib.import_module(home), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
