"""`mdnum check pairs`: the pair set of every neighbor search against brute force."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray

from mdnum.errors import MdnumError
from mdnum.references.effective import EffectiveCutoff, effective_cutoff
from mdnum.references.finders import Finder
from mdnum.references.findings import finding, plain
from mdnum.references.oracle import PairSet, all_pairs, rounding_bound
from mdnum.references.own import all_finders
from mdnum.systems import System, pairs

AGREES, AT_THE_CUTOFF, DIFFERS, FAILED, NOT_ASKED = (
    "agrees",
    "differs at the cutoff",
    "differs",
    "failed",
    "not asked",
)


@dataclass(frozen=True)
class FinderResult:
    """What one search found.

    Attributes:
        finder, version: which search.
        verdict: "agrees"; "differs at the cutoff": only within its own rounding; "differs"; "failed";
            "not asked": see note.
        pairs: pairs found inside the cutoff.
        missing: pairs of the oracle that it does not have, beyond its rounding.
        extra: pairs that the oracle does not have, beyond its rounding.
        borderline: pairs decided otherwise than by real arithmetic, within its rounding.
        effective: the cutoff it acts on.
        seconds: time of the first search, compiling included.
        ours: whether it is mdnum's own or jax-md's, on which a run depends.
        note: why it was not asked, or how it failed.
    """

    finder: str
    version: str | None
    verdict: str
    pairs: int = 0
    missing: int = 0
    extra: int = 0
    borderline: int = 0
    effective: EffectiveCutoff | None = None
    seconds: float = 0.0
    ours: bool = False
    note: str = ""


@dataclass(frozen=True)
class PairsReport:
    """The pair sets of all searches against the oracle.

    Attributes:
        system: name.
        compare: what inside means in this system.
        r_cut: longest cutoff radius.
        pairs: pairs inside, by real arithmetic.
        decided_exactly: pairs so close to a cutoff that float64 could not decide.
        results: one per search.
        findings: what to look at.
        ok: mdnum's own searches agree, except within rounding.
    """

    system: str
    compare: str
    r_cut: float
    pairs: int
    decided_exactly: int
    results: tuple[FinderResult, ...]
    findings: tuple[dict[str, str], ...]
    ok: bool

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return plain(self)

    def rows(self) -> list[dict[str, Any]]:
        """A row per search."""
        return [
            {
                "finder": result.finder,
                "version": result.version,
                "pairs": None if result.note else result.pairs,
                "missing": None if result.note else result.missing,
                "extra": None if result.note else result.extra,
                "borderline": None if result.note else result.borderline,
                "stops counting": _stops(result.effective),
                "compares": result.effective.comparison if result.effective else None,
                "ms, first call": None if result.note else round(1e3 * result.seconds, 2),
                "verdict": result.note or result.verdict,
            }
            for result in self.results
        ]


def check_pairs(
    system: System,
    *,
    searches: Sequence[Finder] | None = None,
    positions: ndarray | None = None,
    effective: bool = True,
) -> PairsReport:
    """Compare the pairs that every search finds inside the cutoff with brute force.

    A system with a radius for each pair of species asks a search once per radius and keeps the pairs it
    applies to. The oracle follows the comparison of the system file (`<` or `<=`), decided in rational
    arithmetic near the threshold; a search that decides such a pair otherwise is "at the cutoff", which is
    rounding or convention and not an error.

    Args:
        system: what to check.
        searches: default: mdnum's own, jax-md's and every peer that is installed.
        positions: instead of the system's own.
        effective: also bisect each search's effective cutoff.
    """
    where: ndarray = system.atoms.get_positions() if positions is None else np.asarray(positions, dtype=float)
    cell, pbc = np.asarray(system.atoms.cell), np.asarray(system.atoms.pbc)
    compare = system.spec.cutoff.compare if system.spec.cutoff is not None else "r <"
    groups = _groups(system)
    truth = [
        _of_species(
            all_pairs(where, cell, pbc, radius, closed=compare.endswith("="), reach=radius * (1 + 1e-4)),
            chosen,
            system.species_index,
        )
        for radius, chosen in groups
    ]
    results = tuple(
        _ask(finder, where, cell, pbc, groups, truth, system.species_index, effective)
        for finder in (all_finders(system) if searches is None else searches)
    )
    ok = all(result.verdict in (AGREES, AT_THE_CUTOFF, NOT_ASKED) for result in results if result.ours)
    return PairsReport(
        system.name,
        compare,
        max(radius for radius, _ in groups),
        sum(int(pairs.inside.sum()) for pairs in truth),
        sum(int(pairs.exact.sum()) for pairs in truth),
        results,
        tuple(_findings(results, truth)),
        ok,
    )


def _groups(system: System) -> list[tuple[float, ndarray]]:
    """Each cutoff radius with the pairs of species it is for, as a square table of booleans."""
    if system.spec.cutoff is None:
        count = len(system.species)
        return [(system.r_cut, np.ones((count, count), bool))]
    radius, _ = pairs.cutoff_radii(system.spec, system.species)
    return [(float(value), radius == value) for value in np.unique(radius)[::-1]]


def _of_species(found: PairSet, chosen: ndarray, species: ndarray) -> PairSet:
    return found.select(chosen[species[found.i], species[found.j]])


def _ask(
    finder: Finder,
    positions: ndarray,
    cell: ndarray,
    pbc: ndarray,
    groups: list[tuple[float, ndarray]],
    truth: list[PairSet],
    species: ndarray,
    effective: bool,
) -> FinderResult:
    note = finder.refusal(cell, pbc, groups[0][0])
    if note:
        return FinderResult(finder.name, finder.version, NOT_ASKED, ours=finder.ours, note=note)
    pairs, missing, extra, borderline, seconds = 0, 0, 0, 0, 0.0
    try:
        for (radius, chosen), right in zip(groups, truth, strict=True):
            begin = time.perf_counter()
            i, j, _ = finder.pairs(positions, cell, pbc, radius)
            seconds += time.perf_counter() - begin
            keep = chosen[species[i], species[j]]
            bound = rounding_bound(positions, cell, radius, unit_roundoff=finder.unit_roundoff)
            lost, phantom, close = compare_pairs(i[keep], j[keep], right, radius, bound)
            pairs, missing, extra = pairs + int(keep.sum()), missing + lost, extra + phantom
            borderline += close
        stops = effective_cutoff(finder, groups[0][0], periodic=bool(pbc.all())) if effective else None
    except MdnumError as error:
        return FinderResult(finder.name, finder.version, FAILED, ours=finder.ours, note=f"failed: {error}")
    verdict = DIFFERS if missing or extra else AT_THE_CUTOFF if borderline else AGREES
    return FinderResult(
        finder.name, finder.version, verdict, pairs, missing, extra, borderline, stops, seconds, finder.ours
    )


def compare_pairs(i: ndarray, j: ndarray, right: PairSet, r_cut: float, bound: float) -> tuple[int, int, int]:
    """(missing, extra, borderline) of a search's pairs against the oracle's.

    Args:
        i, j: the search's pairs, i <= j, one row per image.
        right: the oracle's, listed somewhat beyond the cutoff.
        r_cut: cutoff.
        bound: how far the search's distances may be off; differing decisions on pairs this close to r_cut
            are borderline.
    """
    found = Counter(zip(i.tolist(), j.tolist(), strict=True))
    inside = right.select(right.inside)
    expected = Counter(zip(inside.i.tolist(), inside.j.tolist(), strict=True))
    close = right.select(np.abs(right.distance - r_cut) <= bound)
    tolerated = Counter(zip(close.i.tolist(), close.j.tolist(), strict=True))
    lost, phantom = expected - found, found - expected
    hard_lost, hard_phantom = lost - tolerated, phantom - tolerated
    missing, extra = hard_lost.total(), hard_phantom.total()
    return missing, extra, lost.total() + phantom.total() - missing - extra


def _stops(effective: EffectiveCutoff | None) -> str | None:
    """Where a search stops counting, in words."""
    if effective is None:
        return None
    if abs(effective.ulps) < 1000:
        return f"{effective.ulps:+d} ulp"
    return f"{effective.last_counted / effective.r_cut - 1:+.1e} relative"


def _findings(results: Sequence[FinderResult], truth: Sequence[PairSet]) -> list[dict[str, str]]:
    found = []
    for result in results:
        if result.verdict in (DIFFERS, FAILED):
            found.append(
                finding(
                    "pairs-differ" if result.verdict == DIFFERS else "finder-failed",
                    "error" if result.ours else "warning",
                    f"{result.finder} {result.note or 'does not find the right pairs'}",
                    f"{result.missing} pairs missing and {result.extra} too many, beyond its rounding."
                    if result.verdict == DIFFERS
                    else "It was given this system's positions and cell, or two atoms near the cutoff.",
                    "Do not trust a run on this list; choose another neighbors.builder"
                    if result.ours
                    else "Expect other numbers from codes that use it",
                )
            )
    borderline = [f"{result.finder} {result.borderline}" for result in results if result.borderline]
    if borderline:
        found.append(
            finding(
                "pairs-at-the-cutoff",
                "info",
                "some searches decide pairs at the cutoff otherwise",
                f"Within their own rounding, and against real arithmetic: {', '.join(borderline)}.",
                "Name the comparison (cutoff.compare) when comparing with another code",
            )
        )
    exact = sum(int(pairs.exact.sum()) for pairs in truth)
    if exact:
        found.append(
            finding(
                "pairs-ambiguous",
                "info",
                f"{exact} pairs lie within float64 rounding of the cutoff",
                "Whether they interact depends on the order of operations; here rational arithmetic decided.",
            )
        )
    return found
