"""System files: their schema, and how simulations are built from them.

`build` and `Simulation` are imported on first use, because they import jax.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any

from mdnum.lazy import on_first_use
from mdnum.systems.ball import BallSpec
from mdnum.systems.load import BallSystem, Named, System, copy, load, names, shipped_folder, world_of
from mdnum.systems.schema import SystemSpec

if TYPE_CHECKING:
    from mdnum.systems.build import build as build
    from mdnum.systems.build_ball import BallSimulation as BallSimulation
    from mdnum.systems.build_ball import build_ball as build_ball
    from mdnum.systems.simulation import Simulation as Simulation


def opened(system: Simulation | Named, overrides: Mapping[str, Any] | None = None) -> Simulation | BallSystem:
    """Load a molecular-dynamics system or a bouncing-ball system; `load` describes the arguments.

    Raises:
        InputError: the system cannot be run; the message is one line.
    """
    if world_of(system) == "ball":
        return load(system, overrides)  # type: ignore[arg-type]
    from mdnum.systems.build import build

    return build(system, overrides)  # type: ignore[arg-type]


class _Package(ModuleType):
    """Module type in which `build` and `build_ball` are functions, not submodules."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Python binds an imported submodule to its package; here that would hide the function of its name
        if name in ("build", "build_ball") and isinstance(value, ModuleType):
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
__getattr__, __dir__, __all__ = on_first_use(__name__)
__all__ += [
    "BallSpec",
    "BallSystem",
    "System",
    "SystemSpec",
    "copy",
    "load",
    "names",
    "opened",
    "shipped_folder",
]
