"""What a diagnosis finds: plain results on the host, for tables, files and pages.

Each has `plain()`, a dictionary that JSON can hold (numbers that are not finite are None), and those with
rows have `table()`, columns of one length for a parquet file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.gradients.base import Gradient


def plain(value: Any) -> Any:
    """A result as dictionaries, lists, words and numbers that JSON can hold."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value


class Plain:
    """Has `plain()`."""

    def plain(self) -> dict[str, Any]:
        """As dictionaries, lists, words and numbers that JSON can hold."""
        return plain(self)


@dataclass(frozen=True)
class Opinion(Plain):
    """What one method says.

    Attributes:
        method: its word.
        says: which derivative it gives, one sentence.
        found: the gradient; None where there is none.
        missing: why there is none: it does not apply, or it failed. Empty where there is one.
        seconds: wall time, compiling included.
    """

    method: str
    says: str
    found: Gradient | None
    missing: str
    seconds: float


@dataclass(frozen=True)
class Comparison(Plain):
    """The derivatives of two methods by one parameter.

    Attributes:
        name: full name of the parameter.
        method, reference: words of the two methods.
        size: Euclidean norm of the reference's derivative (a scalar's magnitude).
        difference: norm of the difference; signed (method minus reference) for a scalar.
        relative: |difference| over the larger norm of the two; 0 where both are 0.
        means: "agree", "missing saltation", "rounding", "truncation and noise", "events between shifts",
            "another program", "an average", "statistical" or "unexplained".
        says: the same in a sentence.
    """

    name: str
    method: str
    reference: str
    size: float
    difference: float
    relative: float
    means: str
    says: str


@dataclass(frozen=True)
class Agreement(Plain):
    """All methods that apply, at one horizon.

    Attributes:
        horizon: steps.
        reference: word of the method that the others are compared with.
        opinions: one for each method asked for.
        comparisons: of every method that gave a gradient with the reference, by parameter.
    """

    horizon: int
    reference: str
    opinions: tuple[Opinion, ...]
    comparisons: tuple[Comparison, ...]

    def gradient(self, method: str) -> Gradient | None:
        """What a method found."""
        return next((one.found for one in self.opinions if one.method == method), None)

    def table(self) -> dict[str, np.ndarray]:
        """A row for each comparison."""
        columns = ("name", "method", "reference", "size", "difference", "relative", "means", "says")
        return {key: np.array([getattr(one, key) for one in self.comparisons]) for key in columns}


@dataclass(frozen=True)
class Growth(Plain):
    """How the gradient grows with the horizon, from one reverse pass.

    Row h belongs to the state h steps before the end: what the loss makes of a change there is the gradient
    of a run of h steps that starts there. All arrays have one row for each horizon 0, 1, ..., T.

    Attributes:
        horizon: steps between the state and the end, shape (rows,).
        step: of the state: T - horizon.
        onto_positions: norm of the derivative by all positions at that step, loss/length.
        onto_velocities: by all velocities, loss/(length/internal time).
        size: norm of both, with velocities measured by `clock`: loss/length.
        gradient: derivative by each named parameter, were it changed over the last `horizon` steps alone,
            by name, of shape (rows,) or (rows, entries). The last row is the gradient of the whole run.
        speed: rms speed of the atoms at that step, length/internal time: the forward run, for comparison.
        clock: internal time that turns velocities into lengths.
        timestep: in the units of the system's file.
        rate: growth of log(size) per step, from a straight line through the later part.
        error: its standard error, from blocks.
        word: "both bounded", "forward bounded, gradient not" or "forward not bounded".
        says: the same in a sentence.
    """

    horizon: Int[np.ndarray, "rows"]
    step: Int[np.ndarray, "rows"]
    onto_positions: Float[np.ndarray, "rows"]
    onto_velocities: Float[np.ndarray, "rows"]
    size: Float[np.ndarray, "rows"]
    gradient: dict[str, Float[np.ndarray, "rows *entries"]]
    speed: Float[np.ndarray, "rows"]
    clock: float
    timestep: float
    rate: float
    error: float
    word: str
    says: str

    def table(self) -> dict[str, np.ndarray]:
        """Columns of growth.parquet: a row for each horizon; of several entries, a column for each."""
        out = {
            "horizon": self.horizon,
            "step": self.step,
            "onto_positions": self.onto_positions,
            "onto_velocities": self.onto_velocities,
            "size": self.size,
            "speed": self.speed,
        }
        for name, values in self.gradient.items():
            columns = values.reshape(len(values), -1)
            if columns.shape[1] == 1:
                out[f"gradient.{name}"] = columns[:, 0]
            else:
                out |= {f"gradient.{name}.{k}": columns[:, k] for k in range(columns.shape[1])}
        return out

    def plain(self) -> dict[str, Any]:
        """Without the rows."""
        return {
            key: plain(getattr(self, key)) for key in ("clock", "timestep", "rate", "error", "word", "says")
        }


@dataclass(frozen=True)
class Spectrum(Plain):
    """How small changes of the start stretch: singular values of the product of all step Jacobians.

    Lengths of changes are those of positions, and of velocities times `clock`.

    Attributes:
        steps: of the run.
        clock: internal time.
        log_singular: natural logarithm of the largest singular values, largest first, shape (values,).
        residual: |Phi^T u - s v| / s of each with its vectors u and v: how exact it is, shape (values,).
        exponents: finite-time Lyapunov exponents log(s) / T per step, shape (values,).
        exponents_time: per unit of time of the system's file.
        horizon: steps at which the curve below has points, shape (points,).
        curve: log stretch of the k-th direction of an orthonormal frame carried forward, shape
            (points, values): its slopes are Lyapunov exponents, largest first.
        transposed: relative defect of <w, Phi v> = <Phi^T w, v>: forward and reverse passes are transposes
            of one another where it is a rounding error.
        word: "both bounded", "forward bounded, gradient not" or "forward not bounded".
        says: the same in a sentence.
    """

    steps: int
    clock: float
    log_singular: Float[np.ndarray, "values"]
    residual: Float[np.ndarray, "values"]
    exponents: Float[np.ndarray, "values"]
    exponents_time: Float[np.ndarray, "values"]
    horizon: Int[np.ndarray, "points"]
    curve: Float[np.ndarray, "points values"]
    transposed: float
    word: str
    says: str


@dataclass(frozen=True)
class Limit(Plain):
    """One of the things that end trust in a gradient.

    Attributes:
        what: "rounding", "standard error" or "ambiguous decision".
        horizon: the longest horizon, in steps, at which it did no harm; None where it was not looked at.
        reached: whether it was met within the horizon asked for; else trust holds at least that far.
        says: what was compared with what, and what was seen.
    """

    what: str
    horizon: int | None
    reached: bool
    says: str


@dataclass(frozen=True)
class Trust(Plain):
    """How far a gradient can be trusted.

    Attributes:
        horizon: the shortest of the limits that were looked at, steps.
        limited_by: which it is; empty where none was met.
        limits: all of them.
        tolerance: relative difference above which two precisions disagree.
        shadow: what the run's precision was compared with, in words.
        at: horizons that were compared, shape (points,).
        relative: relative difference of the two gradients there, by parameter, each of shape (points,).
        error: standard error over the mean there, by parameter; empty without an ensemble.
        says: all in a sentence.
    """

    horizon: int
    limited_by: str
    limits: tuple[Limit, ...]
    tolerance: float
    shadow: str
    at: Int[np.ndarray, "points"]
    relative: dict[str, Float[np.ndarray, "points"]]
    error: dict[str, Float[np.ndarray, "points"]]
    says: str

    def table(self) -> dict[str, np.ndarray]:
        """A row for each horizon that was compared."""
        out = {"horizon": self.at}
        out |= {f"relative.{name}": values for name, values in self.relative.items()}
        return out | {f"error.{name}": values for name, values in self.error.items()}


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


@dataclass(frozen=True)
class Diagnosis(Plain):
    """Whether a gradient can be trusted, and how far. A part that was not asked for is None.

    Attributes:
        horizon: steps.
        names: full names of the parameters.
        value: the loss.
        agreement, growth, spectrum, trust, flips, not_finite, scaling: see there.
        edges: by parameter.
        notes: what a reader must know about single parameters: no dependence, a missing term.
        failed: parts that were asked for and could not be had, with the reason.
    """

    horizon: int
    names: tuple[str, ...]
    value: float
    agreement: Agreement | None = None
    growth: Growth | None = None
    spectrum: Spectrum | None = None
    trust: Trust | None = None
    flips: Flips | None = None
    edges: dict[str, Edges] = field(default_factory=dict)
    not_finite: NotFinite | None = None
    scaling: Scaling | None = None
    notes: dict[str, str] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """As JSON can hold it; a part's rows are in its table alone."""
        out: dict[str, Any] = {}
        for one in fields(self):
            value = getattr(self, one.name)
            if one.name == "edges":
                value = {name: edges.plain() for name, edges in value.items()}
            out[one.name] = value.plain() if isinstance(value, Plain) else plain(value)
        return out
