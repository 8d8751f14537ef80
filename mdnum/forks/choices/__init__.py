"""Numerical choices that can differ between two runs."""

from __future__ import annotations

# they register themselves
from mdnum.forks.choices import arithmetic, ball, start  # noqa: F401
from mdnum.forks.choices.base import (
    CHOICES,
    Choice,
    parse,
    shipped,
    twin_of,
    twin_or_reason,
    unavailable,
    world_of,
)

__all__ = ["CHOICES", "Choice", "parse", "shipped", "twin_of", "twin_or_reason", "unavailable", "world_of"]
