"""From a system file to something that runs: schema, loading, checks, and the build.

Importing this package imports neither jax nor jax_md; `build` and `Simulation` are loaded when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mdnum.systems.load import System, copy, load, names, shipped_folder
from mdnum.systems.schema import SystemSpec

if TYPE_CHECKING:
    from mdnum.systems.build import Simulation, build

__all__ = ["Simulation", "System", "SystemSpec", "build", "copy", "load", "names", "shipped_folder"]


def __getattr__(name: str) -> Any:
    if name in ("build", "Simulation"):
        module = importlib.import_module("mdnum.systems.build")
        # importing the submodule binds it to this package under the function's name: put the function there
        globals()["build"] = module.build
        globals()["Simulation"] = module.Simulation
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
