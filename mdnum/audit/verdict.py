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
#: Codes that do not bear on a question, whatever their severity: what is smooth only to first order runs
#: well, and what drifts may still have the right derivative.
_APART = {
    "run": ("KINK", "CURVATURE", "SECOND_DERIVATIVE", "NOT_REPEATABLE_DERIVATIVE"),
    "differentiate": ("DRIFT", "TIMESTEP"),
}
_WORDS = {"yes": "safe", "with care": "to be used with care", "no": "not safe", "not asked": "not asked"}


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
        finding
        for part in parts
        for finding in part.findings
        if not any(word in finding["code"] for word in _APART[question])
    ]
    severities = {finding["severity"] for finding in bearing}
    if "error" in severities:
        return "no"
    if "warning" in severities:
        return "with care"
    asked = {part.name for part in parts}
    return "yes" if asked.issuperset(_NEEDED[question]) else "not asked"


def _headline(name: str, answers: Mapping[str, Answer], parts: Sequence[Part]) -> str:
    run, differentiate = _WORDS[answers["run"]], _WORDS[answers["differentiate"]]
    if run == differentiate:
        head = f"{name} is {run} to run and to differentiate" if run != "not asked" else ""
    else:
        said = [
            f"{words} to {verb}"
            for words, verb in ((run, "run"), (differentiate, "differentiate"))
            if words != "not asked"
        ]
        head = f"{name} is {' and '.join(said)}"
    titles = [
        finding["title"]
        for severity in ("error", "warning")
        for part in parts
        for finding in part.findings
        if finding["severity"] == severity
    ]
    if not titles:
        found = f"{len(parts)} checks found nothing"
        return f"{head}: {found}." if head else f"{name}: {found}."
    shown = list(dict.fromkeys(titles))
    more = f", and {len(shown) - 2} more findings" if len(shown) > 3 else ""
    reasons = "; ".join(shown if not more else shown[:2])
    return f"{head or name}: {reasons}{more}."
