"""Choices that physics cannot tell: other labels, another origin, other axes, other images of the atoms."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.forks.choices.base import (
    Choice,
    built,
    choice,
    is_langevin,
    no_sums,
    number,
    simulations,
    summing,
)
from mdnum.forks.choices.lists import Summed
from mdnum.program import Twin
from mdnum.systems import System

#: Exchanges of axes, half turns about one, and the inversion that every box has.
_SYMMETRIES = ("yzx", "yxz", "xzy", "zyx", "-x-yz", "x-y-z", "-xy-z", "-x-y-z")
_AXES = re.compile(r"(?!.*([xyz]).*\1)(-?[xyz]){3}")


def _frame(simulation: Any, **parts: Any) -> Any:
    from mdnum.rollout.compared import ReferenceFrame

    return replace(ReferenceFrame.same(simulation.atoms), **parts)


@choice("relabel")
class Relabel(Summed):
    """The atoms in another order of the file.

    Attributes:
        both: reduction of both runs.
        seed: of the permutation.
    """

    seed: int = 1

    def reason_unavailable(self, system: System) -> str | None:
        if is_langevin(system):
            return "the thermostat's noise belongs to labels: other atoms would get it"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        a = built(system, self.both)
        labels = np.random.default_rng(self.seed).permutation(a.atoms)
        b = built(replace(system, atoms=system.atoms[labels]), self.both)
        # drawn velocities would go by label, and a drift taken out would be rounded in another order
        b = replace(b, positions=a.positions[labels], velocities=a.velocities[labels])
        difference = f"atoms in another order, seed {self.seed}{summing(self.both)}"
        return simulations(a, b, difference, _frame(a, labels=labels))


@choice("rotate")
class Rotate(Summed):
    """The axes of the box exchanged or turned around.

    An exchange is exact, but squares of components are added in another order. Where a sign changes, the
    start is rounded once as it is wrapped.

    Attributes:
        both: reduction of both runs.
        axes: what stands in place of xyz: axis k of the second run is the k-th axis named, of the first, with
            its sign ("yzx", "-x-yz"); None: the first of these that leaves the box as it is, all three in
            turn where it can be, the inversion "-x-y-z" where nothing else does.
    """

    must_hold = False  # type: ignore[assignment]
    axes: str | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.axes is not None and (not _AXES.fullmatch(self.axes) or self.axes == "xyz"):
            raise InputError(
                f"axes {self.axes!r}; expected another order of xyz, with or without signs (yzx, -x-yz)",
                where="rotate",
            )

    def _symmetry(self, system: System) -> str | None:
        pbc = np.asarray(system.atoms.pbc)
        rows = {tuple(row) for row in np.asarray(system.atoms.cell)[pbc].tolist()}
        both_ways = rows | {tuple(-c for c in row) for row in rows}
        for word in _SYMMETRIES if self.axes is None else (self.axes,):
            axes, signs = _read(word)
            # a lattice vector is as good as its negative
            turned = {tuple(sign * row[k] for k, sign in zip(axes, signs, strict=True)) for row in rows}
            if turned <= both_ways:
                return word
        return None

    def reason_unavailable(self, system: System) -> str | None:
        if is_langevin(system):
            return "the thermostat's noise belongs to axes: others would get it"
        if self._symmetry(system) is None:
            return f"the box is not the same with axes {self.axes} in place of xyz"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        word = self._symmetry(system)
        assert word is not None
        a = built(system, self.both)
        axes, signs = (np.array(part) for part in _read(word))
        b = replace(a, positions=a.positions[:, axes] * signs, velocities=a.velocities[:, axes] * signs)
        back = np.argsort(axes)
        frame = _frame(a, axes=back, signs=signs[back])
        return simulations(a, b, f"axes {word} in place of xyz{summing(self.both)}", frame)


def _read(word: str) -> tuple[list[int], list[float]]:
    """Which axis stands in each place, and with which sign."""
    parts = re.findall("-?[xyz]", word)
    return ["xyz".index(part[-1]) for part in parts], [-1.0 if part[0] == "-" else 1.0 for part in parts]


@choice("translate")
class Translate(Summed):
    """Everything moved by a share of the lattice vectors: coordinates of another size are rounded otherwise.

    Attributes:
        both: reduction of both runs.
        share: of each periodic lattice vector.
    """

    must_hold = False  # type: ignore[assignment]
    shown = True
    share: float = 0.25

    def __post_init__(self):
        super().__post_init__()
        if not np.isfinite(self.share) or self.share == 0:
            raise InputError(f"a share of {self.share:g}; expected a number other than 0", where="translate")

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        if argument == "lattice" and both is None:
            return Images()
        return cls(both, number(argument, float, "translate") if argument else 0.25)

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls(), Images()]

    def describe(self, world: str = "md") -> str:
        return f"moved by {self.share:g} of each lattice vector{summing(self.both)}"

    def reason_unavailable(self, system: System) -> str | None:
        if not any(system.atoms.pbc):
            return "no axis is periodic"
        return no_sums(system, self.both)

    def make(self, system: System) -> Twin:
        a = built(system, self.both)
        shift = self.share * np.asarray(a.cell.matrix)[list(a.cell.pbc)].sum(axis=0)
        b = replace(a, positions=a.positions + shift)
        return simulations(a, b, self.describe(), _frame(a, shift=shift))


@choice("unwrapped")
class Images(Choice):
    """Atoms started in other images of the box.

    Positions are wrapped before the first step, so this cannot change a bit, as long as the images can be
    written down: the sum of a position and a lattice vector is rounded. Both runs start where that sum is
    exact, within an ulp of a lattice vector from the file's positions.

    Attributes:
        seed: of a random image of each atom, one lattice vector away at most; None: every atom one lattice
            vector further along every periodic axis.
    """

    worlds = ("md",)
    must_hold = True
    seed: int | None = None

    @property
    def name(self) -> str:
        """ "translate=lattice", "unwrapped" or "unwrapped=3"."""
        if self.seed is None:
            return "translate=lattice"
        return self.family if self.seed == 1 else f"{self.family}={self.seed}"

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        return cls(number(argument, int, "unwrapped") if argument else 1)

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        return [cls(1)]

    def describe(self, world: str = "md") -> str:
        if self.seed is None:
            return "moved by every lattice vector, exactly"
        return "started from unwrapped positions, exactly"

    def reason_unavailable(self, system: System) -> str | None:
        if not any(system.atoms.pbc):
            return "no axis is periodic"
        _, _, lost = self._starts(built(system))
        if lost:
            return f"{lost} atoms have no position near theirs whose image is exact in float64"
        return None

    def _starts(self, a: Any) -> tuple[np.ndarray, np.ndarray, int]:
        if self.seed is None:
            images = np.ones(a.positions.shape, np.int64)
        else:
            images = np.random.default_rng(self.seed).integers(-1, 2, a.positions.shape)
        return exact_images(a.cell, a.positions, images * np.array(a.cell.pbc))

    def make(self, system: System) -> Twin:
        a = built(system)
        wrapped, elsewhere, _ = self._starts(a)
        return simulations(replace(a, positions=wrapped), replace(a, positions=elsewhere), self.describe())


def exact_images(
    cell: Any, positions: Float[np.ndarray, "atoms 3"], images: Int[np.ndarray, "atoms 3"]
) -> tuple[Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"], int]:
    """Wrapped positions near given ones, the same in other images, and how many atoms have none.

    Wrapping the second gives the first, bit for bit. In a box along the axes a position whose image was
    rounded has an exact one (Sterbenz's lemma: the lattice vector is taken off again without rounding); a
    second turn is needed only where the first crosses a face.
    """
    from mdnum.md.cell import wrap_positions

    wrapped, _ = wrap_positions(cell, positions)
    moved = images @ np.asarray(cell.matrix)
    elsewhere = wrapped + moved
    for _ in range(4):
        wrapped, _ = wrap_positions(cell, elsewhere)
        elsewhere = wrapped + moved
    again, _ = wrap_positions(cell, elsewhere)
    return wrapped, elsewhere, int((again != wrapped).any(axis=1).sum())
