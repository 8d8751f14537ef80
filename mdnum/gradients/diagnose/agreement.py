"""All methods that apply, side by side, and what each of their differences means.

Methods answer different questions: the derivative of the steps that ran, the derivative of the flow with the
times of its flips, the slope of the loss between shifted runs, the slope of an average, the derivative of
another program. Two numbers that differ need not contradict one another: the comparison names which it is.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mdnum.errors import InputError, MdnumError
from mdnum.gradients import parameters
from mdnum.gradients.problem import METHODS, Gradient, Method, Problem, Progress
from mdnum.gradients.problem import method as by_name
from mdnum.numerics import unit_roundoff

#: Below this number of rounding errors, times what they grew by, two derivatives agree.
_ROUNDINGS = 1e4
#: A difference of values is believed within this multiple of its own error estimate.
_ERRORS = 5.0


@dataclass(frozen=True)
class Opinion:
    """What one method gives.

    Attributes:
        method: its name. description: which derivative it gives, one sentence.
        found: the gradient; None where there is none.
        missing: why there is none: it does not apply, or it failed. Empty where there is one.
        seconds: wall time, compiling included.
    """

    method: str
    description: str
    found: Gradient | None
    missing: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class GradientDifference:
    """The derivatives of two methods by one parameter.

    Attributes:
        name: full name of the parameter.
        method, reference: names of the two methods.
        size: Euclidean norm of the reference's derivative (a scalar's magnitude).
        difference: norm of the difference; signed (method minus reference) for a scalar.
        relative: |difference| over `size`; infinite where only the reference is 0.
        meaning: "agree", "missing saltation", "rounding", "truncation and noise", "events between shifts",
            "another program", "an average", "statistical" or "unexplained".
        values: the numbers that this rests on.
    """

    name: str
    method: str
    reference: str
    size: float
    difference: float
    relative: float
    meaning: str
    values: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Agreement:
    """All methods that apply, at one horizon.

    Attributes:
        horizon: steps.
        reference: name of the method that the others are compared with.
        opinions: one for each method asked for.
        comparisons: of every method that gave a gradient with the reference, by parameter.
    """

    horizon: int
    reference: str
    opinions: tuple[Opinion, ...]
    comparisons: tuple[GradientDifference, ...]

    def gradient(self, method: str) -> Gradient | None:
        """What a method found."""
        return next((one.found for one in self.opinions if one.method == method), None)


@dataclass(frozen=True)
class RoundingScale:
    """What rounding can do to a gradient.

    Attributes:
        unit: unit roundoff of the run's state or forces, whichever is coarser.
        growth: how much the gradient by the state grew over the run; 1 where that is not known.
    """

    unit: float
    growth: float = 1.0

    @property
    def rounding(self) -> float:
        """Relative difference of two exact derivatives of one run, evaluated in other orders."""
        return _ROUNDINGS * self.unit

    @property
    def primal(self) -> float:
        """Relative difference where the forward passes differ by a rounding, too."""
        return min(_ROUNDINGS * self.unit * max(self.growth, 1.0), 1.0)


def agreement(
    problem: Problem,
    names: Sequence[str],
    methods: Sequence[str | Method] | None = None,
    *,
    known: Mapping[str, Gradient] | None = None,
    growth: float = 1.0,
    progress: Progress | None = None,
) -> Agreement:
    """The gradient by several methods, and what their differences mean.

    Args:
        problem: the loss of a rollout.
        names: parameters, full or short names. A method that cannot have some of them is asked for the
            others.
        methods: names or methods; default all there are. One that does not apply is listed with the reason.
        known: gradients that have been worked out already, by name of the method.
        growth: how much the gradient by the state grew over the run (`GradientGrowth.gain`).
        progress: called with the steps done, all steps, and the name of the phase.

    Raises:
        InputError: no such parameter or method, or no method applies.
    """
    full = parameters.resolve(problem.simulation, names)
    known = dict(known or {})
    asked = list(METHODS) if methods is None else methods
    chosen = [by_name(one) if isinstance(one, str) else one for one in asked]
    opinions = [
        Opinion(one.name, one.description, known[one.name])
        if one.name in known
        else _asked(one, problem, full, progress)
        for one in chosen
    ]
    given = [one.found for one in opinions if one.found is not None]
    if not given:
        reasons = "; ".join(f"{one.method}: {one.missing}" for one in opinions)
        raise InputError(f"no method applies: {reasons}")
    # the method that leaves nothing out, where it is there
    order = ("event-aware", "symmetric") if problem.jumps else ("symmetric", "event-aware")
    there = {one.method: one for one in given}
    reference = next((word for word in (*order, "unrolled", "forward") if word in there), given[0].method)
    roundings = [unit_roundoff(problem.simulation.policy.dtype(role)) for role in ("state", "force")]
    scale = RoundingScale(max(roundings), growth)
    rows = [
        compare(name, one, there[reference], scale, jumps=problem.jumps)
        for one in given
        if one.method != reference
        for name in full
        if name in one.gradient and name in there[reference].gradient
    ]
    return Agreement(problem.steps, reference, tuple(opinions), tuple(rows))


def _asked(method: Method, problem: Problem, names: Sequence[str], progress: Progress | None) -> Opinion:
    """What a method gives, by all names or by those that it can have."""
    began = time.perf_counter()

    def report(done: int, steps: int, phase: str) -> None:
        assert progress is not None
        progress(done, steps, f"{method.name}: {phase}")

    why, found = method.reason_unavailable(problem, names), None
    left = [name for name in names if why is None or method.reason_unavailable(problem, [name]) is None]
    if left:
        try:
            found, why = method(problem, left, None if progress is None else report), None
        except MdnumError as error:
            why = str(error)
    return Opinion(method.name, method.description, found, why or "", time.perf_counter() - began)


def compare(
    name: str, one: Gradient, reference: Gradient, scale: RoundingScale, *, jumps: bool
) -> GradientDifference:
    """Two derivatives by one parameter.

    Args:
        name: of the parameter.
        one, reference: both have it.
        scale: what rounding can do.
        jumps: whether the force jumps at the cutoff.
    """
    a, b = (np.asarray(found.gradient[name], np.float64) for found in (one, reference))
    difference = float(a - b) if a.ndim == 0 else float(np.linalg.norm(a - b))
    size = float(np.maximum(np.linalg.norm(a), np.linalg.norm(b)))
    relative = 0.0 if size == 0 else abs(difference) / size
    meaning, values = _meaning(name, one, reference, abs(difference), relative, scale, jumps)
    right = float(np.linalg.norm(b))
    off = abs(difference) / right if right else float("inf") if difference else 0.0
    return GradientDifference(name, one.method, reference.method, right, difference, off, meaning, values)


def _meaning(
    name: str,
    one: Gradient,
    reference: Gradient,
    size: float,
    relative: float,
    scale: RoundingScale,
    jumps: bool,
) -> tuple[str, dict[str, Any]]:
    kinds = {one.kind: one, reference.kind: reference}
    by_rounding = {"grown": scale.growth, "explained": scale.primal}
    if not np.isfinite(relative):
        return "unexplained", {}
    if relative <= scale.rounding:
        return "agree", {}
    if "other program" in kinds:
        return "another program", {}
    for kind, within in (("average", "statistical"), ("values", "truncation and noise")):
        if kind not in kinds or (kind == "values" and len(kinds) == 1):
            continue
        error = kinds[kind].details.get("error", {}).get(name)
        estimate = 0.0 if error is None else float(np.linalg.norm(np.asarray(error, np.float64)))
        if error is not None and size <= _ERRORS * estimate:
            return within, {"error": estimate}
        if kind == "average":
            return "an average", {}
    if "flow" in kinds and "steps" in kinds:
        if any(found.details.get("crossings") == 0 for found in (one, reference)):
            return "rounding", {}
        if jumps:
            return "missing saltation", {"share": relative}
    if relative <= scale.primal:
        return "rounding", by_rounding
    if "values" in kinds and len(kinds) == 2 and jumps:
        return "events between shifts", {}
    return "unexplained", by_rounding
