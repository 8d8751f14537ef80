"""Simulation runs: the loop over time steps, its records, and the run folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mdnum.lazy import on_first_use

if TYPE_CHECKING:
    from mdnum.rollout.engine import Engine as Engine
    from mdnum.rollout.engine import unwrapped as unwrapped
    from mdnum.rollout.flips import PairRecorder as PairRecorder
    from mdnum.rollout.summary import ListHealth as ListHealth

__getattr__, __dir__, __all__ = on_first_use(__name__)
