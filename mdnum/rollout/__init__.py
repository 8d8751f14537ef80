"""Running: epochs of a Verlet list, what they record, and the folder it goes into.

The names load jax when they are first used, not when this package is imported.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.rollout.engine import Engine, Segment
    from mdnum.rollout.run import RunResult, run

__all__ = ["Engine", "RunResult", "Segment", "run"]

_HOMES = {"Engine": "engine", "Segment": "engine", "RunResult": "run", "run": "run"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"mdnum.rollout.{_HOMES[name]}"), name)
    # importing a submodule binds it under its own name; `run` the function comes first
    globals()[name] = value
    return value
