"""What `NeighborFlips` is asked for: groups, rules, frames. What cannot be is refused before any is read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int
from MDAnalysis.core.groups import AtomGroup, UpdatingAtomGroup

from mdnum.errors import InputError
from mdnum.trajectories.rules import Cutoff, Rule, SpeciesCutoffs


def group_of(atoms: Any, name: str) -> AtomGroup:
    """The group, if pairs can be made of it.

    Raises:
        InputError: it is none, is empty, or changes from frame to frame.
    """
    if isinstance(atoms, UpdatingAtomGroup):
        raise InputError(
            f"the group {name} changes from frame to frame, and a pair not looked at any more has not left",
            remedy="Give atoms.select_atoms(...) without updating=True",
        )
    if not isinstance(atoms, AtomGroup):
        raise InputError(
            f"{type(atoms).__name__} where atoms are expected", remedy="Give a Universe or an AtomGroup"
        )
    if len(atoms) == 0:
        raise InputError(f"the group {name} is empty", remedy="Check the selection")
    return atoms


def indices_of(group: AtomGroup) -> np.ndarray:
    """Its atoms, ascending, each once."""
    return np.unique(np.asarray(group.indices, np.int64))


def in_any_pair(first: np.ndarray | None, second: np.ndarray | None) -> np.ndarray | None:
    """The atoms that are in any pair; None for all."""
    if first is None:
        return None
    return first if second is None else np.union1d(first, second)


def rules_of(r_cut: Any, rule: Rule | Sequence[Rule] | None) -> list[Rule]:
    """Membership rules from what `NeighborFlips` takes for them.

    Raises:
        InputError: there is none, or one cannot be.
    """
    rules: list[Rule] = []
    if r_cut is not None:
        several = isinstance(r_cut, list | tuple) or (isinstance(r_cut, np.ndarray) and r_cut.ndim)
        rules.extend(_cutoff(one) for one in (r_cut if several else [r_cut]))
    if rule is not None:
        rules.extend(rule if isinstance(rule, Sequence) else [rule])
    if not rules:
        raise InputError(
            "no cutoff", remedy="Give r_cut=8.5 (Å), several as a list, or a rule of mdnum.trajectories.rules"
        )
    for one in rules:
        if not isinstance(one, Rule):
            raise InputError(
                f"{one!r} is no membership rule",
                remedy="Give Cutoff, SpeciesCutoffs, Nearest or Capped of mdnum.trajectories.rules",
            )
    return rules


def _cutoff(value: Any) -> Rule:
    try:
        if isinstance(value, Mapping):
            return SpeciesCutoffs({pair: _length(one) for pair, one in value.items()})
        return Cutoff(_length(value))
    except (TypeError, ValueError):
        raise InputError(
            f"r_cut = {value!r}; expected a length in Å, or lengths by pair of species",
            remedy='Give r_cut=8.5, {("O", "H"): 2.5}, or a list of them',
        ) from None


def _length(value: Any) -> float:
    if isinstance(value, str | bytes):
        raise ValueError("words")
    return float(value)


def refuse_strangers(rules: Sequence[Rule], species: Sequence[str]) -> None:
    """Raises InputError where a rule is about a species that no atom has."""
    for rule in rules:
        if isinstance(rule, SpeciesCutoffs):
            rule.table(species)


def bound_of(value: float | None) -> float | None:
    """How far a distance can be off, Å, as given.

    Raises:
        InputError: it is no length.
    """
    if value is None or (math.isfinite(value) and value >= 0):
        return value
    raise InputError(
        f"bound = {value!r}; expected a length of 0 or more, Å",
        remedy="Leave it out for what the resolution of the file gives",
    )


def refuse_backward(numbers: Int[np.ndarray, "frames"]) -> None:
    """Raises InputError where frames do not follow one another in time."""
    back = np.flatnonzero(np.diff(numbers) <= 0)
    if back.size:
        first = int(back[0])
        raise InputError(
            f"the frames go backward or stand still: frame {numbers[first + 1]} after frame {numbers[first]}",
            remedy="Give them in ascending order: flips follow time",
        )


def refuse_kept_transformations(trajectory: Any, backend: Any) -> None:
    """Raises InputError where a transformation of the trajectory cannot be made in another process."""
    for one in getattr(trajectory, "transformations", ()):
        if not getattr(one, "parallelizable", False):
            name = getattr(one, "__name__", type(one).__name__)
            raise InputError(
                f"the transformation {name!r} of the trajectory cannot be handed over by backend={backend!r}",
                remedy="Use backend='serial', or make it an MDAnalysis.transformations.TransformationBase "
                "with parallelizable=True",
            )
