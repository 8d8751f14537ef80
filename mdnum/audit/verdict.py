"""What the checks add up to: safe to run, safe to differentiate, and why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from mdnum.audit.base import Part
from mdnum.audit.causes import grouped

Answer = Literal["yes", "as far as asked", "with care", "no", "not asked"]

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
#: Of the ways of a check: from here on it counts as asked.
_NEARLY = 0.9


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


def judge(name: str, parts: Sequence[Part], wanted: Sequence[str] | None = None) -> Judgment:
    """Both answers from the parts of an audit.

    Args:
        name: of the calculator.
        parts: as the checks gave them.
        wanted: checks that were to be made; those of the parts if None.
    """
    names = [part.name for part in parts]
    left = [one for one in wanted or () if one not in names]
    answers: dict[str, Answer] = {
        question: _answer(question, parts, [*names, *left]) for question in ("run", "differentiate")
    }
    return Judgment(
        answers["run"],
        answers["differentiate"],
        _headline(name, answers, parts, left),
        tuple(part.says for part in parts),
    )


def _answer(question: str, parts: Sequence[Part], wanted: Sequence[str]) -> Answer:
    bearing = [
        finding for part in parts for finding in part.findings if finding["code"] not in _APART[question]
    ]
    severities = {finding["severity"] for finding in bearing}
    if "error" in severities:
        return "no"
    if "warning" in severities:
        return "with care"
    if not set(wanted).issuperset(_NEEDED[question]):
        return "not asked"
    begun = {part.name for part in parts}
    if not begun.issuperset(_NEEDED[question]):
        return "not asked"
    asked = {part.name for part in parts if not _largely_unasked(part)}
    return "yes" if asked.issuperset(_NEEDED[question]) else "as far as asked"


def _largely_unasked(part: Part) -> bool:
    return part.asked < _NEARLY * part.possible


def _headline(name: str, answers: Mapping[str, Answer], parts: Sequence[Part], left: Sequence[str]) -> str:
    head = _said(name, answers["run"], answers["differentiate"])
    wanted = {part.name for part in parts}.union(left)
    # of checks that do not make up an answer, none is to come
    to_come = any(wanted.issuperset(needed) and set(left).intersection(needed) for needed in _NEEDED.values())
    if parts and not head and to_come:
        return _nothing_yet(name, parts, left)
    unasked = [
        f"{part.asked:,} of {part.possible:,} ways of {part.name}" for part in parts if _largely_unasked(part)
    ]
    unasked += [f"{one} not asked" for one in left]
    head = head or name
    if unasked:
        # whatever the answers are, what they do not rest on is said beside them
        far = "" if "as far as asked" in head else "as far as asked: "
        head += f" ({far}{', '.join(unasked)})"
    told = [finding for part in parts for finding in part.findings]
    alone = [one for one, _ in grouped(told, [(one["code"], one["severity"]) for one in told])]
    titles = [
        finding["title"]
        for severity in ("error", "warning")
        # where one question has two answers, no other finding of its severity is worth as much
        for finding in sorted(alone, key=lambda one: one["code"] != "NOT_REPEATABLE")
        if finding["severity"] == severity
    ]
    if not titles:
        return (
            f"{head}: nothing was asked."
            if not parts
            else f"{head}: {_counted(len(parts), 'check')} found nothing."
        )
    shown = list(dict.fromkeys(titles))
    if len(shown) > 3:
        shown[2:] = [f"and {len(shown) - 2} more findings"]
    return f"{head}: {'; '.join(shown)}."


def _nothing_yet(name: str, parts: Sequence[Part], left: Sequence[str]) -> str:
    """What is said where a check that both answers need has not begun, and nothing was found so far."""
    ways = [f"{part.asked:,} of {part.possible:,} ways of {part.name}" for part in parts]
    return f"{name}: nothing can be said yet ({', '.join(ways)} asked; {', '.join(left)} not asked)."


def _said(name: str, run: Answer, differentiate: Answer) -> str:
    """Both answers as a clause; empty where neither was asked for."""
    if run == differentiate:
        return {
            "yes": f"{name} is safe to run and to differentiate",
            "as far as asked": f"{name} is safe as far as asked",
            "with care": f"Use {name} with care, to run and to differentiate",
            "no": f"Neither run nor differentiate {name} as it is",
            "not asked": "",
        }[run]
    words = {
        "yes": "safe to {verb}", "as far as asked": "safe as far as asked to {verb}",
        "with care": "to be {done} with care", "no": "not safe to {verb}",
    }  # fmt: skip
    said = [
        words[answer].format(verb=verb, done=done)
        for answer, verb, done in ((run, "run", "run"), (differentiate, "differentiate", "differentiated"))
        if answer != "not asked"
    ]
    return f"{name} is {', and '.join(said)}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
