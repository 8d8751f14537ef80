"""What a diagnosis finds along the way: flips, boundaries, numbers that are not finite or do not fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.gradients.diagnose.plain import Plain, plain


@dataclass(frozen=True)
class Flips(Plain):
    """What each flip on the way adds to the gradient; a row for each, heaviest first.

    The columns of contributions sum to the event-aware gradient minus the symmetric one.

    Attributes:
        step, i, j, entered: the flip, each of shape (flips,); i < j.
        margin, bound: of the decision at that step, in the quantity's space. ambiguous: |margin| <= bound.
        radial_speed: length per internal time, negative where the pair enters.
        weight: derivative of the loss by the cutoff of this one crossing.
        grazing: slower than the guard and left out: it contributes 0, and its weight is what it would have
            been.
        contribution: by number, each of shape (flips,). A number is a scalar parameter, or an entry of one
            that has several: "potential.sigma[1]".
        smooth: the gradient between the flips (their decisions held fixed), by number. total: with the flips.
        share: share of the total that each channel adds, by number, then channel: "smooth", "pair enters",
            "pair leaves".
        skipped: parameters that have no contributions, with the reason.
        says: what stands out, in a sentence.
    """

    step: Int[np.ndarray, "flips"]
    i: Int[np.ndarray, "flips"]
    j: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]
    margin: Float[np.ndarray, "flips"]
    bound: Float[np.ndarray, "flips"]
    ambiguous: Bool[np.ndarray, "flips"]
    radial_speed: Float[np.ndarray, "flips"]
    weight: Float[np.ndarray, "flips"]
    grazing: Bool[np.ndarray, "flips"]
    contribution: dict[str, Float[np.ndarray, "flips"]]
    smooth: dict[str, float]
    total: dict[str, float]
    share: dict[str, dict[str, float]]
    skipped: dict[str, str]
    says: str

    def __len__(self) -> int:
        return len(self.step)

    def table(self) -> dict[str, np.ndarray]:
        """Columns of flip_contributions.parquet."""
        keys = (
            "step",
            "i",
            "j",
            "entered",
            "margin",
            "bound",
            "ambiguous",
            "radial_speed",
            "weight",
            "grazing",
        )
        out = {key: getattr(self, key) for key in keys}
        return out | {f"contribution.{name}": values for name, values in self.contribution.items()}

    def plain(self) -> dict[str, Any]:
        """Without the rows."""
        kept = {key: plain(getattr(self, key)) for key in ("smooth", "total", "share", "skipped", "says")}
        return {"flips": len(self), "grazing": int(self.grazing.sum())} | kept


@dataclass(frozen=True)
class Edge(Plain):
    """The nearest boundary of decisions on one side of a parameter, and the gradient across it.

    Attributes:
        side: "below" or "above".
        found: whether one was found within reach.
        inside, beyond: adjacent floats; the run at `inside` decides as the one asked about, that at `beyond`
            does not. NaN where none was found.
        distance: from the parameter's value to `inside`, in its units.
        step, i, j: the first decision that differs; -1 where none was found.
        value_inside, value_beyond: the loss on either side.
        gradient_inside, gradient_beyond: derivative by this parameter on either side, by method.
        runs: how many runs the search took.
    """

    side: str
    found: bool
    inside: float
    beyond: float
    distance: float
    step: int
    i: int
    j: int
    value_inside: float
    value_beyond: float
    gradient_inside: dict[str, float]
    gradient_beyond: dict[str, float]
    runs: int


@dataclass(frozen=True)
class Edges(Plain):
    """The nearest boundaries on either side of one parameter.

    Attributes:
        name: of the parameter. value: where it stands.
        below, above: the boundaries.
        says: in a sentence.
    """

    name: str
    value: float
    below: Edge
    above: Edge
    says: str


@dataclass(frozen=True)
class NotFinite(Plain):
    """Where a reverse pass stops being finite.

    Attributes:
        found: whether it does at all.
        forward: whether the forward run, its loss included, is finite.
        step: the first step, in the order of the reverse pass (last in time); -1 where all is finite.
        operation: the first operation there whose inputs are finite and whose result is not.
        source: file:line:function that wrote it; empty where it is not known.
        part: "loss", "forces", "crossings", "drift" or "parameters".
        i, j: the pair at fault, i < j; -1 where it is no pair (j alone -1: an atom).
        distance: of the pair, length; NaN where there is none.
        says: in a sentence.
    """

    found: bool
    forward: bool
    step: int
    operation: str
    source: str
    part: str
    i: int
    j: int
    distance: float
    says: str


@dataclass(frozen=True)
class Scaling(Plain):
    """Whether the cotangents of a reverse pass fit a narrow type, step by step.

    Attributes:
        format: the type, one of precision.formats.
        horizon: steps between the state and the end, shape (rows,).
        overflow: how many numbers of the step are beyond the largest of the format, unscaled, shape (rows,).
        underflow: how many are lost: not zero, and below half the smallest. subnormal: have lost digits.
        numbers: how many there are in each step.
        largest, smallest: magnitudes at each step; zeros are left out of the smallest (inf where all are).
        scale: a power of two by which the loss is multiplied so that the fewest numbers are lost and none
            overflows; NaN where no scale keeps the largest in range and more than half of the others.
        scaled_overflow, scaled_underflow: the counts with it, shape (rows,).
        fits: whether one scale serves all steps: nothing overflows, and no step loses more than 1 % of its
            numbers.
        says: in a sentence.
    """

    format: str
    horizon: Int[np.ndarray, "rows"]
    overflow: Int[np.ndarray, "rows"]
    underflow: Int[np.ndarray, "rows"]
    subnormal: Int[np.ndarray, "rows"]
    numbers: int
    largest: Float[np.ndarray, "rows"]
    smallest: Float[np.ndarray, "rows"]
    scale: float
    scaled_overflow: Int[np.ndarray, "rows"]
    scaled_underflow: Int[np.ndarray, "rows"]
    fits: bool
    says: str

    def table(self) -> dict[str, np.ndarray]:
        """A row for each horizon."""
        keys = (
            "horizon", "overflow", "underflow", "subnormal", "largest", "smallest", "scaled_overflow",
            "scaled_underflow",
        )  # fmt: skip
        return {key: getattr(self, key) for key in keys}

    def plain(self) -> dict[str, Any]:
        """Without the rows."""
        counts = ("overflow", "underflow", "subnormal", "scaled_overflow", "scaled_underflow")
        kept = {key: plain(getattr(self, key)) for key in ("format", "numbers", "scale", "fits", "says")}
        return kept | {key: int(getattr(self, key).sum()) for key in counts}
