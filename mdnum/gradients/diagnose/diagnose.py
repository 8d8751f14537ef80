"""Everything there is to know about one gradient, from as few runs as it takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from mdnum.errors import InputError, MdnumError
from mdnum.gradients import parameters
from mdnum.gradients.base import Gradient, Method, Problem, Progress, independent
from mdnum.gradients.diagnose.agreement import agreement
from mdnum.gradients.diagnose.detective import detective
from mdnum.gradients.diagnose.edges import edges
from mdnum.gradients.diagnose.flips import flips, sentence
from mdnum.gradients.diagnose.growth import GrowthWatch, gain
from mdnum.gradients.diagnose.near import Near
from mdnum.gradients.diagnose.passes import Passed, passed
from mdnum.gradients.diagnose.results import Diagnosis, Growth
from mdnum.gradients.diagnose.scaling import ScalingWatch
from mdnum.gradients.diagnose.spectrum import spectrum
from mdnum.gradients.diagnose.trust import TOLERANCE, trust
from mdnum.gradients.registry import METHODS, by_word
from mdnum.gradients.symmetric import GUARD, EventAware, Symmetric, aware
from mdnum.gradients.tape import pace_of

#: Parts of a diagnosis by their words; `edges` takes some dozens of runs and is asked for by name.
PARTS = ("growth", "agreement", "flips", "trust", "spectrum", "detective", "scaling")


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
    budget: int = 2**29,
    progress: Progress | None = None,
) -> Diagnosis:
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
        tolerance: relative difference of two precisions that is put up with.
        format: narrow type that the cotangents are held against.
        budget: bytes of the recorded run that are kept.
        progress: called with the steps done, all steps, and a phase in words.

    Returns:
        the parts that could be had; `failed` says why others could not.

    Raises:
        InputError: no such parameter, part or method. NumericalError: the run blew up.
    """
    full = parameters.resolve(problem.simulation, names)
    unknown = [part for part in parts if part not in PARTS]
    if unknown:
        raise InputError(f"no part {unknown[0]!r} of a diagnosis", remedy=f"There are {', '.join(PARTS)}")
    searched = parameters.resolve(problem.simulation, edges_of) if edges_of else ()
    base, why = _base(problem, full, methods, budget)
    made: Passed | None = None
    found: dict[str, Any] = {}
    failed: dict[str, str] = {}
    notes: dict[str, str] = {}
    known: dict[str, Gradient] = {}
    growing: Growth | None = None
    near: Near | None = None
    saltation = isinstance(base, EventAware)
    if base is not None:
        growth_watch = GrowthWatch(problem.simulation, full, problem.steps)
        # its counts grow with the steps
        scaling_watch = ScalingWatch(problem.steps, format) if "scaling" in parts else None
        if saltation and "trust" in parts:
            near = Near(problem.simulation, pace_of(problem.loss, problem.steps))
        made = passed(
            problem,
            full,
            saltation=saltation,
            guard=base.guard if isinstance(base, EventAware) else GUARD,
            budget=budget,
            watches=[
                growth_watch,
                *([] if scaling_watch is None else [scaling_watch]),
                *([] if near is None else [near.reverse]),
            ],
            progress=progress,
        )
        known[base.name] = _as_method(base, problem, made)
        notes = known[base.name].notes
        plain = _asked(methods, Symmetric)
        if saltation and "agreement" in parts and plain is not None:
            # the same run, so that it need not be made twice
            again = passed(problem, full, saltation=False, tape=made.tape, progress=progress)
            known[plain.name] = _as_method(plain, problem, again)
        growing = growth_watch.result(made.gradient)
        if "growth" in parts:
            found["growth"] = growing
        if scaling_watch is not None:
            found["scaling"] = scaling_watch.result()
        if not saltation and "flips" in parts:
            failed["flips"] = f"only event-aware knows what flips add{f': {why}' if why else ''}"
    else:
        failed = {part: why for part in parts if part != "agreement"}

    def attempt(part: str, make: Callable[[], Any]) -> None:
        if part not in parts or part in failed:
            return
        try:
            found[part] = make()
        except MdnumError as error:
            failed[part] = str(error)

    grown = 1.0 if growing is None else gain(growing)
    attempt(
        "agreement",
        lambda: agreement(problem, full, methods, known=known, growth=grown, progress=progress),
    )
    attempt("flips", lambda: flips(problem, full, made=made, progress=progress))
    attempt(
        "trust",
        lambda: trust(
            problem,
            full,
            tolerance=tolerance,
            saltation=saltation,
            replicas=replicas,
            half_step=half_step,
            budget=budget,
            made=made,
            near=near,
            growth=growing,
            progress=progress,
        ),
    )
    if "flips" in found and "trust" in found:
        found["flips"] = replace(found["flips"], says=sentence(found["flips"], found["trust"].digits))
    attempt(
        "spectrum", lambda: spectrum(problem, tape=None if made is None else made.tape, progress=progress)
    )
    attempt(
        "detective",
        lambda: detective(
            problem,
            full,
            saltation=saltation,
            tape=None if made is None else made.tape,
            progress=progress,
        ),
    )
    around = {}
    for name in searched:
        try:
            around[name] = edges(problem, name, progress=progress)
        except MdnumError as error:
            failed[f"edges of {name}"] = str(error)
    first = found["agreement"].opinions if "agreement" in found else ()
    values = [one.found.value for one in first if one.found is not None]
    whole = made.tape.value if made is not None else values[0] if values else problem.value()
    return Diagnosis(
        problem.steps,
        full,
        whole,
        found.get("agreement"),
        found.get("growth"),
        found.get("spectrum"),
        found.get("trust"),
        found.get("flips"),
        around,
        found.get("detective"),
        found.get("scaling"),
        notes,
        failed,
    )


def _asked(methods: Sequence[str | Method] | None, kind: type) -> Any:
    """The method of a kind among those asked for, as an object; None where it was not asked for."""
    for one in METHODS if methods is None else methods:
        method = by_word(one) if isinstance(one, str) else one
        if isinstance(method, kind):
            return method
    return None


def _base(
    problem: Problem, names: Sequence[str], methods: Sequence[str | Method] | None, budget: int
) -> tuple[EventAware | Symmetric | None, str]:
    """The method whose reverse pass everything is read off, and why it is not event-aware."""
    why = ""
    for kind in (EventAware, Symmetric):
        method = _asked(methods, kind)
        if method is not None:
            reason = method.why_not(problem, names)
            if reason is None:
                return replace(method, budget=budget), why
            why = why or reason
    return None, why or "it is read off a reverse pass, event-aware or symmetric, and neither was asked for"


def _as_method(method: EventAware | Symmetric, problem: Problem, made: Passed) -> Gradient:
    """What the method itself would say of this pass."""
    if isinstance(method, EventAware):
        notes, details = aware(problem, made.tape, made.gradient, made.guard, made.crossings)
    else:
        details = {"stretches": len(made.tape), "made again": made.tape.replayed}
        notes = independent(problem, made.gradient, saltation=False)
    return Gradient(method.name, method.says, made.tape.value, made.gradient, notes, details)
