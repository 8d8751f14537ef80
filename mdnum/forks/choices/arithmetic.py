"""Choices of arithmetic: which float plays which role, and in which order the force is summed."""

from __future__ import annotations

from dataclasses import dataclass

from mdnum.errors import InputError
from mdnum.forks.choices.base import ORDERLESS, check, is_pairwise, summed, varied
from mdnum.forks.twin import Twin
from mdnum.precision import reductions
from mdnum.precision.policy import ALL, WIDE, check_role
from mdnum.systems.build import build
from mdnum.systems.load import System

ROLES = ("state", "force", "decision", "accumulate")
#: What "precision" without a role means: everything but what is carried from step to step.
_ARITHMETIC = ("force", "decision", "accumulate")


@dataclass(frozen=True)
class Precision:
    """Another float in one role, or in all but the state.

    Sixteen bits are for pair forces alone: in any other role of molecular dynamics they make another model
    rather than another rounding (`mdnum.precision.policy.check_role` says why).

    Attributes:
        roles: of "state", "force", "decision" and "accumulate".
        dtype: "float32" or "float64"; of the force also "bfloat16" or "float16".
    """

    roles: tuple[str, ...] = _ARITHMETIC
    dtype: str = "float32"

    def __post_init__(self):
        for role in self.roles:
            if role not in ROLES:
                raise InputError(
                    f"no role {role!r}; there are {', '.join(ROLES)}",
                    where="precision",
                    remedy="Write precision, or precision.force=float32",
                )
        if self.dtype not in ALL:
            raise InputError(f"unknown dtype {self.dtype!r}; known are {', '.join(ALL)}", where=self.name)
        if self.dtype not in WIDE and self.roles == _ARITHMETIC:
            object.__setattr__(self, "roles", ("force",))
        for role in self.roles:
            check_role(role, self.dtype)

    @property
    def name(self) -> str:
        """Such as "precision" or "precision.force=float64"."""
        base = "precision" if self.roles == _ARITHMETIC else f"precision.{self.roles[0]}"
        return base if self.dtype == "float32" else f"{base}={self.dtype}"

    @property
    def about(self) -> str:
        """One line."""
        return f"{', '.join(self.roles)} in {self.dtype}"

    @property
    def must_hold(self) -> bool:
        """A rounding changes bits."""
        return False

    def why_not(self, system: System) -> str | None:
        """Many-body potentials have one precision; a role may have that float already."""
        if not is_pairwise(system):
            return "many-body potentials are evaluated in float64 only"
        if all(getattr(system.spec.precision, role) == self.dtype for role in self.roles):
            return f"{', '.join(self.roles)} are {self.dtype} already"
        return None

    def make(self, system: System) -> Twin:
        """The system, and with the other float."""
        check(self, system)
        before = ", ".join(sorted({getattr(system.spec.precision, role) for role in self.roles}))
        other = varied(system, {f"precision.{role}": self.dtype for role in self.roles})
        return Twin(build(system), build(other), f"{', '.join(self.roles)} in {self.dtype}, not {before}")


@dataclass(frozen=True)
class Summation:
    """Another order of the force sum.

    Attributes:
        word: as `mdnum.precision.reductions.parse` reads it: "exact", "permuted:3", "blocked:8".
    """

    word: str = "exact"

    def __post_init__(self):
        reductions.parse(self.word)

    @property
    def name(self) -> str:
        """Such as "reduction=exact"."""
        return f"reduction={self.word}"

    @property
    def about(self) -> str:
        """One line."""
        return f"force sums {self.word}"

    @property
    def must_hold(self) -> bool:
        """Another order is another rounding."""
        return False

    def why_not(self, system: System) -> str | None:
        """Many-body potentials sum in their own way."""
        if not is_pairwise(system):
            return "the sums of a many-body potential have one order"
        if self.word == system.spec.precision.reduction:
            return f"the system sums {self.word} already"
        return None

    def make(self, system: System) -> Twin:
        """The system, and with the other sums."""
        check(self, system)
        a = build(system)
        return Twin(a, summed(a, self.word), f"force sums {self.word}, not {system.spec.precision.reduction}")


def orderless(both: str | None, system: System | None = None) -> bool:
    """Whether runs with this reduction cannot tell the order of neighbors."""
    word = both if both is not None or system is None else system.spec.precision.reduction
    return word in ORDERLESS
