"""All methods that apply, side by side, and what each of their differences means.

Methods answer different questions: the derivative of the steps that ran, the derivative of the flow with the
times of its flips, the slope of the loss between shifted runs, the slope of an average, the derivative of
another program. Two numbers that differ need not contradict one another, and the table says which it is.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mdnum.errors import InputError, MdnumError
from mdnum.gradients import parameters
from mdnum.gradients.base import Gradient, Method, Problem, Progress
from mdnum.gradients.diagnose.results import Agreement, Comparison, Opinion
from mdnum.gradients.registry import METHODS
from mdnum.precision import unit_roundoff

#: What a method differentiates, by its word. A method that is not here is one of the steps.
_STEPS, _FLOW, _VALUES, _AVERAGE, _OTHER = "steps", "flow", "values", "average", "other program"
KINDS: Mapping[str, str] = {
    "event-aware": _FLOW,
    "finite-differences": _VALUES,
    "shadow-differences": _VALUES,
    "smoothed-differences": _AVERAGE,
    "ensemble": _AVERAGE,
    "reweighting": _AVERAGE,
    "boundary": _AVERAGE,
    "surrogate": _OTHER,
}
#: Below so many rounding errors, times what they grew by, two derivatives agree.
_ROUNDINGS = 1e4
#: A difference of values is believed within so many of its own error estimates.
_ERRORS = 5.0


@dataclass(frozen=True)
class Scale:
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
        methods: words or methods; default all there are. One that does not apply is listed with the reason.
        known: gradients that have been worked out already, by word.
        growth: how much the gradient by the state grew over the run (`Growth`), for telling rounding.
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no such parameter or method, or no method applies.
    """
    full = parameters.resolve(problem.simulation, names)
    known = dict(known or {})
    asked = list(METHODS) if methods is None else methods
    chosen = [METHODS[word]() if isinstance(word, str) else word for word in _checked(asked)]
    opinions = [
        Opinion(one.name, one.says, known[one.name], "", 0.0)
        if one.name in known
        else _asked(one, problem, full, progress)
        for one in chosen
    ]
    given = [one for one in opinions if one.found is not None]
    if not given:
        reasons = "; ".join(f"{one.method}: {one.missing}" for one in opinions)
        raise InputError(f"no method applies: {reasons}")
    reference = _reference(problem, [one.method for one in given])
    whole = next(one.found for one in given if one.method == reference)
    assert whole is not None
    roundings = [unit_roundoff(problem.simulation.policy.dtype(role)) for role in ("state", "force")]
    scale = Scale(max(roundings), growth)
    jumps = bool(np.any(problem.simulation.jumps()[1] != 0))
    rows = [
        compare(name, one.found, whole, scale, jumps=jumps)
        for one in given
        if one.method != reference and one.found is not None
        for name in full
        if name in one.found.gradient and name in whole.gradient
    ]
    return Agreement(problem.steps, reference, tuple(opinions), tuple(rows))


def _checked(words: Sequence[str | Method]) -> Sequence[str | Method]:
    unknown = [word for word in words if isinstance(word, str) and word not in METHODS]
    if unknown:
        raise InputError(f"no method {unknown[0]!r}", remedy=f"There are {', '.join(METHODS)}")
    return words


def _asked(method: Method, problem: Problem, names: Sequence[str], progress: Progress | None) -> Opinion:
    """What a method says, by all names or by those that it can have."""
    begun = time.perf_counter()

    def report(done: int, steps: int, phase: str) -> None:
        assert progress is not None
        progress(done, steps, f"{method.name}: {phase}")

    why = method.why_not(problem, names)
    left = [name for name in names if why is None or method.why_not(problem, [name]) is None]
    if not left:
        return Opinion(method.name, method.says, None, why or "", 0.0)
    try:
        found = method(problem, left, None if progress is None else report)
    except MdnumError as error:
        return Opinion(method.name, method.says, None, str(error), time.perf_counter() - begun)
    return Opinion(method.name, method.says, found, "", time.perf_counter() - begun)


def _reference(problem: Problem, words: Sequence[str]) -> str:
    """The method that the others are held against: the one that leaves nothing out, where it is there."""
    jumps = bool(np.any(problem.simulation.jumps()[1] != 0))
    order = ("event-aware", "symmetric") if jumps else ("symmetric", "event-aware")
    return next((word for word in (*order, "unrolled", "forward") if word in words), words[0])


def compare(name: str, one: Gradient, reference: Gradient, scale: Scale, *, jumps: bool) -> Comparison:
    """Two derivatives by one parameter.

    Args:
        name: of the parameter.
        one, reference: both have it.
        scale: what rounding can do.
        jumps: whether the force jumps at the cutoff.
    """
    a = np.asarray(one.gradient[name], np.float64)
    b = np.asarray(reference.gradient[name], np.float64)
    apart = float(a - b) if a.ndim == 0 else float(np.linalg.norm(a - b))
    size = float(np.maximum(np.linalg.norm(a), np.linalg.norm(b)))
    relative = 0.0 if size == 0 else abs(apart) / size
    means, says = _meaning(name, one, reference, apart, relative, scale, jumps)
    right = float(np.linalg.norm(b))
    off = abs(apart) / right if right else float("inf") if apart else 0.0
    return Comparison(name, one.method, reference.method, right, apart, off, means, says)


def _meaning(
    name: str, one: Gradient, reference: Gradient, apart: float, relative: float, scale: Scale, jumps: bool
) -> tuple[str, str]:
    kind, against = (KINDS.get(found.method, _STEPS) for found in (one, reference))
    if not np.isfinite(relative):
        return "unexplained", "One of the two is not finite."
    if relative <= scale.rounding:
        return "agree", "The same up to rounding."
    if kind == _OTHER or against == _OTHER:
        which = one.method if kind == _OTHER else reference.method
        return "another program", f"{which} differentiates another program, with a gradient of its own."
    if kind == _AVERAGE or against == _AVERAGE:
        which = one if kind == _AVERAGE else reference
        return _average(name, which, apart)
    if kind == against:
        passes = "".join(
            f" {found.method}: {found.details['primal']['says']}."
            for found in (one, reference)
            if "primal" in found.details
        )
        if relative <= scale.primal:
            return "rounding", (
                f"Roundings of two forward passes, grown {scale.growth:.3g}-fold, explain up to "
                f"{scale.primal:.1g}.{passes}"
            )
        return "unexplained", f"Rounding explains {scale.primal:.1g} at most.{passes}"
    if _VALUES in (kind, against):
        return _of_values(
            name, one if kind == _VALUES else reference, apart, scale, relative, jumps, {kind, against}
        )
    # one of the steps, the other with the times of the flips
    if any(found.details.get("crossings") == 0 for found in (one, reference)):
        return "rounding", "No pair crossed its cutoff: what is left is rounding around zero."
    if jumps:
        return "missing saltation", (
            f"{one.method if kind == _STEPS else reference.method} holds decisions fixed; "
            f"the times of the flips make {relative:.2g} of the gradient."
        )
    if relative <= scale.primal:
        return "rounding", f"The force does not jump; rounding explains up to {scale.primal:.1g}."
    return "unexplained", "The force does not jump at the cutoff, so flips add nothing."


def _average(name: str, which: Gradient, apart: float) -> tuple[str, str]:
    error = which.details.get("error", {}).get(name)
    if error is not None:
        size = float(np.linalg.norm(np.asarray(error, np.float64)))
        within = abs(apart) / size if size > 0 else float("inf")
        if within <= _ERRORS:
            return "statistical", f"Within {within:.2g} standard errors of an average."
    return "an average", f"{which.method} is the slope of an average, not of this one run."


def _of_values(
    name: str,
    values: Gradient,
    apart: float,
    scale: Scale,
    relative: float,
    jumps: bool,
    kinds: set[str],
) -> tuple[str, str]:
    """What separates a difference of values from a derivative."""
    error = values.details.get("error", {}).get(name)
    if error is not None and abs(apart) <= _ERRORS * float(error):
        return "truncation and noise", f"Within what the differences say of themselves, {float(error):.2g}."
    if relative <= scale.primal:
        return "rounding", f"Rounding, grown {scale.growth:.3g}-fold, explains up to {scale.primal:.1g}."
    if jumps:
        what = (
            "the shifted runs decide some pairs otherwise, and each such decision moves the loss by a jump"
            if _FLOW in kinds
            else "decisions are held fixed on one side and made anew at each shift on the other"
        )
        return "events between shifts", f"The force jumps: {what}."
    return "unexplained", "Beyond the differences' own estimate of their error."
