"""Conclusion of an audit: is it safe to run and to differentiate the calculator?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from mdnum.audit.base import CheckResult
from mdnum.audit.causes import cause
from mdnum.audit.checks import CHECKS

Answer = Literal["yes", "as far as tested", "with care", "no", "not tested"]
_NEARLY = 0.9  # of the ways of a check: from here on it counts as asked
_FAR_BELOW = 0.1  # of the share of the forces that is wrong: a curl that would be seen of this is absent
_QUESTIONS = ("run", "differentiate")


def in_order(names: Sequence[str]) -> list[str]:
    """Return the names of checks in the order in which the checks run."""
    return sorted(names, key=lambda name: (CHECKS[name].order, name))


def needed_to(question: str) -> set[str]:
    """Return the checks that are required to answer a question ("run" or "differentiate")."""
    return {name for name in CHECKS if question in CHECKS[name].needed_to}


def answers(results: Sequence[CheckResult], wanted: Sequence[str]) -> Mapping[str, Answer]:
    """Answer whether it is safe to run and to differentiate a calculator."""
    return {question: _answer(question, results, wanted) for question in _QUESTIONS}


def _answer(question: str, results: Sequence[CheckResult], wanted: Sequence[str]) -> Answer:
    found = [one for result in results for one in result.findings if cause(one.code).spares != question]
    severities = {one.severity for one in found}
    if "error" in severities:
        return "no"
    if "warning" in severities:
        return "with care"
    needed, begun = needed_to(question), _begun(results)
    if not needed <= set(wanted) or not {name for name in needed if CHECKS[name].basic} <= begun:
        return "not tested"
    asked = {result.name for result in results if not largely_unasked(result)}
    return "yes" if needed <= asked else "as far as tested"


def largely_unasked(result: CheckResult) -> bool:
    """Return whether a check reached its time limit before most of its test cases."""
    return result.asked < _NEARLY * result.possible


def nothing_felt(results: Sequence[CheckResult]) -> bool:
    """Return whether no atoms interact. The audit is then meaningless."""
    return any(result.numbers.get("nothing_felt") for result in results)


def _begun(results: Sequence[CheckResult]) -> set[str]:
    return set() if nothing_felt(results) else {result.name for result in results}


def to_come(results: Sequence[CheckResult], wanted: Sequence[str]) -> bool:
    """Return whether the audit has no verdict yet."""
    begun, basic = _begun(results), {name for name in wanted if CHECKS[name].basic}
    return "no" not in answers(results, wanted).values() and not (basic <= begun and begun)


def concluded(results: Sequence[CheckResult]) -> dict[str, str]:
    """Return the text of each finding that depends on several checks.

    Incorrect forces that do no work around closed loops are the gradient of another energy. Forces that do
    work around closed loops are not the gradient of any energy.
    """
    numbers = {result.name: result.numbers for result in results if not largely_unasked(result)}
    curl, forces = numbers.get("curl"), numbers.get("forces")
    if not curl or not forces:
        return {}
    # a curl would be seen that is far below the share of the forces that is wrong
    seen = curl["unseen_share"] * forces["rms_force"] < _FAR_BELOW * forces["largest_difference"]
    which = "no_energy" if curl["with_work"] else "another_energy" if seen else ""
    return {"FORCES_NOT_GRADIENT": which}
