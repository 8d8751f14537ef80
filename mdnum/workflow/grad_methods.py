"""Which methods `mdnum grad` runs: those asked for, or those that answer soon; and running them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError, NumericalError
from mdnum.gradients.diagnose import Agreement, Comparison, Opinion
from mdnum.gradients.differences import FiniteDifferences
from mdnum.gradients.registry import METHODS, by_word
from mdnum.workflow.fork_question import Progress

if TYPE_CHECKING:
    from mdnum.gradients.base import Method, Problem

#: Runs every method that applies.
ALL = "all"
#: Atoms times steps that are run beside the reverse passes where nothing was said about methods: some 20 s.
AFFORDABLE = 20_000_000
#: Shifts of finite differences where nothing was said about methods.
_LEVELS = 2
#: What is tried where nothing was said about methods.
_QUICK = ("event-aware", "symmetric", "unrolled", "finite-differences")


@dataclass(frozen=True)
class Plan:
    """What is run.

    Attributes:
        methods: in this order.
        refused: those asked for that do not apply: method and why.
        left_out: what was not asked for and not run: what, why, and how to ask.
    """

    methods: tuple[Method, ...]
    refused: tuple[dict[str, str], ...] = ()
    left_out: tuple[dict[str, str], ...] = ()


def plan(problem: Problem, names: Sequence[str], asked: Sequence[str] | None) -> Plan:
    """The methods to run.

    Args:
        problem: of what.
        names: full names of the parameters.
        asked: words; None for those that answer soon.

    Raises:
        InputError: no such method, or none applies.
    """
    if asked is None:
        return _quick(problem, names)
    chosen = [by_word(word) for word in (METHODS if ALL in asked else asked) if word != ALL]
    apply, refused = [], []
    for method in chosen:
        why = method.why_not(problem, names)
        if why is None:
            apply.append(method)
        else:
            refused.append({"method": method.name, "why": why})
    if not apply:
        reasons = "; ".join(f"{one['method']}: {one['why']}" for one in refused)
        raise InputError(
            f"no method applies: {reasons}",
            where=problem.simulation.system.name,
            remedy=f"There are {', '.join(METHODS)}",
        )
    return Plan(tuple(apply), tuple(refused))


def _quick(problem: Problem, names: Sequence[str]) -> Plan:
    """Reverse passes, and differences where they are soon made."""
    apply, left, refused = [], [], []
    for word, make in METHODS.items():
        method = FiniteDifferences(levels=_LEVELS) if word == "finite-differences" else make()
        why = method.why_not(problem, names)
        if why is not None:
            refused.append(f"{word}: {why}")
            continue
        if word not in _QUICK:
            left.append({"what": word, "why": "another opinion, not made by default", "how": _ask(word)})
            continue
        if word == "finite-differences":
            runs = 2 * _LEVELS * len(names) + 1
            cost = runs * problem.simulation.atoms * problem.steps
            if cost > AFFORDABLE:
                why = f"{runs} more runs of {problem.steps:,} steps"
                left.append({"what": word, "why": why, "how": _ask(word)})
                continue
        apply.append(method)
    if not apply:
        raise InputError(f"no method applies: {'; '.join(refused)}", where=problem.simulation.system.name)
    return Plan(tuple(apply), left_out=tuple(left))


def _ask(word: str) -> str:
    return f"--methods {word}, or --methods all"


def run(plan: Plan, problem: Problem, names: Sequence[str], progress: Progress) -> tuple[Opinion, ...]:
    """Every method of a plan; one that fails says why.

    Raises:
        InputError, NumericalError: the last method's own, where none gave a gradient.
    """
    opinions: list[Opinion] = []
    last: InputError | NumericalError | None = None
    for method in plan.methods:
        progress(0, 0, {"phase": method.name})
        began = time.perf_counter()
        found, missing = None, ""
        try:
            found = method(problem, names, progress=_phases(progress, method.name))
        except (InputError, NumericalError) as error:
            # another way may exist where this one fails
            missing, last = str(error), error
        opinions.append(Opinion(method.name, method.says, found, missing, time.perf_counter() - began))
    if last is not None and not any(one.found for one in opinions):
        raise last
    return tuple(opinions)


def _phases(progress: Progress, method: str) -> Callable[[int, int, str], None]:
    """What a method reports, as a rollout would."""

    def tell(done: int, of: int, phase: str) -> None:
        unit = "runs" if phase == "differences" else "steps"
        info: dict[str, Any] = {"phase": f"{method}: {phase}", "unit": unit}
        progress(done, of, info)

    return tell


def compare(problem: Problem, opinions: Sequence[Opinion]) -> Agreement:
    """What the methods found against one of them: the derivative of the flow, where there is one."""
    found = {one.method: one.found for one in opinions if one.found is not None}
    reference = "event-aware" if "event-aware" in found else next(iter(found))
    base = found[reference].gradient
    rows = []
    for method, one in found.items():
        if method == reference:
            continue
        for name, value in one.gradient.items():
            apart = np.ravel(value - base[name])
            size, other = (float(np.linalg.norm(np.ravel(each))) for each in (base[name], value))
            difference = float(apart[0]) if len(apart) == 1 else float(np.linalg.norm(apart))
            largest = max(size, other)
            relative = abs(difference) / largest if largest else 0.0
            rows.append(Comparison(name, method, reference, size, difference, relative, "", ""))
    return Agreement(problem.steps, reference, tuple(opinions), tuple(rows))
