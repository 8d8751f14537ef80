"""The conformance suite for a library's own tests: a class to subclass.

    from mdnum.references.conformance import ListLimits, NeighborListConformance
    from mylibrary import neighbor_list

    class TestNeighborList(NeighborListConformance):
        pairs = staticmethod(neighbor_list)
        limits = ListLimits(minimum_image=True)

A failed test prints the error, and a script that reproduces the error with a few atoms.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import pytest

from mdnum.references.conformance import questions
from mdnum.references.conformance.case import AREAS, Case, gas, once
from mdnum.references.conformance.lists import ListLimits, PairList, from_object
from mdnum.references.conformance.peers import load
from mdnum.references.conformance.reproduction import script
from mdnum.references.conformance.suite import Examiner, examine


class NeighborListConformance:
    """Tests of a neighbor list. A subclass sets `pairs` and has a name that pytest collects."""

    # a function of (positions, cell, pbc, r_cut) in `staticmethod`, a class or an object with `allocate` and
    # `update` (`KeptList`), or a word that `load` knows
    pairs: ClassVar[Any] = None
    full: ClassVar[bool | None] = None  # every pair from both of its atoms or once; None to find out
    unit: ClassVar[float | None] = None  # roundoff of its arithmetic, 2**-53 or 2**-24; None to find out
    superset: ClassVar[bool | None] = None  # pairs beyond the cutoff may be listed
    limits: ClassVar[ListLimits | None] = None  # what it does not claim to do; such cases are not asked
    cases: ClassVar[int] = 200  # random ones
    seed: ClassVar[int] = 0  # of the random cases; change it now and then
    large: ClassVar[bool] = False  # ask about 5,000 atoms, too, and 100,000 unless that would take too long

    def subject(self) -> PairList:
        """Return the neighbor list under test, with the properties declared in the class."""
        if self.pairs is None:
            pytest.skip("no list: set `pairs` in a subclass")
        found = load(self.pairs) if isinstance(self.pairs, str) else from_object(self.pairs)
        return found.with_options(full=self.full, unit=self.unit, superset=self.superset, limits=self.limits)

    def asked(self, tested: PairList, area: str) -> list[Case]:
        """Return the test cases from one area of the conformance suite."""
        if area == "large":
            return list(questions.lattices()) if self.large else []
        count = self.cases if area == "random" else 0
        padding = Examiner(tested).report.padding if area == "rule" and tested.kept else None
        every = questions.questions(replace(tested, affords=1.0), count, self.seed, padding)
        return [case for case in every if case.area == area]

    @pytest.mark.parametrize("area", AREAS)
    def test_neighbor_list(self, area: str) -> None:
        """Test that the neighbor list returns the correct pairs in one area."""
        tested = self.subject()
        cases = self.asked(tested, area)
        if not cases:
            pytest.skip("set `large` to ask" if area == "large" else "for lists that are kept")
        report = examine(tested, asked=cases, large=False)
        if not report.asked:
            pytest.skip("; ".join(report.areas[area].why))
        if report.failed:
            lines = [f"{report.wrong} of {report.asked} cases about {AREAS[area]}"]
            lines += [f"{failed.code}: {failed.worst.text}" for failed in report.failed]
            text = script(tested, report.failed[0], report.how, report.superset)
            pytest.fail("\n".join([*lines, "", "This reproduces the first:", "", text]), pytrace=False)
        if not report.conforms:
            why = "; ".join(report.areas[area].why)
            if not self._answers(tested):
                pytest.fail(f"it refuses whatever it is asked: {why}", pytrace=False)
            pytest.skip(f"refused: {why}")

    @staticmethod
    def _answers(tested: PairList) -> bool:
        """Return whether the neighbor list returns any pairs in the simplest test cases."""
        plain = [once("a gas", "few", gas(20, 6.0, 0), 6.0), once("a free gas", "few", gas(20, 3.0, 0))]
        report = examine(tested, asked=questions.as_kept(tested, plain), large=False, shrink=False)
        return not report.asked or bool(report.failed) or report.conforms
