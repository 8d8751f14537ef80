"""The cases that a list is asked: those with a name, scripts of motion, crowds, and those drawn at random."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from mdnum.references.conformance.case import Case
from mdnum.references.conformance.catalog import catalog
from mdnum.references.conformance.crowds import LARGE_EDGE, SMALL_EDGE, crowds, lattice
from mdnum.references.conformance.lists import PairList
from mdnum.references.conformance.movers import movers, sequences
from mdnum.references.conformance.rule import motions


def questions(
    tested: PairList, count: int, seed: int, large: bool = True, padding: float | None = None
) -> Iterator[Case]:
    """The cases that a list is asked, in order.

    Args:
        count: random cases.
        seed: of the random cases.
        large: the 5,000 and the 100,000 atoms, too.
        padding: of a list that is kept, in skins, where it is known; see `rule.motions`.
    """
    if tested.kept:
        yield from movers()
        yield from motions(padding)
    yield from as_kept(tested, catalog())
    if not tested.kept:
        yield from sequences()
    yield from as_kept(tested, crowds())
    yield from as_kept(tested, drawn(max(1, round(count * tested.affords)), seed) if count else ())
    if large:
        yield lattice(SMALL_EDGE)
        yield lattice(LARGE_EDGE)


def as_kept(tested: PairList, cases: Iterable[Case]) -> Iterator[Case]:
    """Questions at one moment, with a skin for a list that is kept."""
    for case in cases:
        yield replace(case, skin=0.3 * case.r_cut) if tested.kept else case


def drawn(count: int, seed: int) -> list[Case]:
    """Cases that hypothesis draws, the same for the same seed."""
    import hypothesis

    from mdnum.references.conformance.strategies import cases

    made: list[Case] = []
    checks: Any = list(hypothesis.HealthCheck)

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=checks,
        derandomize=False,
    )
    @hypothesis.given(cases())
    def draw(case: Case) -> None:
        made.append(case)

    draw()
    return made[:count]
