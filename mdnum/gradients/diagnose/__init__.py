"""Diagnose a gradient: up to which step it can be trusted, and what contributes to the gradient.

Gradient methods compute different quantities: derivatives of the time steps, derivatives that include changes
of flip times, finite differences of the loss, finite differences of an ensemble average, or derivatives of
another program. The function `agreement` gives the reason for each difference between two gradients.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mdnum.errors import InputError, MdnumError
from mdnum.gradients import parameters
from mdnum.gradients.diagnose.detective import NotFinite, detective
from mdnum.gradients.diagnose.flips import DecisionEdges, FlipTerms, edges, flips
from mdnum.gradients.diagnose.growth import (
    GradientGrowth,
    GrowthWatch,
    Scaling,
    ScalingWatch,
    Spectrum,
    growth,
    spectrum,
)
from mdnum.gradients.diagnose.near import Near
from mdnum.gradients.diagnose.trust import TOLERANCE, Trust, trust
from mdnum.gradients.problem import METHODS, Gradient, Method, Problem, Progress
from mdnum.gradients.problem import method as by_name
from mdnum.gradients.recorded import EventAware, ReversePass, Symmetric, passed
from mdnum.gradients.tape import pace_of
from mdnum.md.integrators import without_kick
from mdnum.numerics import unit_roundoff
from mdnum.plain import result
from mdnum.registry import expect_known

__all__ = [
    "PARTS", "GradientDiagnosis", "GradientGrowth", "Spectrum", "Trust", "agreement", "detective", "diagnose",
    "edges", "flips", "growth", "spectrum", "trust",
]  # fmt: skip
#: Parts of a diagnosis by name; `edges` needs dozens of runs and must be requested by name.
PARTS = ("growth", "agreement", "flips", "trust", "spectrum", "detective", "scaling")
#: Two derivatives agree if they differ by less than this multiple of the amplified rounding error.
_ROUNDINGS = 1e4
#: A finite difference is accepted within this multiple of its own error estimate.
_ERRORS = 5.0


# --- all methods that apply, side by side -------------------------------------------------------------


@dataclass(frozen=True)
class Opinion:
    """The gradient computed by one method, or the reason why there is none."""

    method: str  # its name
    description: str  # which derivative it gives, one sentence
    found: Gradient | None  # the gradient; None where there is none
    missing: str = ""  # why: it does not apply, or it failed
    seconds: float = 0.0  # wall time, compiling included


@dataclass(frozen=True)
class GradientDifference:
    """Comparison of two derivatives with respect to one parameter, computed by two methods."""

    name: str  # full name of the parameter
    # method, reference: names of the two methods
    method: str
    reference: str
    size: float  # Euclidean norm of the reference's derivative (a scalar's magnitude)
    difference: float  # norm of the difference; signed (method minus reference) for a scalar
    relative: float  # |difference| over `size`; infinite where only the reference is 0
    # "agree", "missing saltation", "rounding", "truncation and noise", "events between shifts", "another
    # program", "an average", "statistical" or "unexplained"
    meaning: str
    values: dict[str, float] = field(default_factory=dict)  # the numbers that this rests on


@dataclass(frozen=True)
class Agreement:
    """Gradients of one run by several methods, compared with a reference method."""

    horizon: int  # steps
    reference: str  # name of the method that the others are compared with
    opinions: tuple[Opinion, ...]  # one for each method asked for
    # of every method that gave a gradient with the reference, by parameter
    comparisons: tuple[GradientDifference, ...]

    def gradient(self, method: str) -> Gradient | None:
        """Return the gradient of the method with this name, or None."""
        return next((one.found for one in self.opinions if one.method == method), None)


def agreement(
    problem: Problem,
    names: Sequence[str],
    methods: Sequence[str | Method] | None = None,
    *,
    known: Mapping[str, Gradient] | None = None,
    growth: float = 1.0,
    progress: Progress | None = None,
) -> Agreement:
    """Compute the gradient by several methods, and give a reason for each difference.

    Args:
        names: parameters; a method that does not support all of them is applied to those that it supports.
        methods: names or objects; all by default. A method that does not apply is listed with the reason.
        known: gradients already computed, by name of the method.
        growth: factor by which the gradient by the state grew over the run (`GradientGrowth.gain`).

    Raises:
        InputError: a parameter or method does not exist, or no method applies.
    """
    full = parameters.resolve(problem.simulation, names)
    known = dict(known or {})
    opinions = [
        Opinion(one.name, one.description, known[one.name])
        if one.name in known
        else _asked(one, problem, full, progress)
        for one in _methods(methods)
    ]
    given = [one.found for one in opinions if one.found is not None]
    if not given:
        reasons = "; ".join(f"{one.method}: {one.missing}" for one in opinions)
        raise InputError(f"no gradient method is applicable: {reasons}")
    # the method that leaves nothing out, where it is there
    order = ("event-aware", "symmetric") if problem.jumps else ("symmetric", "event-aware")
    there = {one.method: one for one in given}
    reference = next((word for word in (*order, "unrolled", "forward") if word in there), given[0].method)
    roundings = [unit_roundoff(problem.simulation.policy.dtype(role)) for role in ("state", "force")]
    rows = [
        compare(name, one, there[reference], max(roundings), growth, jumps=problem.jumps)
        for one in given
        if one.method != reference
        for name in full
        if name in one.gradient and name in there[reference].gradient
    ]
    return Agreement(problem.steps, reference, tuple(opinions), tuple(rows))


def _asked(method: Method, problem: Problem, names: Sequence[str], progress: Progress | None) -> Opinion:
    """Compute the gradient by one method, for all parameters that the method supports."""
    began = time.perf_counter()

    def report(done: int, steps: int, phase: str) -> None:
        if progress is not None:
            progress(done, steps, f"{method.name}: {phase}")

    why, found = method.reason_unavailable(problem, names), None
    left = [name for name in names if why is None or method.reason_unavailable(problem, [name]) is None]
    if left:
        try:
            found, why = method(problem, left, report), None
        except MdnumError as error:
            why = str(error)
    return Opinion(method.name, method.description, found, why or "", time.perf_counter() - began)


def compare(
    name: str, one: Gradient, reference: Gradient, unit: float, growth: float, *, jumps: bool
) -> GradientDifference:
    """Compare the derivatives with respect to one parameter that two methods computed.

    Args:
        unit: unit roundoff of the run's state or forces, whichever is coarser.
        growth: factor by which the gradient with respect to the state grew in the run; 1 if unknown.
        jumps: whether the force jumps at the cutoff.
    """
    a, b = (np.asarray(found.gradient[name], np.float64) for found in (one, reference))
    difference = float(a - b) if a.ndim == 0 else float(np.linalg.norm(a - b))
    size, right = float(np.maximum(np.linalg.norm(a), np.linalg.norm(b))), float(np.linalg.norm(b))
    relative = 0.0 if size == 0 else abs(difference) / size
    # of one run in other orders of evaluation, and where the forward passes differ by a rounding, too
    rounding = _ROUNDINGS * unit
    grown = min(rounding * max(growth, 1.0), 1.0)
    meaning, values = _meaning(name, one, reference, abs(difference), relative, rounding, grown, jumps)
    off = abs(difference) / right if right else float("inf") if difference else 0.0
    words = (name, one.method, reference.method)
    values = {"grown": growth, "explained": grown} if values is None else values
    return GradientDifference(*words, right, difference, off, meaning, values)


def _meaning(
    name: str, one: Gradient, reference: Gradient, size: float, relative: float, rounding: float,
    grown: float, jumps: bool,
) -> tuple[str, dict[str, float] | None]:  # fmt: skip
    """Return why two derivatives differ, and numbers that show the reason (or None)."""
    kinds = {one.kind: one, reference.kind: reference}
    if not np.isfinite(relative):
        return "unexplained", {}
    if relative <= rounding:
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
    if relative <= grown:
        return "rounding", None
    if "values" in kinds and len(kinds) == 2 and jumps:
        return "events between shifts", {}
    return "unexplained", None


# --- everything there is to know about one gradient, from as few runs as it takes ---------------------


@result
class GradientDiagnosis:
    """Analysis of the steps for which a gradient can be trusted.

    Attributes:
        horizon: number of steps. names: full names of the parameters. value: value of the loss.
        agreement, growth, spectrum, trust, flips, detective, scaling: results of the functions with these
            names.
        edges: parameter values at which decisions change, by parameter.
        notes: warnings about parameters, such as a loss without dependence on a parameter.
        failed: results that were requested and are not available, with the reason.
    """

    horizon: int
    names: tuple[str, ...]
    value: float
    agreement: Agreement | None = None
    growth: GradientGrowth | None = None
    spectrum: Spectrum | None = None
    trust: Trust | None = None
    flips: FlipTerms | None = None
    detective: NotFinite | None = None
    scaling: Scaling | None = None
    edges: dict[str, DecisionEdges] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)


def diagnose(
    problem: Problem,
    names: Sequence[str],
    *,
    parts: Sequence[str] = PARTS,
    methods: Sequence[str | Method] | None = None,
    edges_of: Sequence[str] = (),
    replicas: int = 0,
    half_step: bool = True,
    tolerance: float = TOLERANCE,
    format: str = "float16",
    progress: Progress | None = None,
) -> GradientDiagnosis:
    """Find the last step up to which a gradient can be trusted, and what contributes to the gradient.

    Args:
        names: parameters, full or short names. parts: which of PARTS to compute.
        methods: for the agreement; all that apply by default. The other parts use the reverse pass of
            event-aware, or of symmetric if only this method applies or was requested.
        edges_of: parameters whose nearest boundaries of decisions are searched for.
        replicas, half_step, tolerance: as for `trust`.
        format: narrow type that the cotangents are compared with.

    Returns:
        the available parts; `failed` holds the reasons why other parts are missing.

    Raises:
        InputError: a parameter, part or method does not exist. NumericalError: the run blew up.
    """
    full = parameters.resolve(problem.simulation, names)
    expect_known("part of a diagnosis", parts, PARTS)
    searched = parameters.resolve(problem.simulation, edges_of) if edges_of else ()
    chosen = _methods(methods)
    plain, why = _first(chosen, Symmetric), ""
    base: EventAware | Symmetric | None = None
    for one in filter(None, (_first(chosen, EventAware), plain)):
        reason = one.reason_unavailable(problem, full)
        if reason is None:
            base = one
            break
        why = why or reason
    made: ReversePass | None = None
    found: dict[str, Any] = {}
    failed: dict[str, str] = {}
    known: dict[str, Gradient] = {}
    growing: GradientGrowth | None = None
    near: Near | None = None
    saltation = isinstance(base, EventAware)
    if base is None:
        why = why or Symmetric().reason_unavailable(problem, full) or ""
        why = why or "it is read off a reverse pass, event-aware or symmetric, and neither was asked for"
        failed = {part: why for part in parts if part != "agreement"}
    else:
        growth_watch = GrowthWatch(problem.simulation, full, problem.steps)
        # its counts grow with the steps
        scaling = ScalingWatch(problem.steps, format) if "scaling" in parts else None
        if saltation and "trust" in parts and without_kick(problem.simulation.integrator) is None:
            near = Near(problem.simulation, pace_of(problem.loss, problem.steps))
        watches: list[Any] = [growth_watch, scaling, near and near.reverse]
        options: dict[str, Any] = {"guard": base.guard} if isinstance(base, EventAware) else {}
        made = passed(
            problem, full, saltation=saltation, budget=base.budget, watches=list(filter(None, watches)),
            progress=progress, **options,
        )  # fmt: skip
        known[base.name] = base.of(problem, made)
        if saltation and "agreement" in parts and plain is not None:
            # the same run, so that it need not be made twice
            again = passed(problem, full, saltation=False, tape=made.tape, progress=progress)
            known[plain.name] = plain.of(problem, again)
        growing = growth_watch.result(made.gradient)
        if "growth" in parts:
            found["growth"] = growing
        if scaling is not None:
            found["scaling"] = scaling.result()
        if not saltation and "flips" in parts:
            failed["flips"] = f"only event-aware has what flips add{f': {why}' if why else ''}"
    tape = None if made is None else made.tape
    grown = 1.0 if growing is None else growing.gain
    attempts: dict[str, Callable[[], Any]] = {
        "agreement": lambda: agreement(problem, full, chosen, known=known, growth=grown, progress=progress),
        "flips": lambda: flips(problem, full, made=made, progress=progress),
        "trust": lambda: trust(
            problem, full, tolerance=tolerance, saltation=saltation, replicas=replicas, half_step=half_step,
            made=made, near=near, growth=growing, progress=progress,
        ),
        "spectrum": lambda: spectrum(problem, tape=tape, progress=progress),
        "detective": lambda: detective(problem, full, saltation=saltation, tape=tape, progress=progress),
    }  # fmt: skip
    around: dict[str, DecisionEdges] = {}

    def attempt(label: str, make: Callable[[], Any], into: dict[str, Any], name: str) -> None:
        try:
            into[name] = make()
        except MdnumError as error:
            failed[label] = str(error)

    for part, make in attempts.items():
        if part in parts and part not in failed:
            attempt(part, make, found, part)
    for name in searched:
        attempt(f"edges of {name}", lambda name=name: edges(problem, name, progress=progress), around, name)
    opinions = found["agreement"].opinions if "agreement" in found else ()
    values = [one.found.value for one in opinions if one.found is not None]
    whole = tape.value if tape is not None else values[0] if values else problem.value()
    notes = {} if base is None else known[base.name].notes
    return GradientDiagnosis(problem.steps, full, whole, edges=around, notes=notes, failed=failed, **found)


def _methods(asked: Sequence[str | Method] | None) -> list[Method]:
    """Convert names of gradient methods to objects. None means all methods."""
    return [by_name(one) if isinstance(one, str) else one for one in (METHODS if asked is None else asked)]


def _first(methods: Sequence[Method], kind: type) -> Any:
    return next((one for one in methods if isinstance(one, kind)), None)
