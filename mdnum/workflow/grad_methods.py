"""Which methods `mdnum grad` runs: those asked for, or those that answer soon; and running them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.gradients.base import Gradient, independent
from mdnum.gradients.diagnose.agreement import agreement
from mdnum.gradients.diagnose.flips import flips
from mdnum.gradients.diagnose.growth import GrowthWatch
from mdnum.gradients.diagnose.passes import Passed, passed
from mdnum.gradients.diagnose.trust import trust
from mdnum.gradients.differences import FiniteDifferences
from mdnum.gradients.ensemble import Ensemble
from mdnum.gradients.registry import METHODS, by_word
from mdnum.gradients.smoothed import SmoothedDifferences
from mdnum.gradients.symmetric import GUARD, EventAware, Symmetric, weights
from mdnum.workflow.fork_question import Progress

if TYPE_CHECKING:
    from mdnum.gradients.base import Method, Problem
    from mdnum.gradients.diagnose import Agreement, Flips, Growth, Trust

#: Runs every method that applies.
ALL = "all"
#: Atoms times steps that are run for differences where nothing was said about methods: some 6 s.
AFFORDABLE = 6_000_000
#: Shifts of finite differences where nothing was said about methods.
_LEVELS = 2
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


@dataclass(frozen=True)
class Found:
    """What the methods gave.

    Attributes:
        agreement: every method and what their differences mean.
        growth: of the gradient with the horizon; None where there was no reverse pass to watch.
        flips: what each of them adds; None where there was no such pass, or no number to add to.
        trust: how far the gradient means something; None where nothing can tell.
        failed: further parts that could not be had: what, why, and how to ask otherwise.
    """

    agreement: Agreement
    growth: Growth | None
    flips: Flips | None
    trust: Trust | None
    failed: tuple[dict[str, str], ...] = ()


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
        method = FiniteDifferences(levels=_LEVELS) if word == "finite-differences" else make()
        # by some of the parameters is enough
        reasons = [method.why_not(problem, [name]) for name in names]
        if None not in reasons:
            left.append({"what": word, "why": reasons[0] or "", "how": "does not apply"})
        elif (why := _too_long(word, method, problem, reasons.count(None), quick)) is not None:
            left.append({"what": word, "why": why, "how": f"--methods {word}, or --methods all"})
        else:
            apply.append(_over(method, replicas, horizons=False))
    return Plan(tuple(apply), tuple(left))


def _too_long(word: str, method: Method, problem: Problem, names: int, quick: Sequence[str]) -> str | None:
    """Why a method is not run where nothing was said about methods."""
    if word not in quick:
        return method.says
    runs = 2 * _LEVELS * names + 1
    if word == "finite-differences" and runs * problem.simulation.atoms * problem.steps > AFFORDABLE:
        return f"{runs} more runs of {problem.steps:,} steps"
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


def run(plan: Plan, problem: Problem, names: Sequence[str], progress: Progress, replicas: int = 0) -> Found:
    """Every method of a plan, how the gradient grows, what flips add, and how far it is trusted.

    Args:
        plan: the methods.
        problem: of what.
        names: full names of the parameters.
        progress: called with what is done, of how much, and a dictionary with the phase.
        replicas: starts for the standard error; 0 leaves it out.

    Raises:
        InputError: no method applies, with the reason of each. NumericalError: the run blew up.
    """
    if not plan.methods:
        reasons = "; ".join(f"{one['what']}: {one['why']}" for one in plan.left_out)
        raise InputError(
            f"no method applies: {reasons}",
            where=problem.simulation.system.name,
            remedy="Ask for one with --methods",
        )
    known: dict[str, Gradient] = {}
    growth, added, trusted = None, None, None
    failed: list[dict[str, str]] = []

    def attempt(what: str, part: Callable[[], Any]) -> Any:
        try:
            return part()
        except InputError as error:
            failed.append({"what": what, "why": error.message, "how": error.remedy or ""})
            return None

    base = _base(plan.methods, problem, names)
    if base is not None:
        aware = isinstance(base, EventAware)
        watch = GrowthWatch(problem.simulation, names, problem.steps)
        made = passed(
            problem,
            names,
            saltation=aware,
            guard=base.guard if isinstance(base, EventAware) else GUARD,
            watches=[watch],
            progress=_phases(progress, f"{base.name}: "),
        )
        growth = watch.result(made.gradient)
        known[base.name] = _as_method(base, problem, made)
        plain = next((one for one in plan.methods if isinstance(one, Symmetric)), None)
        if aware and plain is not None:
            # the same run, so that it need not be made twice
            again = passed(
                problem, names, saltation=False, tape=made.tape, progress=_phases(progress, "symmetric: ")
            )
            known[plain.name] = _as_method(plain, problem, again)
        if aware:
            added = attempt(
                "contributions of flips",
                lambda: flips(problem, names, made=made, progress=_phases(progress, "flips: ")),
            )
        trusted = attempt(
            "the trust horizon",
            lambda: trust(
                problem, names, saltation=aware, replicas=replicas, progress=_phases(progress, "trust: ")
            ),
        )
    found = agreement(
        problem,
        names,
        plan.methods,
        known=known,
        growth=1.0 if growth is None else _gain(growth),
        progress=_phases(progress),
    )
    return Found(found, growth, added, trusted, tuple(failed))


def _base(methods: Sequence[Method], problem: Problem, names: Sequence[str]) -> EventAware | Symmetric | None:
    """The method whose reverse pass growth and trust are read off; None where none of these is asked for."""
    for kind in (EventAware, Symmetric):
        for one in methods:
            if isinstance(one, kind) and one.why_not(problem, names) is None:
                return one
    return None


def _as_method(method: EventAware | Symmetric, problem: Problem, made: Passed) -> Gradient:
    """What the method itself would say of this pass."""
    aware = isinstance(method, EventAware)
    if aware:
        details = {"guard": made.guard, **weights(made.crossings)}
    else:
        details = {"stretches": len(made.tape), "made again": made.tape.replayed}
    notes = independent(problem, made.gradient, saltation=aware)
    return Gradient(method.name, method.says, made.tape.value, made.gradient, notes, details)


def _gain(growth: Growth) -> float:
    """How much the gradient by the state grew over the run."""
    seen = growth.size[np.isfinite(growth.size) & (growth.size > 0)]
    return float(seen[-1] / seen[0]) if len(seen) else 1.0


def _phases(progress: Progress, part: str = "") -> Callable[[int, int, str], None]:
    """What a method reports, as a rollout would."""

    def tell(done: int, of: int, phase: str) -> None:
        unit = "runs" if phase.endswith(("differences", "replicas")) else "steps"
        info: dict[str, Any] = {"phase": f"{part}{phase}", "unit": unit}
        progress(done, of, info)

    return tell
