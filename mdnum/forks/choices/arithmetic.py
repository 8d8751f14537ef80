"""Choices of arithmetic: which float plays which role, how sums are made, what stops a solver."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from mdnum.errors import InputError
from mdnum.forks.choices.base import (
    Choice,
    built,
    choice,
    is_pairwise,
    simulations,
    summed,
    world_of,
)
from mdnum.forks.worlds import not_possible, twin
from mdnum.numerics import reductions
from mdnum.numerics.roles import ALL, WIDE, check_role
from mdnum.program import Twin
from mdnum.systems.ball import FixedRule, RelativeRule, SumRule

ROLES = {
    "md": ("state", "force", "decision", "accumulate"),
    "ball": ("state", "arithmetic", "decision", "accumulate"),
}
#: What "precision" without a role means: of molecular dynamics all but what is carried from step to step.
_DEFAULT = {"md": ("force", "decision", "accumulate"), "ball": ROLES["ball"]}
#: Rules that a tolerance of metres belongs to.
RULES = {
    "sum": "the sum of the residuals of all balls",
    "per-instance": "each ball's own residual",
    "maximum": "the largest residual of the batch",
}


@choice("precision")
class PrecisionChoice(Choice):
    """Another float in one role, or in several.

    Sixteen bits are for pair forces alone in molecular dynamics: in any other role they make another model
    rather than another rounding (`mdnum.numerics.roles.check_role` says why).

    Attributes:
        role: "state", "force" (of a ball "arithmetic"), "decision" or "accumulate"; None for all of a ball,
            for all but the state of molecular dynamics, of which sixteen bits are for the force.
        dtype: "float64", "float32", "float16" or "bfloat16".
    """

    role: str | None = None
    dtype: str = "float32"

    def __post_init__(self):
        known = dict.fromkeys((*ROLES["md"], *ROLES["ball"]))
        if self.role is not None and self.role not in known:
            raise InputError(
                f"no role {self.role!r}; there are {', '.join(known)}",
                where="precision",
                remedy="Write precision, or precision.state=bfloat16",
            )
        if self.dtype not in ALL:
            raise InputError(f"unknown dtype {self.dtype!r}; known are {', '.join(ALL)}", where=self.name)

    @property
    def name(self) -> str:
        """Such as "precision" or "precision.force=float64"."""
        base = self.family if self.role is None else f"{self.family}.{self.role}"
        return base if self.dtype == "float32" else f"{base}={self.dtype}"

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        return cls(role or None, argument or "float32")

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        roles = (None, *ROLES[world])
        if world == "ball":
            return [cls(role, dtype) for role in roles for dtype in ALL]
        return [*(cls(role) for role in roles), cls("force", "bfloat16")]

    def _roles(self, world: str) -> tuple[str, ...]:
        if self.role is not None:
            return (self.role,)
        return ("force",) if world == "md" and self.dtype not in WIDE else _DEFAULT[world]

    def describe(self, world: str = "md") -> str:
        return f"{', '.join(self._roles(world))} in {self.dtype}"

    def reason_unavailable(self, system: Any) -> str | None:
        world = world_of(system)
        roles = self._roles(world)
        if missing := [role for role in roles if role not in ROLES[world]]:
            return f"it has no role {missing[0]}; there are {', '.join(ROLES[world])}"
        if world == "md" and not is_pairwise(system):
            return "many-body potentials are evaluated in float64 only"
        if all(getattr(system.spec.precision, role) == self.dtype for role in roles):
            return f"{', '.join(roles)} {'is' if len(roles) == 1 else 'are'} {self.dtype} already"
        if world == "md":
            try:
                for role in roles:
                    check_role(role, self.dtype)
            except InputError as error:
                return error.message
            return None
        if roles == ("accumulate",) and (reason := nothing_summed(system)) is not None:
            return reason
        return not_possible(system, self._keys(world), self.name)

    def _keys(self, world: str) -> dict[str, str]:
        return {f"precision.{role}": self.dtype for role in self._roles(world)}

    def make(self, system: Any) -> Twin:
        world = world_of(system)
        roles = self._roles(world)
        before = ", ".join(sorted({getattr(system.spec.precision, role) for role in roles}))
        difference = f"{', '.join(roles)} in {self.dtype}, not {before}"
        return twin(system, self._keys(world), self.name, difference)


@choice("reduction")
class Summation(Choice):
    """Another order of a sum: of the forces on an atom, of the residuals that stop a solver.

    Attributes:
        word: as `mdnum.numerics.reductions.parse` reads it: "exact", "permuted:3", "blocked:8".
    """

    shown = True
    word: str = "exact"

    def __post_init__(self):
        reductions.parse(self.word)

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls(word) for word in reductions.BY_NAME]

    def describe(self, world: str = "md") -> str:
        return f"{'force sums' if world == 'md' else 'the residuals of all balls summed'} {self.word}"

    def reason_unavailable(self, system: Any) -> str | None:
        if world_of(system) == "ball":
            if (reason := nothing_summed(system)) is not None:
                return reason
            if system.balls == 1:
                return "the residual of one ball is no sum"
        elif not is_pairwise(system):
            return "the sums of a many-body potential have one order"
        if self.word == system.spec.precision.reduction:
            return f"the system sums {self.word} already"
        return None

    def make(self, system: Any) -> Twin:
        before = system.spec.precision.reduction
        if world_of(system) == "ball":
            values = {"precision.reduction": self.word}
            return twin(system, values, self.name, f"residuals summed {self.word}, not {before}")
        a = built(system)
        return simulations(a, summed(a, self.word), f"force sums {self.word}, not {before}")


@choice("stop")
class Stopping(Choice):
    """Another rule that stops the solver, with the same tolerance.

    Attributes:
        rule: "sum", "per-instance" or "maximum".
    """

    worlds = ("ball",)
    shown = True
    rule: str = "per-instance"

    def __post_init__(self):
        if self.rule not in RULES:
            raise InputError(f"no rule {self.rule!r}; there are {', '.join(RULES)}", where="stop")

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls(rule) for rule in RULES]

    def describe(self, world: str = "ball") -> str:
        return f"the solver is stopped by {RULES[self.rule]}"

    def reason_unavailable(self, system: Any) -> str | None:
        stop = system.spec.stop
        if stop is None:
            return "its steps solve nothing, so nothing stops a solver"
        if isinstance(stop, FixedRule):
            return "its solver makes a fixed number of iterations and has no tolerance"
        if isinstance(stop, RelativeRule):
            return "its tolerance is a share of the first residual and not a height"
        if stop.rule == self.rule:
            return f"the rule is {self.rule} already"
        return not_possible(system, {"stop.rule": self.rule}, self.name)

    def make(self, system: Any) -> Twin:
        difference = f"stopped by the rule {self.rule}, not {system.spec.stop.rule}"
        return twin(system, {"stop.rule": self.rule}, self.name, difference)


def nothing_summed(system: Any) -> str | None:
    """Why the steps of a ball's system sum nothing over several balls; None where they do."""
    stop = system.spec.stop
    if stop is None:
        return "its steps solve nothing, so there is no residual to sum"
    if not isinstance(stop, SumRule | RelativeRule):
        return f"its solver is stopped by the rule {stop.rule}, which sums nothing"
    return None
