"""Search for the cheapest setting whose results agree with converged results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnum.sweeps.design import label
from mdnum.sweeps.statistics import Within, within

#: Choices that should affect no result; the fastest value is recommended.
FREE = ("neighbors.skin", "neighbors.builder")
#: The end of an axis at which results are converged: its largest value, its smallest value, a given value, or
#: "any" for a choice that should affect no result.
_ENDS = {
    "cutoff.radius": "largest", "cutoff.in_sigma": "largest", "dynamics.timestep": "smallest",
    "structure.repeat": "largest", "dynamics.steps": "largest", "tol": "smallest", "timestep": "smallest",
    "h": "smallest", "neighbors.skin": "any", "precision": "float64", "precision.state": "float64",
    "precision.force": "float64", "precision.reduction": "exact",
}  # fmt: skip


@dataclass(frozen=True)
class EndComparison:
    """Comparison of one value of a choice, or of a setting, with converged results."""

    value: Any
    by_measure: Mapping[str, Within]

    @property
    def worst(self) -> str | None:
        """A measure outside its tolerance, or else the undecided measure that needs the most seeds."""
        each = self.by_measure
        ranked = sorted(each, key=lambda name: (each[name].inside is not False, -each[name].more))
        return next((name for name in ranked if each[name].inside is not True), None)

    @property
    def inside(self) -> bool | None:
        """True if all measures are within tolerance, False if one is not, None if undecided."""
        each = [one.inside for one in self.by_measure.values()]
        return False if False in each else None if None in each else True

    @property
    def more(self) -> float:
        """Factor by which the number of seeds must grow to decide every comparison."""
        return max((one.more for one in self.by_measure.values()), default=1.0)


@dataclass(frozen=True)
class Advice:
    """Recommended value of an axis (a varied choice), and comparisons with converged results.

    Attributes:
        key: key of the axis. end: the value that is regarded as converged; None if there is none.
        settings: every value with its comparison, starting at the converged end.
        best: the value furthest from the end for which this value and all values in between are within the
            tolerance, or else the end itself.
        undecided: the first value beyond `best` whose comparison is undecided.
        converged: whether the value next to the end agrees with the end within the tolerance; if not, the end
            may not be converged.
    """

    key: str
    end: Any
    settings: tuple[EndComparison, ...]
    best: Any
    undecided: Any
    converged: bool | None


def end_of(key: str, values: Sequence[Any], given: Mapping[str, str] = {}) -> Any:
    """Return the value of an axis that counts as converged, or None."""
    word = given.get(key, _ENDS.get(key) or _ENDS.get(key.rpartition(".")[2], ""))
    if word == "largest":
        return max(values, key=_size)
    if word == "smallest":
        return min(values, key=_size)
    return next((one for one in values if str(one) == word), None)


def _size(value: Any) -> float:
    return float(np.prod(value)) if np.ndim(value) else float(value)


def advise(
    key: str,
    values: Sequence[Any],
    found: Mapping[str, Mapping[str, tuple[float, float, float]]],
    tolerances: Mapping[str, float],
    given: Mapping[str, str] = {},
) -> Advice | None:
    """Return the recommended value of an axis, or None.

    Args:
        values: values of the axis.
        found: differences from the end, as `difference` returns them, by measure and by label of a value.
        tolerances: tolerances by measure, in its unit.
        given: converged ends by key, instead of the default ends: "largest", "smallest" or a value.
    """
    end = end_of(key, values, given)
    if end is None or not tolerances:
        return None
    rest = [one for one in values if one != end]
    rest.sort(key=lambda one: abs(_size(one) - _size(end)) if _numeric(one, end) else 0.0)
    comparisons = max(1, len(rest) * len(tolerances))
    settings = [EndComparison(end, {})]
    settings += [compared_with_end(one, label(one), found, tolerances, comparisons) for one in rest]
    best, undecided = end, None
    for setting in settings[1:]:
        if setting.inside is not True:
            undecided = setting.value if setting.inside is None else None
            break
        best = setting.value
    converged = settings[1].inside if len(settings) > 1 else None
    return Advice(key, end, tuple(settings), best, undecided, converged)


def compared_with_end(
    value: Any,
    key: str,
    found: Mapping[str, Mapping[str, tuple[float, float, float]]],
    tolerances: Mapping[str, float],
    comparisons: int,
) -> EndComparison:
    """Compare results for one value of a choice, or for a setting, with converged results.

    Args:
        key: its label in `found`. found, tolerances: as for `advise`. comparisons: their number.
    """
    none = (np.nan, np.nan, np.nan)
    each = {
        name: within(*found[name].get(key, none), tolerance, comparisons)
        for name, tolerance in tolerances.items()
    }
    return EndComparison(value, each)


def _numeric(*values: Any) -> bool:
    return all(isinstance(one, int | float) or np.ndim(one) for one in values)
