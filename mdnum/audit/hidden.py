"""Jumps of the energy of a run where no pair threshold is: a cap on neighbors, a choice of the nearest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import Subject, meter_of
from mdnum.audit.nve import Run, at

#: Halvings of a step's way: what is left of it then is a millionth of an Å.
_LEVELS = 15
#: After this many, a force that is no gradient has spread over sixteen parts, a jump is still in one.
_SPREAD_AT = 4
#: Of the largest: a part with less than this is not followed. Of a spread each of sixteen has less.
_FOLLOWED = 0.15
#: Of what a step leaves unexplained: above, its jumps explain it.
_MOSTLY = 0.5
#: Steps that are looked at, at most.
_MOST_STEPS = 40
#: Calls after which no further step is looked at.
_CALLS = 800
#: Of kT: what a step leaves unexplained below this is not looked at.
_SMALL = 1e-6


@dataclass(frozen=True)
class Jump:
    """A place on the straight way of a step at which the energy jumps.

    Attributes:
        step: at its end.
        share: of the way.
        energy: after minus before, without the work done between, eV.
        ties: (atom, k) whose k-th and next neighbors change places there.
    """

    step: int
    share: float
    energy: float
    ties: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Hidden:
    """What the steps of a run whose energy does not add up hide.

    Attributes:
        jumps: found in the steps that were looked at.
        steps: those, with what they left unexplained, eV.
        candidates: steps that leave more unexplained than noise does.
    """

    jumps: tuple[Jump, ...] = ()
    steps: Mapping[int, float] | None = None
    candidates: tuple[int, ...] = ()

    @property
    def share(self) -> float:
        """Of what those steps leave unexplained, the part that is jumps."""
        rests = self.steps or {}
        whole = sum(abs(rest) for rest in rests.values())
        left = sum(abs(rest - brought) for rest, brought in ((rests[n], self.brought(n)) for n in rests))
        return max(1.0 - left / whole, 0.0) if whole else 0.0

    def brought(self, step: int) -> float:
        """Energy that the jumps found in a step brought, eV."""
        return sum(jump.energy for jump in self.jumps if jump.step == step)

    def energies(self, rest: Float[np.ndarray, "steps"]) -> Float[np.ndarray, "steps"]:
        """Energy that such jumps brought, by step; by their share where a step was not looked at, eV.

        Args:
            rest: what each step leaves unexplained, nan where that is not known.
        """
        found = np.zeros(len(rest))
        for step in self.candidates:
            looked = self.steps is not None and step in self.steps
            found[step] = self.brought(step) if looked else self.share * rest[step]
        return found

    @property
    def rank(self) -> tuple[int, int] | None:
        """(k, at how many jumps the k-th and next neighbors change places), the most frequent k."""
        counts = Counter(k for jump in self.jumps for k in {k for _, k in jump.ties})
        return counts.most_common(1)[0] if counts else None


def hidden_jumps(
    probe: Subject,
    run: Run,
    like: Atoms,
    rest: Float[np.ndarray, "steps"],
    sharp: Mapping[int, Sequence[float]],
    noise: float,
) -> Hidden:
    """Look into the steps that leave most unexplained: is it all at single places of their way?

    Args:
        probe: another object than the run's.
        run: the run.
        like: species and cell.
        rest: energy that each step leaves unexplained; nan where that is not known.
        sharp: by step, shares of its way at which a known threshold jumps, which are not counted again.
        noise: of the energy, eV.
    """
    limit = max(40 * noise, _SMALL * probe.kT)
    large = np.abs(np.nan_to_num(rest)) > limit
    candidates = np.flatnonzero(large)[np.argsort(-np.abs(rest[large]), kind="stable")]
    meter = meter_of(probe)
    began = meter.calls
    jumps: list[Jump] = []
    looked: dict[int, float] = {}
    for step in candidates[:_MOST_STEPS]:
        if looked and meter.calls - began > _CALLS:
            break
        looked[int(step)] = float(rest[step])
        jumps += _into(probe, run, like, int(step), sharp.get(int(step), ()), limit)
    return Hidden(tuple(jumps), looked, tuple(int(step) for step in candidates))


def _into(
    probe: Subject, run: Run, like: Atoms, step: int, sharp: Sequence[float], limit: float
) -> list[Jump]:
    """The jumps on the way of one step."""
    start, way = run.positions[step - 1], run.positions[step] - run.positions[step - 1]
    known: dict[float, tuple[float, float]] = {}

    def asked(share: float) -> tuple[float, float]:
        """Energy, and force along the way."""
        if share not in known:
            there = at(like, start + share * way)
            known[share] = probe.energy(there), float(np.sum(probe.forces(there) * way))
        return known[share]

    def unexplained(low: float, high: float) -> float:
        """Energy gained plus work done, by Simpson's rule."""
        before, middle, after = asked(low), asked(0.5 * (low + high)), asked(high)
        return after[0] - before[0] + (high - low) * (before[1] + 4 * middle[1] + after[1]) / 6

    parts = [(0.0, 1.0)]
    first = largest = unexplained(0.0, 1.0)
    for level in range(_LEVELS):
        halves = [
            half for low, high in parts for half in ((low, 0.5 * (low + high)), (0.5 * (low + high), high))
        ]
        sizes = [abs(unexplained(*half)) for half in halves]
        largest = max(sizes)
        floor = max(limit, _FOLLOWED * max(largest, abs(first) if level >= _SPREAD_AT else 0.0))
        parts = [half for half, size in zip(halves, sizes, strict=True) if size > floor]
        if not parts:
            return []
    known_ones = np.asarray(sharp, np.float64)
    found = []
    for low, high in parts:
        if len(known_ones) and np.abs(known_ones - 0.5 * (low + high)).min() < 1e-3:
            continue
        ends = at(like, start + low * way), at(like, start + high * way)
        found.append(Jump(step, 0.5 * (low + high), unexplained(low, high), _exchanged(*ends)))
    return found


def _exchanged(before: Atoms, after: Atoms) -> tuple[tuple[int, int], ...]:
    """(atom, k) whose k-th and next neighbors are others after than before, by nearest images."""
    orders = []
    for atoms in (before, after):
        distances = atoms.get_all_distances(mic=bool(atoms.pbc.any()))
        np.fill_diagonal(distances, -1.0)
        orders.append(np.argsort(distances, axis=1, kind="stable"))
    found = []
    for center, (one, other) in enumerate(zip(*orders, strict=True)):
        # two that change places differ at two ranks, of which the first is k
        ranks = np.flatnonzero(one != other)
        found += [(center, int(k)) for k in ranks if k + 1 < len(one) and one[k] == other[k + 1]]
    return tuple(found)
