"""What a diagnosis finds: plain results on the host, for tables, files and pages.

Each has `plain()`, a dictionary that JSON can hold (numbers that are not finite are None), and those with
rows have `table()`, columns of one length for a parquet file.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mdnum.gradients.base import Gradient
from mdnum.gradients.diagnose.near import Turns
from mdnum.gradients.diagnose.places import Edges, Flips, NotFinite, Scaling
from mdnum.gradients.diagnose.plain import Plain, plain


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
        relative: |difference| over `size`; infinite where only the reference is 0.
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
        what: "rounding", "time step", "near miss", "flips left out", "ambiguous decision" or
            "standard error".
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
        verdict: "trusted" where every limit was looked at and none was met, "limited" where one was met, else
            "undecided".
        horizon: the shortest of the limits that were looked at, steps.
        limited_by: which it is; empty where none was met.
        limits: all of them.
        unknown: what was not looked at, in words.
        tolerance: relative difference above which two precisions, or two time steps, disagree.
        shadow: what the run's precision was compared with, in words.
        at: horizons that were compared, shape (points,).
        relative: relative difference of the two precisions' gradients there, by parameter, each of shape
            (points,).
        step: the same of the time step and its half; empty where that was not looked at.
        error: standard error over the mean there, by parameter; empty without an ensemble.
        half: the gradient at half the time step, by parameter, each of shape (entries,).
        digits: digits of the gradient that half the time step and another rounding leave, by parameter.
        turns: pairs that turned around near their cutoff; None where that was not looked at.
        columns: the numbers whose terms these have, in words.
        says: all in a sentence.
    """

    verdict: str
    horizon: int
    limited_by: str
    limits: tuple[Limit, ...]
    unknown: tuple[str, ...]
    tolerance: float
    shadow: str
    at: Int[np.ndarray, "points"]
    relative: dict[str, Float[np.ndarray, "points"]]
    step: dict[str, Float[np.ndarray, "points"]]
    error: dict[str, Float[np.ndarray, "points"]]
    half: dict[str, Float[np.ndarray, "entries"]]
    digits: dict[str, int]
    turns: Turns | None
    columns: tuple[str, ...]
    says: str

    def table(self) -> dict[str, np.ndarray]:
        """A row for each horizon that was compared."""
        out = {"horizon": self.at}
        for key in ("relative", "step", "error"):
            out |= {f"{key}.{name}": values for name, values in getattr(self, key).items()}
        return out

    def plain(self) -> dict[str, Any]:
        """Without the rows."""
        rows = ("at", "relative", "step", "error", "turns", "columns")
        kept = {one.name: plain(getattr(self, one.name)) for one in fields(self) if one.name not in rows}
        if self.turns is None:
            return kept | {"near": None}
        near = {"turns": len(self.turns), "within": int(self.turns.within.sum())}
        return kept | {"near": near | {"heaviest": self.turns.heaviest(self.columns)}}


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
