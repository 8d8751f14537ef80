"""What the checks add up to: safe to run, safe to differentiate, and why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from mdnum.audit.base import Part

Answer = Literal["yes", "with care", "no", "not asked"]

#: Checks without which a question has no answer.
_NEEDED = {
    "run": ("invariance", "forces", "state", "dynamics"),
    "differentiate": ("smoothness", "forces", "curl"),
}
#: Codes that do not bear on a question, whatever their severity: where only the force jumps a run keeps its
#: energy, and what a run loses to its time step takes nothing from a derivative.
_APART = {
    "run": ("FORCE_JUMP", "CURVATURE_JUMP", "CURVATURE_JUMP_AMONG_MANY"),
    "differentiate": ("DRIFT", "TIMESTEP"),
}


@dataclass(frozen=True)
class Judgment:
    """The two answers.

    Attributes:
        run: may a simulation be run with it?
        differentiate: may a derivative be taken through it?
        headline: both in one sentence.
        evidence: what each check says, a sentence or two each.
    """

    run: Answer
    differentiate: Answer
    headline: str
    evidence: tuple[str, ...]


def judge(name: str, parts: Sequence[Part]) -> Judgment:
    """Both answers from the parts of an audit.

    Args:
        name: of the calculator.
        parts: as the checks gave them.
    """
    answers: dict[str, Answer] = {question: _answer(question, parts) for question in ("run", "differentiate")}
    return Judgment(
        answers["run"],
        answers["differentiate"],
        _headline(name, answers, parts),
        tuple(part.says for part in parts),
    )


def _answer(question: str, parts: Sequence[Part]) -> Answer:
    bearing = [
        finding for part in parts for finding in part.findings if finding["code"] not in _APART[question]
    ]
    severities = {finding["severity"] for finding in bearing}
    if "error" in severities:
        return "no"
    if "warning" in severities:
        return "with care"
    asked = {part.name for part in parts}
    return "yes" if asked.issuperset(_NEEDED[question]) else "not asked"


def _headline(name: str, answers: Mapping[str, Answer], parts: Sequence[Part]) -> str:
    head = _said(name, answers["run"], answers["differentiate"])
    found = [finding for part in parts for finding in part.findings]
    titles = [
        finding["title"]
        for severity in ("error", "warning")
        # where one question has two answers, no other finding of its severity is worth as much
        for finding in sorted(found, key=lambda one: one["code"] != "NOT_REPEATABLE")
        if finding["severity"] == severity
    ]
    if not titles:
        return f"{head or name}: {_counted(len(parts), 'check')} found nothing."
    shown = list(dict.fromkeys(titles))
    if len(shown) > 3:
        shown[2:] = [f"and {len(shown) - 2} more findings"]
    return f"{head or name}: {'; '.join(shown)}."


def _said(name: str, run: Answer, differentiate: Answer) -> str:
    """Both answers as a clause; empty where neither was asked for."""
    if run == differentiate:
        return {
            "yes": f"{name} is safe to run and to differentiate",
            "with care": f"Use {name} with care, to run and to differentiate",
            "no": f"Neither run nor differentiate {name} as it is",
            "not asked": "",
        }[run]
    words = {
        "yes": "safe to {verb}", "with care": "to be {done} with care", "no": "not safe to {verb}",
    }  # fmt: skip
    said = [
        words[answer].format(verb=verb, done=done)
        for answer, verb, done in ((run, "run", "run"), (differentiate, "differentiate", "differentiated"))
        if answer != "not asked"
    ]
    return f"{name} is {', and '.join(said)}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
