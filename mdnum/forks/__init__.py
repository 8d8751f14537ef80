"""Forks: where two runs part, which decision did it, and whether it mattered.

The names below are imported on first use: those of molecular dynamics bring jax_md, which a ball needs not.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_HOMES = {
    "BallFork": "bounce",
    "BallTwin": "bounce",
    "Decision": "pair",
    "Fork": "pair",
    "Pinned": "take_back",
    "Twin": "twin",
    "fork": "pair",
    "pinned": "take_back",
}

if TYPE_CHECKING:
    from mdnum.forks.bounce import BallFork, BallTwin
    from mdnum.forks.pair import Decision, Fork, fork
    from mdnum.forks.take_back import Pinned, pinned
    from mdnum.forks.twin import Twin

__all__ = ["BallFork", "BallTwin", "Decision", "Fork", "Pinned", "Twin", "fork", "pinned"]


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{home}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
