"""Forks: where two runs part, which decision did it, and whether it mattered."""

from __future__ import annotations

from mdnum.forks.pair import Decision, Fork, fork
from mdnum.forks.take_back import Pinned, pinned
from mdnum.forks.twin import Twin

__all__ = ["Decision", "Fork", "Pinned", "Twin", "fork", "pinned"]
