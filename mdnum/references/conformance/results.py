"""What the suite found out about a list: tallies by area, failures, and conventions."""

from __future__ import annotations

from dataclasses import dataclass, field

from mdnum.references.conformance.alike import Refusal
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.judge import CODES, SILENT, Conventions, Failure
from mdnum.references.conformance.lists import PairList


@dataclass(frozen=True)
class Failed:
    """A case that a list failed.

    Attributes:
        case: as it was asked, up to the step that failed.
        failures: what was wrong at that step.
        asked: the case before it was shrunk; the same where it was not.
        alone: it fails when it is the first that a new process asks; else what was asked before matters.
    """

    case: Case
    failures: tuple[Failure, ...]
    asked: Case
    alone: bool = True

    @property
    def worst(self) -> Failure:
        """The failure that is told."""
        return min(self.failures, key=lambda one: CODES.index(one.code))

    @property
    def code(self) -> str:
        """Its code."""
        return self.worst.code


@dataclass
class Tally:
    """What became of the questions of one area.

    Attributes:
        asked, failed, refused, skipped: cases; refused by the list itself, skipped because of its limits.
        codes: cases by code of their worst failure.
        why: reasons of refusing and skipping, with how often.
    """

    asked: int = 0
    failed: int = 0
    refused: int = 0
    skipped: int = 0
    codes: dict[str, int] = field(default_factory=dict)
    why: dict[str, int] = field(default_factory=dict)

    @property
    def silent(self) -> int:
        """Failed cases in which nothing came back that could be wrong."""
        return sum(number for code, number in self.codes.items() if code in SILENT)

    @property
    def passed(self) -> int:
        """Cases answered as they should be."""
        return self.asked - self.failed - self.refused


@dataclass
class Report:
    """What the suite found out about a list.

    Attributes:
        tested: the list.
        how: its conventions, as declared or found out.
        found_out: which of them were found out rather than declared.
        single: a case that it decides as float32 does and float64 would not, where that was found out.
        ties: (counted, not counted) pairs at exactly r_cut.
        keeps_order: whether the same question gives the same rows in the same order.
        superset: pairs beyond the cutoff are part of what it gives.
        padding: out to which a list that is kept has all pairs, in units of the skin that it is given; None
            where it neither says so nor shows it.
        said: it says so, rather than shows it.
        shifts: whether it gives the images that pairs are through.
        areas: tallies by area.
        aliased: the first case in which a call wrote to the arrays of the answer before it, or None.
        refusals: kinds of refusals, and what each hangs on.
        failed: the first failure of each kind and area, in the order in which they were met.
        seconds: in all; asking: of the list itself.
        large: (atoms, seconds) of its largest question.
        questions: cases that there are, those that it does not claim to do included.
        motions: against its rebuild rule, that it was asked; and calls: of it in those.
        whole: all failures were shrunk as far as they are.
    """

    tested: PairList
    how: Conventions = field(default_factory=Conventions)
    found_out: list[str] = field(default_factory=list)
    single: Case | None = None
    ties: list[int] = field(default_factory=lambda: [0, 0])
    keeps_order: bool | None = None
    superset: bool = False
    padding: float | None = None
    said: bool = False
    shifts: bool = False
    areas: dict[str, Tally] = field(default_factory=dict)
    aliased: str | None = None
    refusals: list[Refusal] = field(default_factory=list)
    failed: list[Failed] = field(default_factory=list)
    seconds: float = 0.0
    asking: float = 0.0
    large: tuple[int, float] | None = None
    questions: int = 0
    motions: int = 0
    calls: int = 0
    whole: bool = True

    def reach(self, case: Case) -> float:
        """How far the pairs may be that a list with pairs beyond the cutoff gives, length.

        What is listed may have come as far as the skin lets it, from either side.
        """
        usual = case.r_cut + 2 * case.skin if case.skin else 1.5 * case.r_cut
        own = 0.3 * (self.padding or 1.0)  # asked with a skin of 0.3 cutoffs
        return usual if own < 0.31 else max(usual, (1 + 2 * own) * case.r_cut)

    @property
    def asked(self) -> int:
        """Cases that were asked."""
        return sum(tally.asked for tally in self.areas.values())

    @property
    def left(self) -> int:
        """Cases that were not come to."""
        return self.questions - sum(tally.asked + tally.skipped for tally in self.areas.values())

    @property
    def wrong(self) -> int:
        """Cases that failed."""
        return sum(tally.failed for tally in self.areas.values())

    @property
    def conforms(self) -> bool:
        """Whether it was asked and no case failed."""
        return self.wrong == 0 and self.asked > sum(tally.refused for tally in self.areas.values())
