"""Choices of arithmetic: floating-point formats, and the order of sums.

The reduction or the neighbor list sets the order of a sum. The order of pairs depends on how and when the
list is built. If every list is rebuilt in time, the order does not change which pairs interact. An exact sum
does not depend on the order of its terms.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.choices.base import (
    ORDERLESS,
    Choice,
    Summed,
    applies,
    check,
    choice,
    number,
    simulations,
    summed,
    summing,
    world_of,
)
from mdnum.forks.worlds import ROLES, program_of, twin, varied
from mdnum.numerics import reductions
from mdnum.numerics.roles import ALL, WIDE, check_role
from mdnum.program import Twin
from mdnum.systems.ball import MaximumRule, RelativeRule, SumRule

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

#: Roles changed by "precision" without a role: for molecular dynamics, all except the state that is carried
#: from step to step.
_DEFAULT = {"md": ("force", "decision", "accumulate"), "ball": ROLES["ball"]}
#: Names of formats in jax-md.
FORMATS = ("dense", "sparse", "ordered-sparse")


@choice("precision")
class PrecisionChoice(Choice):
    """Another floating-point format of quantities such as the forces.

    In molecular dynamics, 16-bit floats are allowed only for pair forces. For other quantities, 16-bit floats
    would change the model (see `mdnum.numerics.roles.check_role`).
    """

    screened: ClassVar = {
        "md": " ".join(("precision", *(f"precision.{role}" for role in ROLES["md"])))
        + " precision.force=bfloat16",
        "ball": " ".join(
            f"{family}={dtype}"
            for family in ("precision", *(f"precision.{role}" for role in ROLES["ball"]))
            for dtype in ALL
        ),
    }
    # "state", "force" (of a ball "arithmetic"), "decision" or "accumulate"; None for all of a ball, for all
    # but the state of molecular dynamics, of which sixteen bits are for the force
    role: str | None = None
    dtype: str = "float32"  # "float64", "float32", "float16" or "bfloat16"

    def __post_init__(self):
        known = dict.fromkeys((*ROLES["md"], *ROLES["ball"]))
        check(
            self.role is None or self.role in known,
            f"no role {self.role!r}; there are {', '.join(known)}",
            "precision",
            "Write precision, or precision.state=bfloat16",
        )
        check(self.dtype in ALL, f"unknown dtype {self.dtype!r}; expected one of {', '.join(ALL)}", self.name)

    @property
    def name(self) -> str:
        """Text form of the numerical choice, such as "precision" or "precision.force=float64"."""
        base = self.family if self.role is None else f"{self.family}.{self.role}"
        return base if self.dtype == "float32" else f"{base}={self.dtype}"

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        return cls(role or None, argument or "float32")

    def _roles(self, world: str) -> tuple[str, ...]:
        if self.role is not None:
            return (self.role,)
        return ("force",) if world == "md" and self.dtype not in WIDE else _DEFAULT[world]

    def describe(self, world: str = "md") -> str:
        return f"{', '.join(self._roles(world))} in {self.dtype}"

    def make(self, system: Any) -> Twin:
        world = world_of(system)
        own = system.policy if world == "md" else system.spec.precision
        roles = self._roles(world)
        missing = [role for role in roles if role not in ROLES[world]]
        applies(not missing, f"it has no role {'.'.join(missing)}; there are {', '.join(ROLES[world])}")
        if world == "md":
            wide = system.pairwise or self.dtype in WIDE
            applies(wide, "many-body potentials are evaluated in float64 and float32 only")
        before = {getattr(own, role) for role in roles}
        verb = "is" if len(roles) == 1 else "are"
        applies(before != {self.dtype}, f"{', '.join(roles)} {verb} {self.dtype} already")
        if world == "md":
            for role in roles:
                check_role(role, self.dtype)
        elif roles == ("accumulate",):
            sums_residuals(system)
        values = {f"precision.{role}": self.dtype for role in roles}
        return twin(system, values, self.name, f"{self.describe(world)}, not {', '.join(sorted(before))}")


@choice("reduction")
class Summation(Choice):
    """Another order of a sum of forces, or of residuals in a stopping criterion."""

    screened = " ".join(f"reduction={word}" for word in reductions.BY_NAME)
    shown = True
    word: str = "exact"  # as `mdnum.numerics.reductions.parse` reads it: "exact", "permuted:3", "blocked:8"

    def __post_init__(self):
        reductions.parse(self.word)

    def describe(self, world: str = "md") -> str:
        return f"{'force sums' if world == 'md' else 'the residuals of all balls summed'} {self.word}"

    def make(self, system: Any) -> Twin:
        if world_of(system) == "md":
            from mdnum.systems.describe import reduction_word

            before, b = reduction_word(system.reduction), summed(system, self.word)
            applies(b.reduction != system.reduction, f"the system sums {self.word} already")
            return simulations(system, b, f"force sums {self.word}, not {before}")
        before = system.spec.precision.reduction
        sums_residuals(system)
        applies(system.balls > 1, "the residual of one ball is not a sum")
        applies(self.word != before, f"the system sums {self.word} already")
        values = {"precision.reduction": self.word}
        return twin(system, values, self.name, f"residuals summed {self.word}, not {before}")


def sums_residuals(system: Any) -> None:
    """Raise an `InputError` unless a ball solver sums residuals over several balls."""
    stop = system.spec.stop
    applies(stop is not None, "its steps use no solver, so there is no residual to sum")
    reason = f"its solver is stopped by the rule {stop.rule}, which sums nothing"
    applies(isinstance(stop, SumRule | RelativeRule), reason)


# --- what lists hold, in which order --------------------------------------------------------------------


@choice("order")
class Order(Summed):
    """The neighbors of each atom, or the balls, in another order.

    For balls, both runs can have exact sums ("exact") or a separate stop per ball ("alone").
    """

    worlds = ("md", "ball")
    screened: ClassVar = {
        "md": "order order@exact order@fixed-point",
        "ball": "order order@exact order@alone",
    }
    seed: int = 1  # of the shuffle

    def __post_init__(self):
        if self.both != "alone":
            super().__post_init__()
        check(self.seed >= 0, f"seed {self.seed} is negative", "order")

    @property
    def must_hold(self) -> bool:  # type: ignore[override]
        """True if sums do not depend on order, or each ball stops separately."""
        return self.both in (*ORDERLESS, "alone")

    def describe(self, world: str = "md") -> str:
        if world == "md":
            return "neighbors of each atom shuffled" + summing(self.both)
        both = {
            "exact": ", both runs with exact sums of residuals",
            "alone": ", each ball stopped by itself in both runs",
        }
        return f"the balls of the batch in another order{both.get(self.both or '', '')}"

    def make(self, system: Any) -> Twin:
        if world_of(system) == "ball":
            return self._of_balls(system)
        from mdnum.forks.reordered import ReorderedSimulation

        applies(self.both != "alone", "@alone is for balls")
        a = summed(system, self.both)
        b = ReorderedSimulation.of(a, self.seed)
        return self.twin(a, b, f"neighbors of each atom shuffled with seed {self.seed}")

    def _of_balls(self, system: Any) -> Twin:
        applies(self.both in (None, "exact", "alone"), "for a ball, there are order@exact and order@alone")
        applies(system.balls > 1, "there is one ball")
        own, stop, difference = (
            system.spec.precision.reduction,
            system.spec.stop,
            "the balls in another order",
        )
        if self.both == "alone":
            reason = "its tolerance is a share of the first residual of all balls"
            applies(not isinstance(stop, RelativeRule), reason)
            if isinstance(stop, SumRule | MaximumRule):
                system = varied(system, {"stop.rule": "per-instance"}, self.name)
                difference += " (both with each ball stopped by itself)"
        else:
            try:
                sums_residuals(system)
            except InputError as error:
                rest = "" if self.both else ": order@alone must hold"
                raise InputError(error.message + rest) from None
            without = own.partition(":")[0] in (*ORDERLESS, "sorted")
            reason = f"sums are {own} and do not depend on the order: order@exact must hold"
            applies(self.both is not None or not without, reason)
            if self.both == "exact" and own != "exact":
                system = varied(system, {"precision.reduction": "exact"}, self.name)
                difference += " (both with exact sums)"
        a: Any = program_of(system)
        rng = np.random.default_rng(self.seed)
        order = rng.permutation(system.balls)
        while np.array_equal(order, np.arange(system.balls)):
            order = rng.permutation(system.balls)
        start = {}
        for name in ("y0", "v0"):
            value = np.asarray(getattr(a.problem, name))
            start[name] = value[order] if value.ndim == 1 and value.size > 1 else value
        b = replace(a, problem=replace(a.problem, **start), order=tuple(order.tolist()))
        return Twin(a, b, difference)


@choice("format")
class FormatChoice(Summed):
    """Forces added in the order of another neighbor-list format."""

    screened = "format=dense format=sparse format=ordered-sparse format=ordered-sparse@exact"
    shown = True
    word: str = "ordered-sparse"  # "dense", "sparse" or "ordered-sparse", as jax-md names its formats

    def __post_init__(self):
        super().__post_init__()
        check(self.word in FORMATS, f"no format {self.word!r}; there are {', '.join(FORMATS)}", "format")

    def describe(self, world: str = "md") -> str:
        return f"pair terms added in the order of {self.word} lists{summing(self.both)}"

    def make(self, system: Simulation) -> Twin:
        from mdnum.forks.reordered import ReorderedSimulation
        from mdnum.systems.describe import reduction_word

        a, own = summed(system, self.both), reduction_word(system.reduction)
        if self.both is None:
            applies(system.pairwise, "a many-body potential has a format of its own")
            applies(own == "sequential", f"a format is an order of sequential sums, but sums are {own} here")
        b = ReorderedSimulation.of(a, self.word)
        return self.twin(a, b, f"pair terms in the order of {self.word} lists, not of the search's")


@choice("builder")
class Builder(Summed):
    """Neighbor lists built by another neighbor search."""

    screened = "builder builder@exact"
    word: str | None = None  # "host" or "jax-md"; None for the one that the system does not use

    def __post_init__(self):
        from mdnum.md.neighbors import BUILDERS

        super().__post_init__()
        known = f"no list builder {self.word!r}; there are {', '.join(BUILDERS)}"
        check(self.word is None or self.word in BUILDERS, known, "builder")

    def make(self, system: Simulation) -> Twin:
        from mdnum.md.neighbors import BUILDERS

        a = summed(system, self.both)
        word = self.word or next(name for name in BUILDERS if name != a.builder)
        applies(word != a.builder, f"the lists are {word}'s already")
        b = summed(varied(system, {"neighbors.builder": word}), self.both)
        return self.twin(a, b, f"lists by {word}, not {a.builder}")


@choice("skin")
class Skin(Summed):
    """Another skin width of the neighbor lists."""

    screened = "skin skin@exact"
    # of the skin; None for half as much again, or three quarters where the box has no room
    length: float | None = None

    def __post_init__(self):
        super().__post_init__()
        good = self.length is None or self.length >= 0
        check(good, f"skin = {self.length}; expected a length of 0 or more", "skin")

    def make(self, system: Simulation) -> Twin:
        a, own, length = summed(system, self.both), system.rule.skin, self.length
        if length is None:
            room = float(np.min(a.cell.widths)) / 2 - a.r_cut
            length = 1.5 * own if 1.5 * own <= room else 0.75 * own
        applies(length != own, f"the skin is {own:g} already")
        b = summed(varied(system, {"neighbors.skin": length}), self.both)
        return self.twin(a, b, f"skin {length:g}, not {own:g}")


@choice("rebuild")
class RebuildChoice(Summed):
    """Another rule for when a neighbor list is rebuilt."""

    screened = "rebuild=every:1 rebuild=every:10 rebuild=half-skin rebuild=every:1@exact"
    # rebuild blindly every so many steps; None: when an atom has moved by half the skin
    every: int | None = 1

    def __post_init__(self):
        super().__post_init__()
        good = self.every is None or self.every >= 1
        check(good, f"every {self.every} steps; expected at least 1", "rebuild")

    @property
    def argument(self) -> str:
        return "half-skin" if self.every is None else f"every:{self.every}"

    @property
    def must_hold(self) -> bool:  # type: ignore[override]
        """True if sums do not depend on order, and lists contain all pairs inside the cutoff."""
        return super().must_hold and self.every in (1, None)

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        rule, _, count = argument.partition(":")
        check(rule in ("", "half-skin", "every"), f"no rule {argument!r}", "rebuild",
              "Write every:10 or half-skin")  # fmt: skip
        return cls(both, number(count, int, "rebuild") if rule == "every" else None if rule else 1)

    def describe(self, world: str = "md") -> str:
        return f"lists rebuilt {self._when}{summing(self.both)}"

    @property
    def _when(self) -> str:
        if self.every is None:
            return "when half the skin is used up"
        return "at every step" if self.every == 1 else f"blindly every {self.every} steps"

    def make(self, system: Simulation) -> Twin:
        own, every = system.rule, self.every or 1
        # where nothing is checked, a delay holds back a rebuild like an interval does
        same = own.check and own.delay <= 1 if self.every is None else not own.check and own.delay <= every
        applies(not (same and own.every == every), f"lists are rebuilt {self._when} already")
        rule = {"every": every, "delay": 0, "check": self.every is None}
        other = varied(system, {f"neighbors.rebuild.{key}": value for key, value in rule.items()})
        return self.twin(summed(system, self.both), summed(other, self.both), f"lists rebuilt {self._when}")
