"""Everything there is to know about one gradient, from as few runs as it takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from mdnum.errors import InputError, MdnumError
from mdnum.gradients import parameters
from mdnum.gradients.diagnose.agreement import Agreement, agreement
from mdnum.gradients.diagnose.detective import NotFinite, detective
from mdnum.gradients.diagnose.edges import DecisionEdges, edges
from mdnum.gradients.diagnose.flips import FlipTerms, flips
from mdnum.gradients.diagnose.growth import GradientGrowth, GrowthWatch, Scaling, ScalingWatch
from mdnum.gradients.diagnose.near import Near
from mdnum.gradients.diagnose.spectrum import Spectrum, spectrum
from mdnum.gradients.diagnose.trust import TOLERANCE, Trust, trust
from mdnum.gradients.problem import METHODS, Gradient, Method, Problem, Progress
from mdnum.gradients.problem import method as by_name
from mdnum.gradients.recorded import EventAware, ReversePass, Symmetric, passed
from mdnum.gradients.tape import pace_of

#: Parts of a diagnosis by their words; `edges` takes some dozens of runs and is asked for by name.
PARTS = ("growth", "agreement", "flips", "trust", "spectrum", "detective", "scaling")


@dataclass(frozen=True)
class GradientDiagnosis:
    """Whether a gradient can be trusted, and how far. A part that was not asked for is None.

    Attributes:
        horizon: steps.
        names: full names of the parameters.
        value: the loss.
        agreement, growth, spectrum, trust, flips, detective, scaling: see there.
        edges: by parameter.
        notes: what a reader must know about single parameters: no dependence, a missing term.
        failed: parts that were asked for and are not available, with the reason.
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
    """Whether a gradient can be trusted, how far, and what it is made of.

    Args:
        problem: the loss of a rollout.
        names: parameters, full or short names.
        parts: which of PARTS.
        methods: for the agreement; default all that apply. The other parts are read off the reverse pass of
            event-aware, or of symmetric where only that applies or is asked for.
        edges_of: parameters whose nearest boundaries of decisions are searched for.
        replicas: starts for the standard error in the trust horizon; 0 leaves it out.
        half_step: make the run and its gradient at half the time step too; else nothing is called trusted.
        tolerance: relative difference of two precisions that is acceptable.
        format: narrow type that the cotangents are compared with.
        progress: called with the steps done, all steps, and the name of the phase.

    Returns:
        the parts that are available; `failed` has why others are not.

    Raises:
        InputError: no such parameter, part or method. NumericalError: the run blew up.
    """
    full = parameters.resolve(problem.simulation, names)
    unknown = [part for part in parts if part not in PARTS]
    if unknown:
        raise InputError(f"no part {unknown[0]!r} of a diagnosis", remedy=f"There are {', '.join(PARTS)}")
    searched = parameters.resolve(problem.simulation, edges_of) if edges_of else ()
    chosen = [
        by_name(one) if isinstance(one, str) else one for one in (METHODS if methods is None else methods)
    ]
    base, why = _base(problem, full, chosen)
    made: ReversePass | None = None
    found: dict[str, Any] = {}
    failed: dict[str, str] = {}
    known: dict[str, Gradient] = {}
    growing: GradientGrowth | None = None
    near: Near | None = None
    saltation = isinstance(base, EventAware)
    if base is None:
        failed = {part: why for part in parts if part != "agreement"}
    else:
        growth_watch = GrowthWatch(problem.simulation, full, problem.steps)
        watches: list[Any] = [growth_watch]
        if "scaling" in parts:
            # its counts grow with the steps
            watches.append(ScalingWatch(problem.steps, format))
        if saltation and "trust" in parts:
            near = Near(problem.simulation, pace_of(problem.loss, problem.steps))
            watches.append(near.reverse)
        options: dict[str, Any] = {"guard": base.guard} if isinstance(base, EventAware) else {}
        made = passed(
            problem,
            full,
            saltation=saltation,
            budget=base.budget,
            watches=watches,
            progress=progress,
            **options,
        )
        known[base.name] = base.of(problem, made)
        plain = _first(chosen, Symmetric)
        if saltation and "agreement" in parts and plain is not None:
            # the same run, so that it need not be made twice
            again = passed(problem, full, saltation=False, tape=made.tape, progress=progress)
            known[plain.name] = plain.of(problem, again)
        growing = growth_watch.result(made.gradient)
        if "growth" in parts:
            found["growth"] = growing
        if "scaling" in parts:
            found["scaling"] = watches[1].result()
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


def _first(methods: Sequence[Method], kind: type) -> Any:
    return next((one for one in methods if isinstance(one, kind)), None)


def _base(
    problem: Problem, names: Sequence[str], methods: Sequence[Method]
) -> tuple[EventAware | Symmetric | None, str]:
    """The method whose reverse pass everything is read off, and why it is not event-aware."""
    why = ""
    for method in (_first(methods, EventAware), _first(methods, Symmetric)):
        if method is not None:
            reason = method.reason_unavailable(problem, names)
            if reason is None:
                return method, why
            why = why or reason
    return None, why or "it is read off a reverse pass, event-aware or symmetric, and neither was asked for"
