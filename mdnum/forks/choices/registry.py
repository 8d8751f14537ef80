"""Choices by name, and from a word with an argument."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping

from mdnum.errors import InputError
from mdnum.forks.choices.arithmetic import ROLES, Precision, Summation
from mdnum.forks.choices.base import ORDERLESS, Choice, real, whole
from mdnum.forks.choices.energy import EnergyShift
from mdnum.forks.choices.formats import FORMATS, Format
from mdnum.forks.choices.frames import Images, Relabel, Rotate, Translate
from mdnum.forks.choices.inputs import Noise, StartUlp, Ulps
from mdnum.forks.choices.lists import Builder, Order, Rebuild, Skin
from mdnum.forks.words import families
from mdnum.precision import reductions

_SHIPPED: tuple[Choice, ...] = (
    Precision(),
    *(Precision((role,)) for role in ROLES),
    Precision(("force",), "bfloat16"),
    *(Summation(word) for word in reductions.BY_NAME),
    Order(),
    *(Format(word) for word in FORMATS),
    Builder(),
    Skin(),
    Rebuild(1),
    Rebuild(10),
    Rebuild(None),
    Relabel(),
    Rotate(),
    Translate(),
    Images(),
    Images(1),
    EnergyShift(),
    *(Order(both=word) for word in ORDERLESS),
    Format(both="exact"),
    *(one(both="exact") for one in (Builder, Skin, Rebuild, Relabel, Rotate)),
    *(
        Ulps(key)
        for key in (
            "cutoff.radius",
            "cutoff.in_sigma",
            "dynamics.timestep",
            "dynamics.temperature",
            "potential.sigma",
            "potential.epsilon",
        )
    ),
    StartUlp(),
    Noise(),
)

#: What `--processes` varies, and people may look for here.
_PROGRAMS = ("jit", "eager", "vmap", "grad", "xla")

#: The choices that are screened when all are asked for.
BY_NAME: Mapping[str, Choice] = {choice.name: choice for choice in _SHIPPED}


def names() -> list[str]:
    """Names of the shipped choices."""
    return list(BY_NAME)


def parse(text: str) -> Choice:
    """A choice from a word.

    Args:
        text: a name, or a family with an argument: "reduction=permuted:3", "skin=0.5", "precision=float32",
            "precision.force=bfloat16", "format=sparse", "rebuild=every:10", "ulps=cutoff.radius:+1",
            "start=17:0:+1" (atom, axis, ulps), "order=3", "translate=0.5", "rotate=-x-yz", "noise=7". A last
            "@exact" gives both runs that reduction, where the order of neighbors is what is chosen.
            "precision=bfloat16" is that of the force: no other role can have it.

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
    if family in _PLAIN and not at:
        return _PLAIN[family](argument) if argument else _without(family, text)
    if family in _SUMMED:
        if at:
            reductions.parse(both)
        if argument or not equals:
            return _SUMMED[family](argument, both or None)
    if family in _PROGRAMS:
        raise InputError(
            f"{text} is another program of one run, and no choice of two",
            remedy="Ask `mdnum fork SYSTEM --processes`",
        )
    raise InputError(
        f"no choice {text!r}", remedy=f"{_near(text)}There are {families(BY_NAME)}; `mdnum fork` lists all"
    )


def _near(text: str) -> str:
    close = difflib.get_close_matches(text, BY_NAME, n=3)
    return f"Did you mean {' or '.join(close)}? " if close else ""


def _without(family: str, text: str) -> Choice:
    defaults = {"reduction": Summation(), "unwrapped": Images(1), "start": StartUlp(), "noise": Noise()}
    if family in defaults and "=" not in text:
        return defaults[family]
    examples = [name for name in BY_NAME if name.partition("=")[0] == family]
    raise InputError(f"{text!r} says nothing", remedy=f"Write such as {', '.join(examples)}")


def _ulps(argument: str) -> Choice:
    key, _, count = argument.partition(":")
    return Ulps(key, whole(count, "ulps") if count else 1)


def _start(argument: str) -> Choice:
    parts = argument.split(":")
    if len(parts) not in (2, 3):
        raise InputError(f"{argument!r} is not atom:axis:ulps", where="start", remedy="Write start=17:0:+1")
    numbers = [whole(part, "start") for part in parts]
    return StartUlp(numbers[0], numbers[1], numbers[2] if len(numbers) == 3 else 1)


_PLAIN: Mapping[str, Callable[[str], Choice]] = {
    "reduction": Summation,
    "ulps": _ulps,
    "start": _start,
    "noise": lambda argument: Noise(whole(argument, "noise")),
    "unwrapped": lambda argument: Images(whole(argument, "unwrapped")),
}


def _rebuild(argument: str, both: str | None) -> Choice:
    if argument in ("", "half-skin"):
        return Rebuild(None if argument else 1, both)
    rule, _, count = argument.partition(":")
    if rule != "every":
        raise InputError(f"no rule {argument!r}", where="rebuild", remedy="Write every:10 or half-skin")
    return Rebuild(whole(count, "rebuild"), both)


def _translate(argument: str, both: str | None) -> Choice:
    return Translate(real(argument, "translate") if argument else 0.25, both)


_SUMMED: Mapping[str, Callable[[str, str | None], Choice]] = {
    "order": lambda argument, both: Order(whole(argument, "order") if argument else 1, both),
    "format": lambda argument, both: Format(argument or "ordered-sparse", both),
    "builder": lambda argument, both: Builder(argument or None, both),
    "skin": lambda argument, both: Skin(real(argument, "skin") if argument else None, both),
    "rebuild": _rebuild,
    "relabel": lambda argument, both: Relabel(whole(argument, "relabel") if argument else 1, both),
    "rotate": lambda argument, both: Rotate(argument or None, both),
    "translate": _translate,
}
