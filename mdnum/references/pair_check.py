"""Compare neighbor searches with an exact search (`mdnum check pairs`)."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from ase import Atoms
from ase.cell import Cell as AseCell
from numpy import ndarray

from mdnum import systems
from mdnum.numerics import neighbor, ordinal
from mdnum.references.conformance.answer import read
from mdnum.references.conformance.case import once
from mdnum.references.conformance.lists import ListLimits, PairList
from mdnum.references.conformance.peers import known
from mdnum.references.oracle import PairSet, all_pairs, completed, exactly_inside, rounding_bound
from mdnum.systems.construct import with_atoms
from mdnum.systems.simulation import Simulation

AGREES, AT_THE_CUTOFF, DIFFERS = "agrees", "differs at the cutoff", "differs"
FAILED, NOT_TESTED = "failed", "not tested"
_SINGLE = 2.0**-24
_NEARBY = 3  # ulps either side of r_cut in which oriented pairs are placed


@dataclass(frozen=True)
class Search:
    """Neighbor search of mdnum or of a library, to be tested."""

    listed: PairList

    @property
    def name(self) -> str:
        """Name of the neighbor list."""
        return self.listed.name

    @property
    def ours(self) -> bool:
        """True if mdnum uses the neighbor search for its runs."""
        return self.listed.package == "mdnum"

    @property
    def unit(self) -> float:
        """Unit roundoff of the arithmetic of the neighbor search."""
        return self.listed.unit or 2.0**-53

    @cached_property
    def _call(self) -> Callable[..., Any]:
        return self.listed.make()

    @cached_property
    def _full(self) -> bool:
        """True if the neighbor search lists every pair twice."""
        if self.listed.full is not None:
            return self.listed.full
        pair, cell, pbc = np.array([[0.0, 0, 0], [0.5, 0, 0]]), 4.0 * np.eye(3), np.ones(3, bool)
        if self.listed.limits.free:
            cell, pbc = np.zeros((3, 3)), np.zeros(3, bool)
        return len(read(self._call(pair, cell, pbc, 1.0))) > 1

    def refusal(self, positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float) -> str | None:
        """Return why the search does not support a structure. None if the search supports it."""
        if self.listed.version is None:
            return "not installed"
        positions, cell = self._placed(positions, cell, pbc)
        return self.listed.limits.refusal(once("", "few", positions, cell, pbc.tolist(), r_cut))

    def pairs(self, positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float) -> tuple[ndarray, ndarray]:
        """Return the pairs i <= j within r_cut, one entry per periodic image."""
        positions, cell = self._placed(np.asarray(positions, float), np.asarray(cell, float), pbc)
        answer = read(self._call(positions, cell, np.array(pbc), float(r_cut)))
        i, j = np.minimum(answer.i, answer.j), np.maximum(answer.i, answer.j)
        if self._full:
            # half of the rows of each pair
            order = np.lexsort((j, i))[::2]
            i, j = i[order], j[order]
        return i, j

    def _placed(self, positions: ndarray, cell: ndarray, pbc: ndarray) -> tuple[ndarray, ndarray]:
        """Return positions and cell in the form that the neighbor search requires."""
        limits = self.listed.limits
        positions, cell = np.array(positions), np.where(np.asarray(pbc)[:, None], cell, 0.0)
        if limits.whole_cell and pbc.any():
            cell = completed(cell, pbc)
        if pbc.all() and (
            (limits.lower_triangular and np.count_nonzero(np.triu(cell, 1)))
            or (limits.right_handed and np.linalg.det(cell) < 0)
        ):
            standard = np.asarray(AseCell(cell).standard_form()[0])
            positions, cell = positions @ np.linalg.solve(cell, standard), standard
        # jax-md loses pairs of atoms outside of the box, which `mdnum conform` reports
        wraps = limits.wrapped or limits.along_axes or self.listed.package == "jax-md"
        if wraps and pbc.any():
            full = completed(cell, pbc)
            fraction = positions @ np.linalg.inv(full)
            positions = positions - np.where(pbc, np.floor(fraction), 0.0) @ full
            # an atom a hair below a face is wrapped onto the one across, by rounding
            over = pbc & (positions @ np.linalg.inv(full) >= 1.0)
            positions = np.where(over, 0.0, positions) if limits.along_axes else positions
        return positions, cell


def all_searches(system: Simulation) -> tuple[Search, ...]:
    """Return all neighbor searches of libraries and of mdnum."""
    own = own_searches(system)
    return (*own, *(Search(one) for one in known() if not one.kept and one.package != "mdnum"))


def own_searches(system: Simulation) -> tuple[Search, ...]:
    """Return the neighbor searches of mdnum, set up for a system.

    The search "mdnum force loop" selects pairs as the force evaluation does. The searches "mdnum, host list"
    and "mdnum, jax-md list" use mdnum's two list builders.
    """
    compare, dtype = system.decider.compare, system.policy.decision
    unit = _SINGLE if "float32" in (dtype, system.policy.state) else 2.0**-53

    searches = {
        "mdnum force loop": (_force_loop(system), 1.0),
        "mdnum, host list": (_listed("host", compare, dtype), 1.0),
        "mdnum, jax-md list": (_listed("jax-md", compare, dtype), 0.0),
    }
    own = {"package": "mdnum", "full": False, "unit": unit, "limits": ListLimits(minimum_image=True)}
    return tuple(
        Search(PairList(name, lambda search=search: search, affords=affords, **own))
        for name, (search, affords) in searches.items()
    )


def _force_loop(system: Simulation) -> Callable[..., Any]:
    built: dict[Any, Any] = {}

    def search(positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float) -> Any:
        key = (len(positions), pbc.tobytes(), r_cut)
        if key not in built:
            species = system.structure.numbers
            if len(positions) != system.atoms:
                # the pair of species whose radius r_cut is; a pair at the cutoff is far from any core
                a, b = np.argwhere(_radii(system) == r_cut)[0]
                species = [system.symbols[a], system.symbols[b]]
            atoms = Atoms(species, positions=positions, cell=cell, pbc=pbc)
            built[key] = with_atoms(system, atoms, skin=0.0)
        evaluation = built[key].evaluate(positions, cell, stress=False)
        return np.asarray(evaluation.i), np.asarray(evaluation.j)

    return search


def _radii(system: Simulation) -> ndarray:
    """Return the cutoff radius of every pair of species, shape (species, species)."""
    rows, columns = np.triu_indices(len(system.symbols))
    table = np.zeros((len(system.symbols),) * 2)
    table[rows, columns] = table[columns, rows] = system.decider.r_cut
    return table


def _listed(builder: str, compare: str, dtype: str) -> Callable[..., Any]:
    def search(positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float) -> Any:
        from mdnum.md.cell import Cell, displacement, wrap_positions
        from mdnum.md.decide import PairDecider
        from mdnum.md.neighbors import BUILDERS, RebuildRule, VerletList

        box = Cell.create(cell, pbc)  # type: ignore[arg-type]  (one flag or one per axis)
        wrapped, _ = wrap_positions(box, positions)
        rows = VerletList(BUILDERS[builder], RebuildRule(0.0), r_cut).build(wrapped, box).unsorted()
        i, slot = np.nonzero(rows < len(positions))
        j = rows[i, slot]
        i, j = i[i < j], j[i < j]
        decider = PairDecider((r_cut,), compare, dtype)
        quantity = decider.host_quantity(*displacement(box, wrapped[i], wrapped[j], getattr(np, dtype)))
        threshold = decider.thresholds[0].value
        keep = quantity <= threshold if compare.endswith("<=") else quantity < threshold
        return i[keep], j[keep]

    return search


@dataclass(frozen=True)
class SearchResult:
    """Result of one neighbor search."""

    # name, version: which search
    name: str
    version: str | None
    # "agrees"; "differs at the cutoff": only within its own rounding; "differs"; "failed"; "not tested": see
    # note
    verdict: str
    pairs: int = 0  # pairs found inside the cutoff
    # missing, extra: pairs that only the oracle has, or only the search, beyond its rounding
    missing: int = 0
    extra: int = 0
    borderline: int = 0  # pairs decided otherwise than by real arithmetic, within its rounding
    effective: EffectiveCutoff | None = None  # the cutoff it acts on
    seconds: float = 0.0  # time of the first search, compiling included
    ours: bool = False  # whether it is mdnum's own, on which a run depends
    note: str = ""  # why it was not tested, or how it failed


@dataclass(frozen=True)
class PairsReport:
    """Comparison of neighbor searches with brute force."""

    system: str  # name
    compare: str  # what inside means in this system
    r_cut: float  # longest cutoff radius
    pairs: int  # pairs inside, by real arithmetic
    decided_exactly: int  # pairs so close to a cutoff that float64 could not decide
    results: tuple[SearchResult, ...]  # one per search

    @property
    def ok(self) -> bool:
        """True if mdnum's neighbor searches agree with brute force, except within rounding error."""
        return all(one.verdict in (AGREES, AT_THE_CUTOFF, NOT_TESTED) for one in self.results if one.ours)

    def rows(self) -> list[dict[str, Any]]:
        """Return table rows with the result of each neighbor search."""
        counts = ("pairs", "missing", "extra", "borderline")
        return [
            {"search": one.name, "version": one.version}
            | {name: None if one.note else getattr(one, name) for name in counts}
            | {
                "stops counting": one.effective.stops if one.effective else None,
                "compares": one.effective.comparison if one.effective else None,
                "ms, first call": None if one.note else round(1e3 * one.seconds, 2),
                "verdict": one.note or one.verdict,
            }
            for one in self.results
        ]


def check_pairs(
    subject: Any,
    *,
    searches: Sequence[Search] | None = None,
    effective: bool = True,
) -> PairsReport:
    """Compare the pairs of every neighbor search with those of brute force.

    Each search is run once per cutoff radius. Brute force uses the comparison (< or <=) of the system file.
    Near the cutoff, brute force is exact. "differs at the cutoff" means that only decisions near the cutoff
    differ.

    Args:
        subject: a `Simulation`, or any argument of `mdnum.build`.
        searches: neighbor searches; default those of mdnum and of every installed library.
        effective: also find the effective cutoff of each search by bisection.
    """
    system = systems.build(subject)
    x, species = system.positions, system.species
    cell, pbc = np.asarray(system.structure.cell), np.asarray(system.pbc)
    compare = system.decider.compare
    # each cutoff radius with the pairs of species it is for, as a square table of booleans
    radius = _radii(system)
    groups = [(float(value), radius == value) for value in np.unique(radius)[::-1]]
    truth = []
    for value, chosen in groups:
        found = all_pairs(x, cell, pbc, value, closed=compare.endswith("="), reach=value * (1 + 1e-4))
        truth.append(found.select(chosen[species[found.i], species[found.j]]))

    def ask(search: Search) -> SearchResult:
        result = SearchResult(search.name, search.listed.version, NOT_TESTED, ours=search.ours)
        if note := search.refusal(x, cell, pbc, groups[0][0]):
            return replace(result, note=note)
        counts, pairs, seconds = np.zeros(3, int), 0, 0.0
        try:
            for (value, chosen), right in zip(groups, truth, strict=True):
                begin = time.perf_counter()
                i, j = search.pairs(x, cell, pbc, value)
                seconds += time.perf_counter() - begin
                keep = chosen[species[i], species[j]]
                bound = rounding_bound(x, cell, value, unit_roundoff=search.unit)
                counts += compare_pairs(i[keep], j[keep], right, value, bound)
                pairs += int(keep.sum())
            stops = effective_cutoff(search, groups[0][0], periodic=bool(pbc.all())) if effective else None
        except Exception as error:  # another library's search may fail in any way; that is a result
            if search.ours:  # a defect to see whole
                raise
            note = f"failed: {type(error).__name__}: {error}"
            return replace(result, verdict=FAILED, note=note)
        missing, extra, borderline = counts.tolist()
        verdict = DIFFERS if missing or extra else AT_THE_CUTOFF if borderline else AGREES
        counted = {"pairs": pairs, "missing": missing, "extra": extra, "borderline": borderline}
        return replace(result, verdict=verdict, effective=stops, seconds=seconds, **counted)

    return PairsReport(
        system.name,
        compare,
        groups[0][0],
        sum(int(pairs.inside.sum()) for pairs in truth),
        sum(int(pairs.exact.sum()) for pairs in truth),
        tuple(map(ask, all_searches(system) if searches is None else searches)),
    )


def compare_pairs(i: ndarray, j: ndarray, right: PairSet, r_cut: float, bound: float) -> tuple[int, int, int]:
    """Return the numbers of missing, extra and borderline pairs.

    Args:
        i, j: pairs from the neighbor search, i <= j, one row per periodic image.
        right: pairs from brute force, listed slightly beyond the cutoff.
        r_cut: cutoff radius.
        bound: rounding error of distances in the neighbor search; differing decisions on pairs this close to
            r_cut are borderline.
    """

    def counted(i: ndarray, j: ndarray) -> Counter[tuple[int, int]]:
        return Counter(zip(i.tolist(), j.tolist(), strict=True))

    found = counted(i, j)
    expected = counted(right.i[right.inside], right.j[right.inside])
    close = np.abs(right.distance - r_cut) <= bound
    tolerated = counted(right.i[close], right.j[close])
    lost, phantom = expected - found, found - expected
    missing, extra = (lost - tolerated).total(), (phantom - tolerated).total()
    return missing, extra, lost.total() + phantom.total() - missing - extra


@dataclass(frozen=True)
class EffectiveCutoff:
    """The cutoff that a neighbor search applies when r_cut is requested."""

    r_cut: float  # the cutoff asked for
    last_counted: float  # largest distance along x at which the pair is still counted
    ulps: int  # last_counted - r_cut in units of r_cut's last place; -1 for an exact "<", 0 for an exact "<="
    comparison: str  # "<" or "<=", with "in float32" where the numbers are cast to it; else "rounded"
    oriented: int  # pairs placed within 3 ulps of r_cut in random directions
    disagree: int  # those of them decided otherwise than real arithmetic does with r < r_cut

    @property
    def stops(self) -> str:
        """Difference between the effective and the requested cutoff, as text."""
        if abs(self.ulps) < 1000:
            return f"{self.ulps:+d} ulp"
        return f"{self.last_counted / self.r_cut - 1:+.1e} relative"


def effective_cutoff(
    search: Search, r_cut: float, *, periodic: bool = True, oriented: int | None = None
) -> EffectiveCutoff:
    """Find the largest distance that a neighbor search counts as inside r_cut.

    The first atom is at x = 0, so the distance is the x coordinate of the second. The periodic box is 5
    r_cut wide. There, the wrapping of atoms also affects the result.

    Args:
        periodic: use a periodic box, as in a simulation; otherwise atoms without a box.
        oriented: number of randomly oriented pairs within 3 ulps of r_cut; default by cost of the search.
    Error: none, since the bisection ends at adjacent doubles; it is assumed that a search that counts a
        distance also counts smaller ones (checked at relative distances of 1e-5).
    """
    oriented = round(min(100, 1200 * search.listed.affords)) if oriented is None else oriented
    cell, pbc = np.eye(3) * (5.0 * r_cut if periodic else 0.0), np.full(3, periodic)

    def counts(pair: ndarray) -> bool:
        return len(search.pairs(pair, cell, pbc, r_cut)[0]) > 0

    def counts_at(place: int) -> bool:
        return counts(np.array([[0.0, 0.0, 0.0], [neighbor(0.0, place), 0.0, 0.0]]))

    inner, start, outer = (int(ordinal(r_cut * factor)) for factor in (1 - 1e-5, 1, 1 + 1e-5))
    if not counts_at(inner) or counts_at(outer):
        return EffectiveCutoff(r_cut, float("nan"), 0, "not a cutoff", 0, 0)
    # most searches stop within an ulp of what they were asked for, so doubling steps end after two or three
    sign, step = (1, 1) if counts_at(start) else (-1, 1)
    while counts_at(start + sign * step) == (sign > 0):
        step *= 2
    first, last = sorted((start + sign * (step // 2), start + sign * step))
    while last - first > 1:
        middle = (first + last) // 2
        first, last = (middle, last) if counts_at(middle) else (first, middle)
    disagree = sum(
        counts(pair) != exactly_inside(pair, np.zeros((3, 3)), 0, 1, (0, 0, 0), r_cut)
        for pair in borderline_pairs(r_cut, oriented)
    )
    found, comparison = float(neighbor(0.0, first)), {-1: "<", 0: "<="}.get(first - start, "rounded")
    if comparison == "rounded" and search.unit > 2.0**-30:
        single = int(np.float32(found).view(np.int32)) - int(np.float32(r_cut).view(np.int32))
        comparison = {-1: "< in float32", 0: "<= in float32"}.get(single, comparison)
    return EffectiveCutoff(r_cut, found, first - start, comparison, oriented, disagree)


def borderline_pairs(r_cut: float, count: int) -> ndarray:
    """Return positions of random pairs within 3 ulps of r_cut, shape (count, 2, 3)."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    length = r_cut + rng.uniform(-_NEARBY, _NEARBY, size=(count, 1)) * np.spacing(r_cut)
    return np.stack([np.zeros((count, 3)), length * direction], axis=1)
