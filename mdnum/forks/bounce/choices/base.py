"""What a choice of a ball is, and how the two programs of one are made from a system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

from mdnum.ball.problem import Problem
from mdnum.errors import InputError
from mdnum.forks.bounce.twin import BallTwin
from mdnum.systems import ball
from mdnum.systems.ball_system import BallSystem, vary
from mdnum.systems.build_ball import problem

#: Reductions whose result does not depend on the order of their terms.
ORDERLESS = ("exact", "fixed-point", "sorted")


@runtime_checkable
class Choice(Protocol):
    """One numerical choice that can be made otherwise; the contract of the choices of molecular dynamics.

    Attributes:
        name: the word that `parse` makes it from.
        about: one line for people.
        must_hold: whether it cannot change a bit of the trajectory by design, so that a fork is a finding.
    """

    @property
    def name(self) -> str: ...

    @property
    def about(self) -> str: ...

    @property
    def must_hold(self) -> bool: ...

    def why_not(self, system: BallSystem) -> str | None:
        """Why it does not apply to a system; None where it does."""
        ...

    def make(self, system: BallSystem) -> BallTwin:
        """The two programs.

        Raises:
            InputError: it does not apply.
        """
        ...


def check(choice: Choice, system: BallSystem) -> None:
    """Refuse a choice that does not apply.

    Raises:
        InputError: with the reason.
    """
    reason = choice.why_not(system)
    if reason is not None:
        raise InputError(
            f"does not apply to {system.name}: {reason}",
            where=choice.name,
            remedy=f"Choose another: `mdnum fork {system.name} --vary all` tries each",
        )


def varied(system: BallSystem, values: Mapping[str, Any], name: str) -> BallSystem:
    """The system with other values of some keys of its file, checked as the file is.

    Args:
        system: as loaded.
        values: dotted key to value.
        name: of the choice, for a message.

    Raises:
        InputError: a value that the file could not have.
    """
    return replace(system, spec=vary(name, values, system.spec, f"--vary {name}").spec, variants=())


def program(system: BallSystem) -> Problem:
    """World, start and steps of a system."""
    return problem(system.spec, where=system.name)


def twin(system: BallSystem, values: Mapping[str, Any], name: str, difference: str) -> BallTwin:
    """The system, and with other values of some keys."""
    other = varied(system, values, name)
    before, after = (dict(_flat(one.spec.model_dump(mode="json", exclude={"variants"})))
                     for one in (system, other))  # fmt: skip
    changes = {
        key: [before.get(key), after.get(key)]
        for key in dict.fromkeys((*before, *after))
        if before.get(key) != after.get(key)
    }
    return BallTwin(program(system), program(other), difference, changes)


def refused(system: BallSystem, values: Mapping[str, Any], name: str) -> str | None:
    """Why a system cannot have other values of some keys; None where it can."""
    try:
        program(varied(system, values, name))
    except InputError as error:
        # the choice is named where this is told
        return error.message.removeprefix(f"variant {name!r}: ")
    return None


def _flat(table: Mapping[str, Any], prefix: str = ""):
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + str(key), value


def sums(spec: ball.BallSpec) -> str | None:
    """Why a system's steps sum nothing over several balls; None where they do."""
    if spec.stop is None:
        return "its steps solve nothing, so there is no residual to sum"
    if not isinstance(spec.stop, ball.SumRule | ball.RelativeRule):
        return f"its solver is stopped by the rule {spec.stop.rule}, which sums nothing"
    return None


def whole(text: str, what: str) -> int:
    """A whole number from a choice's argument.

    Raises:
        InputError: it is none.
    """
    try:
        return int(text)
    except ValueError:
        raise InputError(f"{text!r} is not a whole number", where=what) from None
