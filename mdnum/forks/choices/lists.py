"""Choices of the neighbor list: the order of its pairs, who searches, how far, and when anew.

None of them changes which pairs interact, as long as a list is rebuilt before its skin is used up; they
change the order in which forces are summed. With sums that have no order they must change nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.choices.arithmetic import orderless
from mdnum.forks.choices.base import built, check, no_sums, suffix, summing, varied
from mdnum.forks.twin import Twin
from mdnum.md.verlet import BUILDERS, ListBuilder, VerletList
from mdnum.systems.build import Simulation, build
from mdnum.systems.load import System


@dataclass(frozen=True)
class ShuffledBuilder:
    """A neighbor search whose rows are shuffled, each atom's in its own way.

    Attributes:
        inner: who searches.
        seed: of the shuffle; every list of a run is shuffled with it anew.
    """

    inner: ListBuilder
    seed: int

    @property
    def name(self) -> str:
        """The inner search's word."""
        return self.inner.name

    def build(self, positions, cell, r_list, slots):
        """The inner search's table with the neighbors of each atom in another order, padding at the end."""
        table, order, most = self.inner.build(positions, cell, r_list, slots)
        atoms = table.shape[1]
        keys = np.random.default_rng(self.seed).random(table.shape)
        keys[table == atoms] = 2.0
        return np.take_along_axis(table, np.argsort(keys, axis=0, kind="stable"), axis=0), order, most


@dataclass(frozen=True)
class ShuffledSimulation(Simulation):
    """A simulation whose lists hold their pairs in another order.

    Attributes:
        shuffle: seed of that order.
    """

    shuffle: int = 0

    @classmethod
    def of(cls, simulation: Simulation, seed: int) -> ShuffledSimulation:
        """A simulation with shuffled lists."""
        same = {field.name: getattr(simulation, field.name) for field in fields(Simulation)}
        return cls(**same, shuffle=seed)

    @property
    def lists(self):
        """Shuffled lists are other lists."""
        return (*super().lists, self.shuffle)

    def verlet_list(self, skin: float | None = None) -> VerletList:
        """As the simulation's own, shuffled."""
        made = super().verlet_list(skin)
        made.builder = ShuffledBuilder(made.builder, self.shuffle)
        return made


@dataclass(frozen=True)
class Order:
    """The neighbors of each atom in another order.

    Attributes:
        seed: of the shuffle.
        both: reduction of both runs; None for the system's own.
    """

    seed: int = 1
    both: str | None = None

    @property
    def name(self) -> str:
        """Such as "order" or "order=3@exact"."""
        return ("order" if self.seed == 1 else f"order={self.seed}") + suffix(self.both)

    @property
    def about(self) -> str:
        """One line."""
        return "neighbors of each atom shuffled" + summing(self.both)

    @property
    def must_hold(self) -> bool:
        """Sums without an order cannot tell."""
        return orderless(self.both)

    def why_not(self, system: System) -> str | None:
        """It always applies, unless a reduction is asked for that cannot be had."""
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        """The system, and with shuffled lists."""
        check(self, system)
        a = built(system, self.both)
        words = f"neighbors of each atom shuffled with seed {self.seed}{summing(self.both)}"
        return Twin(a, ShuffledSimulation.of(a, self.seed), words)


@dataclass(frozen=True)
class Builder:
    """Another search for neighbors.

    Attributes:
        word: "host" or "jax-md"; None for the one that the system does not use.
        both: reduction of both runs.
    """

    word: str | None = None
    both: str | None = None

    def __post_init__(self):
        if self.word is not None and self.word not in BUILDERS:
            raise InputError(
                f"no list builder {self.word!r}; there are {', '.join(BUILDERS)}", where="builder"
            )

    @property
    def name(self) -> str:
        """Such as "builder" or "builder=jax-md"."""
        return ("builder" if self.word is None else f"builder={self.word}") + suffix(self.both)

    @property
    def about(self) -> str:
        """One line."""
        return "lists by another search" + summing(self.both)

    @property
    def must_hold(self) -> bool:
        """Both searches find the pairs that interact; only their order differs."""
        return orderless(self.both)

    def why_not(self, system: System) -> str | None:
        """The system may have that builder already."""
        if self.word is not None and build(system).builder == self.word:
            return f"the lists are {self.word}'s already"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        """The system, and with the other search."""
        check(self, system)
        a = built(system, self.both)
        word = self.word or next(name for name in BUILDERS if name != a.builder)
        b = built(varied(system, {"neighbors.builder": word}), self.both)
        return Twin(a, b, f"lists by {word}, not {a.builder}{summing(self.both)}")


@dataclass(frozen=True)
class Skin:
    """Another skin.

    Attributes:
        length: of the skin; None for half as much again, or three quarters where the box has no room.
        both: reduction of both runs.
    """

    length: float | None = None
    both: str | None = None

    def __post_init__(self):
        if self.length is not None and not self.length >= 0:
            raise InputError(f"skin = {self.length:g}; expected a length of 0 or more", where="skin")

    @property
    def name(self) -> str:
        """Such as "skin" or "skin=0.5@exact"."""
        return ("skin" if self.length is None else f"skin={self.length:g}") + suffix(self.both)

    @property
    def about(self) -> str:
        """One line."""
        return "another skin of the lists" + summing(self.both)

    @property
    def must_hold(self) -> bool:
        """More or fewer pairs that do not interact, found at other times."""
        return orderless(self.both)

    def _asked(self, system: System) -> float:
        if self.length is not None:
            return self.length
        a = build(system)
        room = float(np.min(a.cell.widths)) / 2 - a.r_cut
        own = system.spec.skin
        return 1.5 * own if 1.5 * own <= room else 0.75 * own

    def why_not(self, system: System) -> str | None:
        """The system may have that skin already, or rebuild its lists too late for any."""
        if self._asked(system) == system.spec.skin:
            return f"the skin is {system.spec.skin:g} already"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        """The system, and with the other skin."""
        check(self, system)
        asked = self._asked(system)
        b = built(varied(system, {"neighbors.skin": asked}), self.both)
        words = f"skin {asked:g}, not {system.spec.skin:g}{summing(self.both)}"
        return Twin(built(system, self.both), b, words)


@dataclass(frozen=True)
class Rebuild:
    """Another rule for when a list is rebuilt.

    Attributes:
        every: rebuild blindly every so many steps; None: when an atom has moved by half the skin.
        both: reduction of both runs.
    """

    every: int | None = 1
    both: str | None = None

    def __post_init__(self):
        if self.every is not None and self.every < 1:
            raise InputError(f"every {self.every} steps; expected at least 1", where="rebuild")

    @property
    def name(self) -> str:
        """Such as "rebuild=every:1" or "rebuild=half-skin"."""
        word = "half-skin" if self.every is None else f"every:{self.every}"
        return f"rebuild={word}{suffix(self.both)}"

    @property
    def about(self) -> str:
        """One line."""
        return f"lists rebuilt {self._words}{summing(self.both)}"

    @property
    def _words(self) -> str:
        if self.every is None:
            return "when half the skin is used up"
        return "at every step" if self.every == 1 else f"blindly every {self.every} steps"

    @property
    def must_hold(self) -> bool:
        """A list that is always fresh, or rebuilt in time, holds the pairs; a blind one may lose some."""
        return orderless(self.both) and self.every in (1, None)

    def why_not(self, system: System) -> str | None:
        """The system may have that rule already."""
        rule = system.spec.neighbors.rebuild
        # where nothing is checked, a delay holds back a rebuild like an interval does
        same = rule.check if self.every is None else not rule.check and rule.delay <= self.every
        if same and rule.every == (self.every or 1) and (self.every is not None or rule.delay <= 1):
            return f"lists are rebuilt {self._words} already"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        """The system, and with the other rule."""
        check(self, system)
        rule = {"every": self.every or 1, "delay": 0, "check": self.every is None}
        other = varied(system, {f"neighbors.rebuild.{key}": value for key, value in rule.items()})
        words = f"lists rebuilt {self._words}{summing(self.both)}"
        return Twin(built(system, self.both), built(other, self.both), words)
