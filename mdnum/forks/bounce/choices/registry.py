"""Choices of a ball by name, and from a word with an argument."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping

from mdnum.ball.limits import DTYPES
from mdnum.errors import InputError
from mdnum.forks.bounce.choices.arithmetic import ROLES, RULES, Precision, Stopping, Summation
from mdnum.forks.bounce.choices.base import Choice, whole
from mdnum.forks.bounce.choices.decisions import ContactStep, Inverted, Iterations
from mdnum.forks.bounce.choices.inputs import OFTEN, Cap, StartUlp, Ulps
from mdnum.forks.bounce.choices.order import BOTH, BatchOrder
from mdnum.forks.words import families
from mdnum.precision import reductions

#: From the widest to the narrowest; "precision" alone means the second.
_FLOATS = tuple(sorted(DTYPES, key=lambda name: -DTYPES[name].itemsize))

_SHIPPED: tuple[Choice, ...] = (
    *(Precision(dtype=name) for name in _FLOATS),
    *(Precision((role,), name) for role in ROLES for name in _FLOATS),
    *(Summation(word) for word in reductions.BY_NAME),
    *(Stopping(rule) for rule in RULES),
    BatchOrder(),
    *(BatchOrder(both=word) for word in BOTH),
    *(Ulps(key) for key in OFTEN),
    StartUlp(),
    StartUlp(what="velocity"),
    Cap(),
    Iterations(),
    ContactStep(),
    ContactStep(1),
)

#: The choices that are screened when all are asked for.
BY_NAME: Mapping[str, Choice] = {choice.name: choice for choice in _SHIPPED}


def names() -> list[str]:
    """Names of the shipped choices."""
    return list(BY_NAME)


def parse(text: str) -> Choice:
    """A choice from a word.

    Args:
        text: a name, or a family with an argument: "precision=bfloat16", "precision.state=float16",
            "reduction=permuted:3", "stop=maximum", "order=3@alone", "ulps=contact.k:-2",
            "start=3:velocity:+1" (ball, what, ulps), "start=velocity:+1" (of the fastest), "max_iter=+2",
            "iterations=+1:57:3" (more, step, ball), "contact=later:2" (of the second contact),
            "contact=57:0" (inverted at a step, for a ball).

    Raises:
        InputError: no such choice, or an argument that it cannot have.
    """
    text = text.strip()
    if text in BY_NAME:
        return BY_NAME[text]
    word, at, both = text.partition("@")
    family, equals, argument = word.partition("=")
    head, _, role = family.partition(".")
    if head == "precision" and not at and (argument or not equals):
        return Precision(*([(role,)] if role else []), dtype=argument or "float32")
    if family == "order" and (argument or not equals) and (both or not at):
        return BatchOrder(whole(argument, "order") if argument else 1, both or None)
    if family in _FAMILIES and not at and argument:
        return _FAMILIES[family](argument)
    raise InputError(
        f"no choice {text!r} of a ball",
        remedy=f"{_near(text)}There are {families(BY_NAME)}; `mdnum fork` lists all",
    )


def _near(text: str) -> str:
    close = difflib.get_close_matches(text, BY_NAME, n=3)
    return f"Did you mean {' or '.join(close)}? " if close else ""


def _ulps(argument: str) -> Choice:
    key, _, count = argument.partition(":")
    return Ulps(key, whole(count, "ulps") if count else 1)


def _start(argument: str) -> Choice:
    head, _, rest = argument.partition(":")
    ball = whole(head, "start") if head.lstrip("+-").isdecimal() else None
    what, _, count = (argument if ball is None else rest).partition(":")
    return StartUlp(ball, what or "height", whole(count, "start") if count else 1)


def _contact(argument: str) -> Choice:
    first, _, second = argument.partition(":")
    if first in ("earlier", "later"):
        return ContactStep(-1 if first == "earlier" else 1, whole(second, "contact") if second else 1)
    return Inverted(whole(first, "contact"), whole(second, "contact") if second else 0)


def _iterations(argument: str) -> Choice:
    parts = [whole(part, "iterations") for part in argument.split(":")]
    if len(parts) > 3:
        raise InputError(f"{argument!r} is not more:step:ball", where="iterations")
    return Iterations(*parts)


_FAMILIES: Mapping[str, Callable[[str], Choice]] = {
    "reduction": Summation,
    "stop": Stopping,
    "ulps": _ulps,
    "start": _start,
    "max_iter": lambda argument: Cap(whole(argument, "max_iter")),
    "iterations": _iterations,
    "contact": _contact,
}
