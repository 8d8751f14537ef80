"""Choices of order: of the neighbors of an atom, of the balls of a batch, of how and when they are listed.

None of them changes which pairs interact, as long as a list is rebuilt before its skin is used up; they
change the order in which forces are summed. With sums that have no order they must change nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.choices.arithmetic import nothing_summed
from mdnum.forks.choices.base import (
    ORDERLESS,
    Choice,
    built,
    choice,
    is_pairwise,
    no_sums,
    number,
    simulations,
    summing,
    world_of,
)
from mdnum.forks.worlds import program_of, varied
from mdnum.numerics import reductions
from mdnum.program import Twin
from mdnum.systems import System
from mdnum.systems.ball import MaximumRule, RelativeRule, SumRule

#: As jax-md names its formats.
FORMATS = ("dense", "sparse", "ordered-sparse")


@choice(None)
class Summed(Choice):
    """A choice whose two runs may both be given a reduction: with one that has no order, it must hold.

    Attributes:
        both: reduction of both runs; None for the system's own.
    """

    worlds = ("md",)
    both: str | None = None

    def __post_init__(self):
        if self.both is not None:
            reductions.parse(self.both)

    @property
    def must_hold(self) -> bool:  # type: ignore[override]
        """Sums without an order cannot tell."""
        return self.both in ORDERLESS

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls(), cls(both="exact")]

    def reason_unavailable(self, system: Any) -> str | None:
        return no_sums(system, self.both)


@choice("order")
class Order(Summed):
    """The neighbors of each atom, or the balls of the batch, in another order.

    Attributes:
        both: reduction of both runs; of a ball "exact" sums of residuals, or "alone": each ball stopped by
            itself; None for the system's own.
        seed: of the shuffle.
    """

    worlds = ("md", "ball")
    seed: int = 1

    def __post_init__(self):
        if self.both not in (None, "alone"):
            reductions.parse(self.both or "")
        if self.seed < 0:
            raise InputError(f"seed {self.seed} is negative", where="order")

    @property
    def must_hold(self) -> bool:  # type: ignore[override]
        """Sums without an order, and balls that hear nothing of each other, cannot tell."""
        return self.both in (*ORDERLESS, "alone")

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls(), *(cls(both) for both in (ORDERLESS if world == "md" else ("exact", "alone")))]

    def describe(self, world: str = "md") -> str:
        if world == "md":
            return "neighbors of each atom shuffled" + summing(self.both)
        both = {
            None: "",
            "exact": ", both runs with exact sums of residuals",
            "alone": ", each ball stopped by itself in both runs",
        }
        return f"the balls of the batch in another order{both.get(self.both, '')}"

    def reason_unavailable(self, system: Any) -> str | None:
        if world_of(system) == "md":
            return "@alone is for balls" if self.both == "alone" else no_sums(system, self.both)
        if self.both not in (None, "exact", "alone"):
            return "of a ball there are order@exact and order@alone"
        if system.balls == 1:
            return "there is one ball"
        if self.both == "alone":
            relative = isinstance(system.spec.stop, RelativeRule)
            return "its tolerance is a share of the first residual of all balls" if relative else None
        reason = nothing_summed(system)
        if reason is not None:
            return f"{reason}: order@alone must hold" if self.both is None else reason
        own = system.spec.precision.reduction
        if self.both is None and own.partition(":")[0] in (*ORDERLESS, "sorted"):
            return f"sums are {own}, which have no order: order@exact must hold"
        return None

    def make(self, system: Any) -> Twin:
        if world_of(system) == "md":
            from mdnum.forks.reordered import ShuffledSimulation

            a = built(system, self.both)
            difference = f"neighbors of each atom shuffled with seed {self.seed}{summing(self.both)}"
            return simulations(a, ShuffledSimulation.of(a, self.seed), difference)
        difference = "the balls in another order"
        if self.both == "exact" and system.spec.precision.reduction != "exact":
            system = varied(system, {"precision.reduction": "exact"}, self.name)
            difference += " (both with exact sums)"
        elif self.both == "alone" and isinstance(system.spec.stop, SumRule | MaximumRule):
            system = varied(system, {"stop.rule": "per-instance"}, self.name)
            difference += " (both with each ball stopped by itself)"
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
    """The neighbors of each atom in the order in which another format of the list adds them.

    Attributes:
        both: reduction of both runs; None for the system's own.
        word: "dense", "sparse" or "ordered-sparse", as jax-md names its formats.
    """

    shown = True
    word: str = "ordered-sparse"

    def __post_init__(self):
        super().__post_init__()
        if self.word not in FORMATS:
            raise InputError(f"no format {self.word!r}; there are {', '.join(FORMATS)}", where="format")

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [*(cls(word=word) for word in FORMATS), cls("exact")]

    def describe(self, world: str = "md") -> str:
        return f"pair terms added in the order of {self.word} lists{summing(self.both)}"

    def reason_unavailable(self, system: System) -> str | None:
        reason = no_sums(system, self.both)
        if reason is not None or self.both is not None:
            return reason
        if not is_pairwise(system):
            return "a many-body potential has a format of its own"
        reduction = system.spec.precision.reduction
        if reduction != "sequential":
            return f"a format is the order of a loop, and sums are {reduction} here"
        return None

    def make(self, system: System) -> Twin:
        from mdnum.forks.reordered import FormattedSimulation

        a = built(system, self.both)
        difference = f"pair terms in the order of {self.word} lists, not of the search's{summing(self.both)}"
        return simulations(a, FormattedSimulation.of(a, self.word), difference)


@choice("builder")
class Builder(Summed):
    """Lists by another search for neighbors.

    Attributes:
        both: reduction of both runs.
        word: "host" or "jax-md"; None for the one that the system does not use.
    """

    word: str | None = None

    def __post_init__(self):
        from mdnum.md.neighbors import BUILDERS

        super().__post_init__()
        if self.word is not None and self.word not in BUILDERS:
            raise InputError(
                f"no list builder {self.word!r}; there are {', '.join(BUILDERS)}", where="builder"
            )

    def reason_unavailable(self, system: System) -> str | None:
        if self.word is not None and built(system).builder == self.word:
            return f"the lists are {self.word}'s already"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        from mdnum.md.neighbors import BUILDERS

        a = built(system, self.both)
        word = self.word or next(name for name in BUILDERS if name != a.builder)
        b = built(varied(system, {"neighbors.builder": word}), self.both)
        return simulations(a, b, f"lists by {word}, not {a.builder}{summing(self.both)}")


@choice("skin")
class Skin(Summed):
    """Another skin: more or fewer pairs that do not interact, found at other times.

    Attributes:
        both: reduction of both runs.
        length: of the skin; None for half as much again, or three quarters where the box has no room.
    """

    length: float | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.length is not None and not self.length >= 0:
            raise InputError(f"skin = {self.length:g}; expected a length of 0 or more", where="skin")

    def _length(self, system: System) -> float:
        if self.length is not None:
            return self.length
        a = built(system)
        room = float(np.min(a.cell.widths)) / 2 - a.r_cut
        own = system.spec.skin
        return 1.5 * own if 1.5 * own <= room else 0.75 * own

    def reason_unavailable(self, system: System) -> str | None:
        if self._length(system) == system.spec.skin:
            return f"the skin is {system.spec.skin:g} already"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        length = self._length(system)
        b = built(varied(system, {"neighbors.skin": length}), self.both)
        difference = f"skin {length:g}, not {system.spec.skin:g}{summing(self.both)}"
        return simulations(built(system, self.both), b, difference)


@choice("rebuild")
class RebuildChoice(Summed):
    """Another rule for when a list is rebuilt.

    Attributes:
        both: reduction of both runs.
        every: rebuild blindly every so many steps; None: when an atom has moved by half the skin.
    """

    every: int | None = 1

    def __post_init__(self):
        super().__post_init__()
        if self.every is not None and self.every < 1:
            raise InputError(f"every {self.every} steps; expected at least 1", where="rebuild")

    @property
    def argument(self) -> str:
        return "half-skin" if self.every is None else f"every:{self.every}"

    @property
    def must_hold(self) -> bool:  # type: ignore[override]
        """A list that is always fresh, or rebuilt in time, holds the pairs; a blind one may lose some."""
        return super().must_hold and self.every in (1, None)

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        if argument in ("", "half-skin"):
            return cls(both, None if argument else 1)
        rule, _, count = argument.partition(":")
        if rule != "every":
            raise InputError(f"no rule {argument!r}", where="rebuild", remedy="Write every:10 or half-skin")
        return cls(both, number(count, int, "rebuild"))

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [*(cls(every=every) for every in (1, 10, None)), cls("exact")]

    def describe(self, world: str = "md") -> str:
        return f"lists rebuilt {self._words}{summing(self.both)}"

    @property
    def _words(self) -> str:
        if self.every is None:
            return "when half the skin is used up"
        return "at every step" if self.every == 1 else f"blindly every {self.every} steps"

    def reason_unavailable(self, system: System) -> str | None:
        rule = system.spec.neighbors.rebuild
        # where nothing is checked, a delay holds back a rebuild like an interval does
        same = rule.check if self.every is None else not rule.check and rule.delay <= self.every
        if same and rule.every == (self.every or 1) and (self.every is not None or rule.delay <= 1):
            return f"lists are rebuilt {self._words} already"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        rule = {"every": self.every or 1, "delay": 0, "check": self.every is None}
        other = varied(system, {f"neighbors.rebuild.{key}": value for key, value in rule.items()})
        return simulations(built(system, self.both), built(other, self.both), self.describe())
