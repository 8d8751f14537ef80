"""Choices of arithmetic: which float plays which role, how residuals are summed, what stops a solver."""

from __future__ import annotations

from dataclasses import dataclass

from mdnum.ball.limits import DTYPES
from mdnum.errors import InputError
from mdnum.forks.bounce.choices.base import check, refused, sums, twin
from mdnum.forks.bounce.twin import BallTwin
from mdnum.precision import reductions
from mdnum.systems import ball
from mdnum.systems.ball_system import BallSystem

ROLES = ("state", "arithmetic", "decision", "accumulate")
#: Rules that a tolerance of metres belongs to.
RULES = ("sum", "per-instance", "maximum")


@dataclass(frozen=True)
class Precision:
    """Another float in one role, or in all.

    Attributes:
        roles: of "state", "arithmetic", "decision" and "accumulate".
        dtype: "float64", "float32", "float16" or "bfloat16".
    """

    roles: tuple[str, ...] = ROLES
    dtype: str = "float32"

    def __post_init__(self):
        for role in self.roles:
            if role not in ROLES:
                raise InputError(
                    f"no role {role!r}; there are {', '.join(ROLES)}",
                    where="precision",
                    remedy="Write precision, or precision.state=bfloat16",
                )
        if self.dtype not in DTYPES:
            raise InputError(f"unknown dtype {self.dtype!r}; known are {', '.join(DTYPES)}", where=self.name)

    @property
    def name(self) -> str:
        """Such as "precision" or "precision.state=bfloat16"."""
        base = "precision" if self.roles == ROLES else f"precision.{self.roles[0]}"
        return base if self.dtype == "float32" else f"{base}={self.dtype}"

    @property
    def about(self) -> str:
        """One line."""
        return f"{', '.join(self.roles)} in {self.dtype}"

    @property
    def must_hold(self) -> bool:
        """A rounding changes bits."""
        return False

    @property
    def _keys(self) -> dict[str, str]:
        return {f"precision.{role}": self.dtype for role in self.roles}

    def why_not(self, system: BallSystem) -> str | None:
        """A role may have that float already, have nothing to do, or not hold a number of the file in it."""
        precision = system.spec.precision
        if all(getattr(precision, role) == self.dtype for role in self.roles):
            return f"{', '.join(self.roles)} {_are(self.roles)} {self.dtype} already"
        if self.roles == ("accumulate",) and (reason := sums(system.spec)) is not None:
            return reason
        return refused(system, self._keys, self.name)

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and with the other float."""
        check(self, system)
        before = ", ".join(sorted({getattr(system.spec.precision, role) for role in self.roles}))
        words = f"{', '.join(self.roles)} in {self.dtype}, not {before}"
        return twin(system, self._keys, self.name, words)


def _are(roles: tuple[str, ...]) -> str:
    return "is" if len(roles) == 1 else "are"


@dataclass(frozen=True)
class Summation:
    """Another order of the sum of residuals that stops a solver.

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
        return f"the residuals of all balls summed {self.word}"

    @property
    def must_hold(self) -> bool:
        """Another order is another rounding."""
        return False

    def why_not(self, system: BallSystem) -> str | None:
        """There must be a sum, of two terms at least."""
        if (reason := sums(system.spec)) is not None:
            return reason
        if system.balls == 1:
            return "the residual of one ball is no sum"
        if self.word == system.spec.precision.reduction:
            return f"the system sums {self.word} already"
        return None

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and with the other sum."""
        check(self, system)
        words = f"residuals summed {self.word}, not {system.spec.precision.reduction}"
        return twin(system, {"precision.reduction": self.word}, self.name, words)


@dataclass(frozen=True)
class Stopping:
    """Another rule that stops the solver, with the same tolerance.

    Attributes:
        rule: "sum", "per-instance" or "maximum".
    """

    rule: str = "per-instance"

    def __post_init__(self):
        if self.rule not in RULES:
            raise InputError(f"no rule {self.rule!r}; there are {', '.join(RULES)}", where="stop")

    @property
    def name(self) -> str:
        """Such as "stop=per-instance"."""
        return f"stop={self.rule}"

    @property
    def about(self) -> str:
        """One line."""
        what = {
            "sum": "the sum of the residuals of all balls",
            "per-instance": "each ball's own residual",
            "maximum": "the largest residual of the batch",
        }[self.rule]
        return f"the solver is stopped by {what}"

    @property
    def must_hold(self) -> bool:
        """Another rule is another program."""
        return False

    def why_not(self, system: BallSystem) -> str | None:
        """There must be a tolerance, of the same kind."""
        stop = system.spec.stop
        if stop is None:
            return "its steps solve nothing, so nothing stops a solver"
        if isinstance(stop, ball.FixedRule):
            return "its solver makes a fixed number of iterations and has no tolerance"
        if isinstance(stop, ball.RelativeRule):
            return "its tolerance is a share of the first residual and not a height"
        if stop.rule == self.rule:
            return f"the rule is {self.rule} already"
        return refused(system, {"stop.rule": self.rule}, self.name)

    def make(self, system: BallSystem) -> BallTwin:
        """The system, and under the other rule."""
        check(self, system)
        assert system.spec.stop is not None
        words = f"stopped by the rule {self.rule}, not {system.spec.stop.rule}"
        return twin(system, {"stop.rule": self.rule}, self.name, words)
