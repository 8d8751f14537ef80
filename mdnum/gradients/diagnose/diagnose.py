"""Everything there is to know about one gradient, from as few runs as it takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mdnum.errors import InputError, MdnumError
from mdnum.gradients import parameters
from mdnum.gradients.base import Gradient, Method, Problem, Progress, independent
from mdnum.gradients.diagnose.agreement import agreement
from mdnum.gradients.diagnose.detective import detective
from mdnum.gradients.diagnose.edges import edges
from mdnum.gradients.diagnose.flips import flips
from mdnum.gradients.diagnose.growth import GrowthWatch
from mdnum.gradients.diagnose.passes import Passed, passed
from mdnum.gradients.diagnose.results import Diagnosis, Growth
from mdnum.gradients.diagnose.scaling import ScalingWatch
from mdnum.gradients.diagnose.spectrum import spectrum
from mdnum.gradients.diagnose.trust import TOLERANCE, trust
from mdnum.gradients.symmetric import EventAware, weights

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
        methods: for the agreement; default all that apply.
        edges_of: parameters whose nearest boundaries of decisions are searched for.
        replicas: starts for the standard error in the trust horizon; 0 leaves it out.
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
    aware = EventAware(budget=budget)
    why = aware.why_not(problem, full)
    made: Passed | None = None
    found: dict[str, Any] = {}
    failed: dict[str, str] = {}
    notes: dict[str, str] = {}
    known: dict[str, Gradient] = {}
    growing: Growth | None = None
    if why is None:
        growth_watch = GrowthWatch(problem.simulation, full, problem.steps)
        scaling_watch = ScalingWatch(problem.steps, format)
        made = passed(problem, full, budget=budget, watches=[growth_watch, scaling_watch], progress=progress)
        notes = independent(problem, made.gradient, saltation=True)
        details = {"guard": made.guard, **weights(made.crossings)}
        value = made.tape.value
        known["event-aware"] = Gradient(aware.name, aware.says, value, made.gradient, notes, details)
        growing = growth_watch.result(made.gradient)
        if "growth" in parts:
            found["growth"] = growing
        if "scaling" in parts:
            found["scaling"] = scaling_watch.result()
    else:
        failed = {part: why for part in parts if part != "agreement"}

    def attempt(part: str, make: Callable[[], Any]) -> None:
        if part not in parts or part in failed:
            return
        try:
            found[part] = make()
        except MdnumError as error:
            failed[part] = str(error)

    gain = 1.0 if growing is None else _gain(growing)
    attempt(
        "agreement",
        lambda: agreement(problem, full, methods, known=known, growth=gain, progress=progress),
    )
    attempt("flips", lambda: flips(problem, full, made=made, progress=progress))
    attempt(
        "trust",
        lambda: trust(
            problem, full, tolerance=tolerance, replicas=replicas, budget=budget, progress=progress
        ),
    )
    attempt(
        "spectrum", lambda: spectrum(problem, tape=None if made is None else made.tape, progress=progress)
    )
    attempt(
        "detective",
        lambda: detective(problem, full, tape=None if made is None else made.tape, progress=progress),
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


def _gain(growing: Growth) -> float:
    """How much the gradient by the state grew, from the first horizon that has one."""
    there = growing.size[np.isfinite(growing.size) & (growing.size > 0)]
    return float(there.max() / there[0]) if len(there) else 1.0
