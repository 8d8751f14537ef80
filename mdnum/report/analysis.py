"""Statistics of the flips and the energies of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.ranges import first_outside
from mdnum.report.section import Table
from mdnum.report.words import count, number

Flips = Mapping[str, np.ndarray]

# flips that are followed pair by pair at a time, at least
_AT_ONCE = 2_000_000
# fewer rows have no fluctuation to speak of; blocks of which the drift's error is estimated
_LEAST_ROWS, _BLOCKS = 40, 10


@dataclass(frozen=True)
class Stays:
    """Residence times of pairs inside and outside the cutoff, in steps."""

    inside: Int[np.ndarray, "lengths"]  # from entering to leaving: how many stays last 0, 1, 2, ... steps
    outside: Int[np.ndarray, "lengths"]  # from leaving to entering again, likewise

    @property
    def total(self) -> int:
        """Number of residence times counted, inside and outside the cutoff."""
        return int(self.inside.sum() + self.outside.sum())

    def undone_within(self, steps: int) -> int:
        """Return the number of flips that are reversed within `steps` steps."""
        return int(self.inside[: steps + 1].sum() + self.outside[: steps + 1].sum())


def median(counts: Int[np.ndarray, "lengths"]) -> float | None:
    """Return the median of a histogram of residence times in steps. None if it is empty."""
    total = int(counts.sum())
    if not total:
        return None
    up_to = np.cumsum(counts)
    middle = np.searchsorted(up_to, [(total - 1) // 2 + 1, total // 2 + 1])
    return float(middle.mean())


@dataclass(frozen=True)
class PairCounts:
    """Pairs of atoms, sorted by the number of their flips in descending order."""

    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    flips: Int[np.ndarray, "pairs"]
    terms: np.ndarray  # names of the terms whose decisions they are; "" where there are none

    def rows(self, most: int) -> list[dict[str, Any]]:
        """Return the pairs with the most flips, as plain values."""
        columns = {name: values[:most].tolist() for name, values in vars(self).items()}
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


class Scan:
    """Statistics of a table of flips. The table is read in blocks and may be larger than the memory.

    The statistics contain the margin of every flip, and counts by pair, step and residence time.

    Args:
        steps: number of steps in the run's series; flips happen at the steps 0 to steps - 1.
        nearest: number of flips nearest to their threshold that are kept.
    """

    def __init__(self, steps: int, nearest: int = 0):
        self._most = nearest
        self.total = 0
        #: Numbers of pairs that entered and left at each step.
        self.entered, self.left = np.zeros(steps, np.int64), np.zeros(steps, np.int64)
        self._alternates = True
        # (outside, inside): stays by their length
        self._lengths = np.zeros((2, steps), np.int64)
        # of each pair: its key, its flips, and the last of them
        self._key, self._count, self._step = (np.zeros(0, np.int64) for _ in range(3))
        self._inside = np.zeros(0, bool)
        # pair, step and side of the flips that came since
        self._recent: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._ratios: list[np.ndarray] = []
        # numbers of the terms that decide, by name
        self._terms: dict[str, int] = {"": 0}
        self._bits = 32  # of an atom's number
        #: Rows nearest to their thresholds, in table order, by column.
        self.nearest: dict[str, np.ndarray] = {}

    def take(self, flips: Flips) -> None:
        """Add the next rows of the table of flips to the statistics.

        Raises:
            ValueError: a flip is at a step outside the run, or at an earlier step than a previous flip.
        """
        step, steps = flips["step"], len(self.entered)
        self.total += len(step)
        if not len(step):
            self._keep_nearest(flips, np.zeros(0))
            return
        if step.min() < 0 or step.max() >= steps:
            raise ValueError(f"flips at steps {step.min()} to {step.max()} are not in a run of {steps} steps")
        came = flips["entered"].astype(bool)
        self.entered += np.bincount(step[came], minlength=steps)
        self.left += np.bincount(step[~came], minlength=steps)
        ratio = margins_in_bounds(flips)
        self._ratios.append(ratio)
        self._keep_nearest(flips, ratio)
        # each term decides by itself, and its number takes eight of the bits of a pair
        self._bits = 28 if "terms" in flips else 32
        pair = (flips["i"].astype(np.int64) << self._bits) | flips["j"].astype(np.int64)
        if "terms" in flips:
            names, at = np.unique(flips["terms"].astype(str), return_inverse=True)
            pair |= np.array([self._terms.setdefault(name, len(self._terms)) for name in names])[at] << 56
        self._recent.append((pair, step, came))
        # sorted with all pairs so far, so not before they are as many
        if sum(len(part[0]) for part in self._recent) > max(_AT_ONCE, len(self._key)):
            self._follow()

    @property
    def alternates(self) -> bool:
        """True if each pair alternately enters and leaves the cutoff. False if a flip is missing."""
        self._follow()
        return self._alternates

    @property
    def ratios(self) -> Float[np.ndarray, "flips"]:
        """Ratio of |margin| to the bound on its rounding error, for each flip."""
        self._ratios = [np.concatenate(self._ratios or [np.zeros(0)])]
        return self._ratios[0]

    @property
    def stays(self) -> Stays:
        """Residence times of pairs inside and outside the cutoff.

        The first and the last stay of each pair are incomplete and not counted. Long stays are therefore
        underrepresented in short runs.
        """
        self._follow()
        return Stays(inside=self._lengths[1], outside=self._lengths[0])

    @property
    def pairs(self) -> int:
        """Number of pairs of atoms that flipped at least once."""
        self._follow()
        return len(self._key)

    @property
    def busiest(self) -> PairCounts:
        """Pairs of atoms that flipped, in descending order of the number of flips."""
        self._follow()
        order = np.argsort(-self._count, kind="stable")
        key = self._key[order]
        atom, term = (1 << self._bits) - 1, key >> 2 * self._bits if self._bits < 32 else np.zeros_like(key)
        return PairCounts(
            key >> self._bits & atom, key & atom, self._count[order], np.array(list(self._terms))[term]
        )

    def matches(self, series: Mapping[str, np.ndarray]) -> Bool[np.ndarray, "steps"]:
        """Return, for each step, whether the table and the time series contain equally many flips."""
        return (self.entered == series["entered"]) & (self.left == series["left"])

    def _follow(self) -> None:
        if not self._recent:
            return
        # the last flip of each pair so far comes before those since, whose steps are in order too
        parts = [(self._key, self._step, self._inside), *self._recent]
        key, step, came = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        count = np.concatenate([self._count, np.ones(len(key) - len(self._count), np.int64)])
        self._recent = []
        order = np.argsort(key, kind="stable")
        key, step, came, count = key[order], step[order], came[order], count[order]
        same = key[1:] == key[:-1]
        length, inside, then = (step[1:] - step[:-1])[same], came[:-1][same], came[1:][same]
        self._alternates = self._alternates and not np.any(inside == then)
        for side in (0, 1):
            self._lengths[side] += np.bincount(length[inside == side], minlength=self._lengths.shape[1])
        last = np.r_[~same, True]
        self._count = np.add.reduceat(count, np.flatnonzero(np.r_[True, ~same]))
        self._key, self._step, self._inside = key[last], step[last], came[last]

    def _keep_nearest(self, flips: Flips, ratio: np.ndarray) -> None:
        rows = {**flips, "ratio": ratio}
        if self.nearest:
            rows = {name: np.concatenate([self.nearest[name], values]) for name, values in rows.items()}
        kept = np.sort(np.argsort(rows["ratio"], kind="stable")[: self._most])
        self.nearest = {name: values[kept] for name, values in rows.items()}


def scan(flips: Flips, steps: int | None = None, nearest: int = 0) -> Scan:
    """Compute the statistics of a table of flips that fits in memory."""
    made = Scan(int(np.max(flips["step"], initial=-1)) + 1 if steps is None else steps, nearest)
    made.take(flips)
    return made


def margins_in_bounds(flips: Flips) -> Float[np.ndarray, "flips"]:
    """Return |margin| / rounding bound of each flip. Flips with ratios up to 1 are ambiguous.

    With a bound of zero, the ratio of a nonzero margin is infinite.
    """
    margin, bound = np.abs(flips["margin"]), flips["bound"]
    ratio = np.full(margin.shape, np.inf)
    np.divide(margin, bound, out=ratio, where=bound > 0)
    ratio[(bound == 0) & (margin == 0)] = 0.0
    return ratio


def expected_ambiguous(ratio: Float[np.ndarray, "flips"]) -> float:
    """Return the expected number of ambiguous flips, for evenly spread margins.

    Margins are spread evenly if atoms move freely through the cutoff distance. The density of margins is
    estimated from the smallest quarter of the margins. More ambiguous flips than expected show that pairs
    stay near the cutoff. An example is a crystal with a neighbor shell at this distance.
    """
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) < 4:
        return 0.0
    quarter = np.quantile(ratio, 0.25)
    return float(0.25 * len(ratio) / quarter) if quarter > 0 else float(len(ratio))


def algebra_holds(series: Mapping[str, np.ndarray]) -> Bool[np.ndarray, "steps"]:
    """Return, for each step, whether pairs inside = initial pairs + pairs entered - pairs left."""
    pairs = series["pairs"]
    net = np.cumsum(series["entered"].astype(np.int64) - series["left"])
    return pairs == pairs[0] + net - net[0]


@dataclass(frozen=True)
class Conservation:
    """Fluctuation and drift of the conserved energy of a run."""

    fluctuation: float  # standard deviation of the conserved energy over that of what moves
    drift: float  # of the conserved energy over the whole run, energy
    drift_error: float  # its standard error

    @classmethod
    def of(
        cls,
        conserved: Float[np.ndarray, "rows"],
        kinetic: Float[np.ndarray, "rows"],
        least: float,
    ) -> Conservation | None:
        """Compute fluctuation and drift of the conserved energy. None for too few rows, or for atoms at rest.

        The fluctuation does not include the linear trend. The first half of the run is omitted: atoms on
        lattice sites lose half of their kinetic energy at the start.

        Args:
            conserved: the energy that should be constant. kinetic: the kinetic energy.
            least: lower limit of the kinetic fluctuation, since atoms in free flight keep their kinetic
                energy.
        """
        rows = len(conserved)
        if rows < _LEAST_ROWS or not np.isfinite(conserved).all():
            return None
        half, moving = conserved[rows // 2 :], max(least, float(np.std(kinetic[rows // 2 :])))
        if not moving > 0:
            return None
        at = np.arange(len(half))
        noise = half - np.polyval(np.polyfit(at, half - half[0], 1), at)
        blocks = np.array([part.mean() for part in np.array_split(conserved - conserved[0], _BLOCKS)])
        line, covariance = np.polyfit(np.arange(_BLOCKS), blocks, 1, cov=True)
        return cls(
            float(np.std(noise)) / moving, _BLOCKS * float(line[0]), _BLOCKS * float(covariance[0, 0]) ** 0.5
        )


def range_table(label: Callable[[str], str], *tables: Mapping[str, np.ndarray]) -> Table:
    """Tabulate the ranges of quantities, and when they first leave the range of narrower formats.

    Args:
        label: function that returns the label of a quantity from its name.
        tables: columns `step`, and smallest and largest values of quantities at each step (`ranges.columns`).
    """
    rows, forms = [], ("float32", "bfloat16", "float16")
    held = ((table, key) for table in tables for key in table if "largest_" in key and np.any(table[key]))
    for table, key in held:
        step, most, least = table["step"], table[key], table[key.replace("largest", "smallest")]
        cells = []
        for form in forms:
            found = first_outside(most, least, form).items()
            told = (f"{how} at step {count(step[at])} ({number(value, 3)})" for how, (at, value) in found)
            cells.append(", ".join(told) or "held")
        rows.append((label(key.removeprefix("largest_")), np.max(most), np.nanmin(least), *cells))
    return Table(("quantity", "largest", "smallest that is not 0", *forms), rows)
