"""Which methods `mdnum grad` runs: those asked for, or those that answer soon; and running them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.diagnose.detective import detective
from mdnum.gradients.diagnose.diagnose import diagnose
from mdnum.gradients.differences import FiniteDifferences
from mdnum.gradients.ensemble import Ensemble
from mdnum.gradients.registry import METHODS, by_word
from mdnum.gradients.smoothed import SmoothedDifferences
from mdnum.workflow.fork_question import Progress

if TYPE_CHECKING:
    from mdnum.gradients.base import Method, Problem
    from mdnum.gradients.diagnose import Diagnosis

#: Runs every method that applies.
ALL = "all"
#: How to ask for what does not apply.
NEVER = ""
#: Atoms times steps that are run for differences where nothing was said about methods: some 6 s.
AFFORDABLE = 6_000_000
#: Parts of a diagnosis that are always had; those that are asked for, and what each is.
_PARTS = ("agreement", "growth", "flips", "trust")
EDGES = "edges"
ALSO: Mapping[str, str] = {
    "spectrum": "how far the directions that stretch most have stretched",
    EDGES: "the nearest other histories on either side of each parameter, some dozens of runs",
    "scaling": "whether the reverse pass would fit float16",
}
#: What is tried where nothing was said about methods.
_QUICK = ("event-aware", "symmetric", "finite-differences")


@dataclass(frozen=True)
class Plan:
    """What is run.

    Attributes:
        methods: in this order.
        left_out: what was not asked for and not run: what, why, and how to ask.
    """

    methods: tuple[Method, ...]
    left_out: tuple[dict[str, str], ...] = ()


def plan(problem: Problem, names: Sequence[str], asked: Sequence[str] | None, replicas: int = 0) -> Plan:
    """The methods to run.

    Args:
        problem: of what.
        names: full names of the parameters.
        asked: words; None for those that answer soon.
        replicas: starts of averages; 0 for their own number, and for no average where nothing was asked.

    Raises:
        InputError: no such method.
    """
    if asked is not None:
        words = METHODS if ALL in asked else asked
        return Plan(tuple(_over(by_word(word), replicas) for word in words))
    quick = (*_QUICK, "ensemble") if replicas else _QUICK
    apply: list[Method] = []
    left: list[dict[str, str]] = []
    for word, make in METHODS.items():
        method = make()
        # by some of the parameters is enough
        reasons = [method.why_not(problem, [name]) for name in names]
        if None not in reasons:
            left.append({"what": word, "why": reasons[0] or "", "how": NEVER})
        elif (why := _too_long(word, method, problem, reasons.count(None), quick)) is not None:
            left.append({"what": word, "why": why, "how": f"--methods {word}"})
        else:
            apply.append(_over(method, replicas, horizons=False))
    return Plan(tuple(apply), tuple(left))


def _too_long(word: str, method: Method, problem: Problem, names: int, quick: Sequence[str]) -> str | None:
    """Why a method is not run where nothing was said about methods."""
    if word not in quick:
        return method.says
    if isinstance(method, FiniteDifferences):
        runs = method.runs * names + 1
        if runs * problem.simulation.atoms * problem.steps > AFFORDABLE:
            return f"about {runs} more runs of {problem.steps:,} steps"
    return None


def _over(method: Method, replicas: int, horizons: bool = True) -> Method:
    """A method that averages over starts, over so many of them; other methods as they are.

    Args:
        horizons: whether it looks at shorter runs too.
    """
    if not replicas or not isinstance(method, Ensemble | SmoothedDifferences):
        return method
    changed = replace(method, replicas=replace(method.replicas, count=replicas))
    return replace(changed, halvings=0) if isinstance(changed, Ensemble) and not horizons else changed


def run(
    plan: Plan,
    problem: Problem,
    names: Sequence[str],
    progress: Progress,
    replicas: int = 0,
    also: Sequence[str] = (),
    half_step: bool = True,
) -> Diagnosis:
    """Every method of a plan, how the gradient grows, what flips add, and how far it is trusted.

    Args:
        plan: the methods.
        problem: of what.
        names: full names of the parameters.
        progress: called with what is done, of how much, and a dictionary with the phase.
        replicas: starts for the standard error; 0 leaves it out.
        also: further parts, words of `ALSO`.
        half_step: make the gradient at half the time step too, where trust is told.

    Raises:
        InputError: no method applies, with the reason of each. NumericalError: the run blew up.
    """
    where = problem.simulation.system.name
    if not plan.methods:
        reasons = "; ".join(f"{one['what']}: {one['why']}" for one in plan.left_out)
        raise InputError(f"no method applies: {reasons}", where=where, remedy="Ask for one with --methods")
    parts = (*_PARTS, *(word for word in also if word != EDGES))
    scalars = [name for name in names if not np.ndim(parameters.value(problem.simulation, name))]

    def tell(done: int, of: int, phase: str) -> None:
        unit = "runs" if phase.endswith(("differences", "replicas")) else "steps"
        info: dict[str, Any] = {"phase": phase, "unit": unit}
        progress(done, of, info)

    found = diagnose(
        problem, names, parts=parts, methods=plan.methods, edges_of=scalars if EDGES in also else (),
        replicas=replicas, half_step=half_step, progress=tell,
    )  # fmt: skip
    if found.agreement is None:
        raise InputError(found.failed["agreement"], where=where)
    reference = found.agreement.gradient(found.agreement.reference)
    assert reference is not None
    if found.growth is not None and not all(np.isfinite(one).all() for one in reference.gradient.values()):
        aware = reference.method == "event-aware"
        return replace(found, not_finite=detective(problem, names, saltation=aware, progress=tell))
    return found


def further(words: Sequence[str]) -> tuple[str, ...]:
    """The further parts that words ask for.

    Raises:
        InputError: no such part.
    """
    unknown = [word for word in words if word not in (*ALSO, ALL)]
    if unknown:
        raise InputError(f"no part {unknown[0]!r} of a diagnosis", remedy=f"There are {', '.join(ALSO)}")
    return tuple(ALSO) if ALL in words else tuple(words)


def not_asked(also: Sequence[str], found: Diagnosis) -> list[dict[str, str]]:
    """Parts of the diagnosis that are not there: what, why, and how to ask."""
    left = [
        {"what": word, "why": about, "how": f"--also {word}"}
        for word, about in ALSO.items()
        if word not in also
    ]
    return [
        *left,
        *({"what": part, "why": why, "how": NEVER} for part, why in found.failed.items()),
    ]
