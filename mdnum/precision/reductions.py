"""Reductions by name: every order in which a sum can be made (see `orders` for the contract)."""

from __future__ import annotations

from collections.abc import Mapping

from mdnum.precision.orders import Pairwise, Reduction, Sequential

__all__ = ["BY_NAME", "Pairwise", "Reduction", "Sequential", "make"]

BY_NAME: Mapping[str, Reduction] = {"sequential": Sequential(), "pairwise": Pairwise()}
