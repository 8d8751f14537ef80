"""Derivatives of a rollout: a program with decisions has several, and each says which it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from mdnum.ball.gradients.base import Gradient, Method
from mdnum.ball.gradients.dependence import Dependence, dependence
from mdnum.ball.gradients.event_aware import EventAware
from mdnum.ball.gradients.implicit import FixedPoint, Implicit
from mdnum.ball.gradients.randomized import RandomizedSmoothing
from mdnum.ball.gradients.smoothed import Smoothed, SoftImpact
from mdnum.ball.gradients.unrolled import Frozen, Unrolled
from mdnum.ball.problem import Problem
from mdnum.errors import InputError, MdnumError

__all__ = [
    "BY_NAME",
    "Comparison",
    "Dependence",
    "EventAware",
    "FixedPoint",
    "Frozen",
    "Gradient",
    "Implicit",
    "Method",
    "RandomizedSmoothing",
    "Smoothed",
    "SoftImpact",
    "Unrolled",
    "compare",
    "dependence",
    "method",
]

#: The methods as system files name them; the names take the same options as the classes.
BY_NAME: Mapping[str, type] = {
    made.name: made for made in (Unrolled, Frozen, Implicit, EventAware, Smoothed, RandomizedSmoothing)
}


@dataclass(frozen=True)
class Comparison:
    """Derivatives of one problem by several methods.

    Attributes:
        gradients: of the methods that apply, in the order asked for.
        refused: why another does not, by its name.
    """

    gradients: tuple[Gradient, ...]
    refused: Mapping[str, str]

    def __iter__(self) -> Iterator[Gradient]:
        return iter(self.gradients)


def method(name: str, **options: object) -> Method:
    """A method by the name it has in system files.

    Raises:
        InputError: there is none of that name; lists those there are.
    """
    if name not in BY_NAME:
        raise InputError(f"no gradient called {name!r}", remedy=f"There are {', '.join(BY_NAME)}.")
    return BY_NAME[name](**options)


def compare(
    problem: Problem, names: Sequence[str], methods: Sequence[str | Method] = tuple(BY_NAME)
) -> Comparison:
    """The derivative of one loss by several methods, and why some do not apply.

    Args:
        names: parameters, "y0" and "v0" among them.
        methods: names or objects.

    Raises:
        InputError: there is no such parameter or method.
    """
    problem.values(names)
    chosen = [method(one) if isinstance(one, str) else one for one in methods]
    gradients, refused = [], {}
    for one in chosen:
        try:
            gradients.append(one(problem, names))
        except MdnumError as error:
            refused[one.name] = str(error)
    return Comparison(tuple(gradients), refused)
