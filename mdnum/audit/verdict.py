"""What the checks add up to: safe to run, safe to differentiate, and which findings may be one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from mdnum.audit.base import CheckResult
from mdnum.audit.check import needed_to

Answer = Literal["yes", "as far as asked", "with care", "no", "not asked"]

#: Codes that do not bear on a question, whatever their severity: where only the force jumps a run keeps its
#: energy, and what a run loses to its time step takes nothing from a derivative.
_APART = {
    "run": ("FORCE_JUMP", "CURVATURE_JUMP", "CURVATURE_JUMP_AMONG_MANY"),
    "differentiate": ("DRIFT", "TIMESTEP"),
}
QUESTIONS = tuple(_APART)
#: Of the ways of a check: from here on it counts as asked.
_NEARLY = 0.9

_IMAGES = (
    "IMAGES", "LATTICE", "EXTENSIVE", "TRANSLATION", "NARROW_CELL", "FACES", "CELL_ULP", "ROTATION",
)  # fmt: skip
_FORCES = ("FORCES_NOT_GRADIENT", "CURL", "NET_FORCE", "NET_TORQUE")
_RUN = ("NOT_CONSERVED", "HIDDEN_JUMPS", "DRIFT")
_AMONG_MANY = ("JUMP_AMONG_MANY", "CURVATURE_JUMP_AMONG_MANY")

#: What each mistake brings about as well, the deepest first: neighbors that are lost by their place in a list
#: make every other way of writing a structure down another structure; images that are lost have no forces; a
#: force that is no gradient does not keep the energy of a run.
_BRINGS: dict[str, tuple[str, ...]] = {
    "NOT_REPEATABLE": (
        "STALE_STATE", "STALE_DYNAMICS", "ORDER", "TOPOLOGY_BY_ORDER", *_IMAGES, "MIRROR", "DUMMY_CELL",
        *_AMONG_MANY, *_FORCES, *_RUN, "ENERGY_STEP", "NOISE_FLOOR", "LOW_PRECISION", "QUANTIZED",
        "NOT_BIT_IDENTICAL",
    ),
    "STALE_STATE": ("STALE_DYNAMICS", *_RUN),
    "NEIGHBOR_CAP_BY_ORDER": ("NEIGHBOR_CAP", "ORDER", *_IMAGES, *_AMONG_MANY, *_FORCES, *_RUN),
    "NEIGHBOR_CAP": ("ORDER", *_IMAGES, *_AMONG_MANY, *_FORCES, *_RUN),
    "ORDER": (*_IMAGES, *_AMONG_MANY, *_FORCES, *_RUN),
    **{code: (*_IMAGES[k + 1 :], *_AMONG_MANY, *_FORCES, *_RUN) for k, code in enumerate(_IMAGES)},
    "FORCES_NOT_GRADIENT": ("CURL", "NET_FORCE", "NET_TORQUE", "NOT_CONSERVED", "DRIFT"),
    "CURL": ("NOT_CONSERVED", "DRIFT"),
    "ENERGY_JUMP": ("FLIPS_CHANGE_ENERGY", "ENERGY_STEP"),
    "JUMP_AMONG_MANY": ("CURVATURE_JUMP_AMONG_MANY", "HIDDEN_JUMPS"),
}  # fmt: skip
_SEVERITIES = ("info", "warning", "error")


def answers(results: Sequence[CheckResult], wanted: Sequence[str]) -> Mapping[str, Answer]:
    """An answer to each question ("run", "differentiate").

    Args:
        wanted: checks that were to be made.
    """
    return {question: _answer(question, results, wanted) for question in QUESTIONS}


def _answer(question: str, results: Sequence[CheckResult], wanted: Sequence[str]) -> Answer:
    severities = {
        one.severity for result in results for one in result.findings if one.code not in _APART[question]
    }
    if "error" in severities:
        return "no"
    if "warning" in severities:
        return "with care"
    needed, begun = needed_to(question), {result.name for result in results}
    if not needed <= set(wanted) or not needed <= begun:
        return "not asked"
    asked = {result.name for result in results if not largely_unasked(result)}
    return "yes" if needed <= asked else "as far as asked"


def largely_unasked(result: CheckResult) -> bool:
    """Whether the time was up before most ways of a check were asked."""
    return result.asked < _NEARLY * result.possible


def to_come(results: Sequence[CheckResult], wanted: Sequence[str]) -> bool:
    """Whether a check is left of those that make up an answer; of others, none is to come."""
    left = set(wanted) - {result.name for result in results}
    needs = [needed_to(question) for question in QUESTIONS]
    return any(needed <= set(wanted) and left & needed for needed in needs)


def heads(findings: Sequence[tuple[str, str]]) -> list[int]:
    """For each finding the place of the one that it goes below, its own where it is listed by itself.

    It goes below the deepest mistake found that brings it about and is no less severe, and below the first
    finding of its own code. That it has the same cause is likely and not known: correct the one above, and
    ask again.

    Args:
        findings: code and severity of each, in the order in which they were found.
    """
    ranks = [_SEVERITIES.index(severity) for _, severity in findings]
    first: dict[str, int] = {}
    for place, (code, _) in enumerate(findings):
        if code not in first or ranks[place] > ranks[first[code]]:
            first[code] = place
    found = []
    for place, (code, _) in enumerate(findings):
        above = (
            first[cause]
            for cause, brought in _BRINGS.items()
            if cause in first and code in brought and ranks[first[cause]] >= max(ranks[place], 1)
        )
        found.append(next(above, first[code]))
    # of what goes below one that goes below another, the top
    for _ in found:
        found = [found[place] for place in found]
    return found
