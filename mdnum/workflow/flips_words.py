"""Words of `mdnum flips`: cutoffs, pairs of species and numbers of neighbors as membership rules."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mdnum.errors import InputError

if TYPE_CHECKING:
    from mdnum.trajectories.rules import Rule

_PAIRS = 'Write pairs of species with a length each, for example --pairs "O-H=2.5,O-O=3.5"'


def rules(
    cutoffs: Sequence[float] = (),
    pairs: Sequence[str | Mapping[tuple[str, str], float]] = (),
    nearest: Sequence[int] = (),
    most: int | None = None,
) -> tuple[Rule, ...]:
    """The membership rules asked for, in this order: cutoffs, pairs of species, nearest neighbors.

    Args:
        cutoffs: lengths, in the trajectory's unit.
        pairs: a rule each: "O-H=2.5,O-O=3.5", or lengths by pair of species.
        nearest: numbers of neighbors, a rule each.
        most: neighbors an atom can have inside a cutoff, the nearest of them.

    Raises:
        InputError: a word is not understood, a rule comes twice, or `most` has no cutoff to go with.
    """
    from mdnum.trajectories.rules import Capped, Cutoff, Nearest, SpeciesCutoffs

    if most is not None and not cutoffs:
        raise InputError(
            "--most keeps the nearest of those inside a cutoff, and there is no cutoff",
            remedy="Add --cutoff R; for the K nearest without a cutoff write --nearest K",
        )
    found: list[Rule] = [Cutoff(radius) if most is None else Capped(radius, most) for radius in cutoffs]
    found += [SpeciesCutoffs(one if isinstance(one, Mapping) else species_cutoffs(one)) for one in pairs]
    found += [Nearest(k) for k in nearest]
    names = [one.name for one in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"the rule {twice[0]!r} is asked for twice", remedy="Keep one of them")
    return tuple(found)


def species_cutoffs(words: str) -> dict[tuple[str, str], float]:
    """Lengths by pair of species of "O-H=2.5,O-O=3.5".

    Raises:
        InputError: not of that form, or a pair that comes twice.
    """
    found: dict[tuple[str, str], float] = {}
    for part in words.split(","):
        pair, equals, value = part.partition("=")
        first, dash, second = (one.strip() for one in pair.partition("-"))
        try:
            length = float(value)
        except ValueError:
            length = math.nan
        if not (equals and dash and first and second) or "-" in second or not length > 0:
            raise InputError(
                f"--pairs {words!r}: {part.strip()!r} is not of the form A-B=LENGTH", remedy=_PAIRS
            )
        if {(first, second), (second, first)} & set(found):
            raise InputError(f"--pairs {words!r} gives {first}-{second} twice", remedy="Keep one of them")
        found[first, second] = length
    return found


def cutoff_of_run(path: Path) -> float | None:
    """The cutoff with which mdnum made a trajectory, from the system.toml beside it; None without one."""
    beside = (path if path.is_dir() else path.parent) / "system.toml"
    if not beside.is_file():
        return None
    try:
        radius = tomllib.loads(beside.read_text(encoding="utf-8")).get("cutoff", {}).get("radius")
    except (OSError, tomllib.TOMLDecodeError, AttributeError):
        return None
    return float(radius) if isinstance(radius, int | float) else None
