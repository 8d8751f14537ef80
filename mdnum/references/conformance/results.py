"""What the suite found out about a list: answers by question, tallies by area, failures and conventions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge
from pydantic import FiniteFloat

from mdnum.errors import InputError
from mdnum.references.conformance.case import Case, Still
from mdnum.references.conformance.judge import CODES, SILENT, SINGLE, Conventions, Failure
from mdnum.references.conformance.lists import PairList
from mdnum.references.oracle import completed

Count = Annotated[int, Ge(0)]
Seconds = Annotated[FiniteFloat, Ge(0)]


@dataclass(frozen=True)
class CaseResult:
    """What became of a question.

    Attributes:
        case: its name.
        failures: what was wrong at the first step at which anything was.
        refused: the step and the exception by which the list refused it.
        ties: pairs at exactly r_cut (counted, not counted).
        aliased: a call wrote to the arrays of the answer before it.
        single: it was decided as float32 does and float64 would not.
        seconds: that the list took.
    """

    case: str
    failures: tuple[Failure, ...] = ()
    refused: tuple[Count, str] | None = None
    ties: tuple[Count, Count] = (0, 0)
    aliased: bool = False
    single: bool = False
    seconds: Seconds = 0.0


@dataclass(frozen=True)
class Shrunk:
    """A failure brought down to a few atoms.

    Attributes:
        case: up to the step that failed.
        failures: what was wrong at that step.
        alone: it fails when it is the first that a new process is asked; else what was asked before matters.
    """

    case: Case
    failures: tuple[Failure, ...]
    alone: bool = True

    def __post_init__(self) -> None:
        if not self.failures or any(failure.step >= self.case.steps for failure in self.failures):
            raise ValueError("no failure at a step of its case")

    @property
    def worst(self) -> Failure:
        """The failure that is reported."""
        return min(self.failures, key=lambda failure: CODES.index(failure.code))

    @property
    def code(self) -> str:
        """Its code."""
        return self.worst.code


@dataclass(frozen=True)
class Failed(Shrunk):
    """A case that a list failed.

    Attributes:
        asked: the case before it was shrunk; the same where it was not.
    """

    asked: Case = field(kw_only=True)


@dataclass
class CaseAnswers:
    """Everything that a list was asked, by the number of the question, and what was shrunk of its failures.

    Questions are drawn again when an examination is resumed, the same for the same seed; so none is kept.
    """

    cases: dict[str, CaseResult] = field(default_factory=dict)
    shrunk: dict[str, Shrunk] = field(default_factory=dict)

    def of(self, number: int, case: Case) -> CaseResult | None:
        """What became of a question; None where it was not asked yet.

        Raises:
            InputError: another question had that number.
        """
        result = self.cases.get(str(number))
        if result is None:
            return None
        steps = [failure.step for failure in result.failures]
        steps += [result.refused[0]] if result.refused is not None else []
        if result.case != case.name or any(step >= case.steps for step in steps):
            raise InputError(
                f"question {number} was {result.case!r} and is {case.name!r} now, with {case.steps} steps",
                remedy="Begin again in a new folder: the questions are those of another version",
            )
        return result


@dataclass(frozen=True)
class RefusalKind:
    """A kind of question that a list refuses.

    Attributes:
        exception: in words.
        case: the smallest question that met it, up to the step that was refused.
        uneven: how the same question was put and answered where no list has a reason to treat it differently.
        answers: how it was put and answered where a list may treat it differently: another unit of length,
            other images of the atoms.
    """

    exception: str
    case: Case
    uneven: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()


@dataclass
class AreaTally:
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
        return sum(self.codes.get(code, 0) for code in SILENT)

    @property
    def passed(self) -> int:
        """Cases answered correctly."""
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
            where it neither states nor shows it.
        stated: it states it, rather than shows it.
        shifts: whether it gives the images that pairs are through.
        areas: tallies by area.
        aliased: the first case in which a call wrote to the arrays of the answer before it, or None.
        refusals: kinds of refusals, and what each depends on.
        failed: the first failure of each kind and area, in the order in which they were met.
        seconds: in all.
        large: (atoms, seconds) of its largest question.
        questions: cases that there are, those that it does not claim to do included.
        motions: against its rebuild rule, that it was asked; and calls: of it in those.
        whole: all failures were shrunk as far as they are.
    """

    tested: PairList
    how: Conventions = field(default_factory=Conventions)
    found_out: list[str] = field(default_factory=list)
    single: Case | None = None
    ties: tuple[int, int] = (0, 0)
    keeps_order: bool | None = None
    superset: bool = False
    padding: float | None = None
    stated: bool = False
    shifts: bool = False
    areas: dict[str, AreaTally] = field(default_factory=dict)
    aliased: str | None = None
    refusals: list[RefusalKind] = field(default_factory=list)
    failed: list[Failed] = field(default_factory=list)
    seconds: float = 0.0
    large: tuple[int, float] | None = None
    questions: int = 0
    motions: int = 0
    calls: int = 0
    whole: bool = True

    def skip(self, case: Case, why: str) -> None:
        """Counts a case that is not asked."""
        tally = self.areas.setdefault(case.area, AreaTally())
        tally.skipped += 1
        tally.why[why] = tally.why.get(why, 0) + 1

    def take(self, case: Case, result: CaseResult) -> None:
        """Counts what became of a case."""
        tally = self.areas.setdefault(case.area, AreaTally())
        tally.asked += 1
        self.ties = (self.ties[0] + result.ties[0], self.ties[1] + result.ties[1])
        if result.aliased and self.aliased is None:
            self.aliased = case.name
        if result.single and self.single is None:
            # from here on it is taken for a list in float32
            self.how, self.single = replace(self.how, unit=SINGLE), case.until(1)
            self.found_out.append("float32")
        if case.area == "large":
            self.large = (case.atoms, result.seconds)
        if case.motions:
            self.motions += case.motions
            self.calls += case.steps
        if result.failures:
            tally.failed += 1
            failed = Failed(case.until(result.failures[0].step + 1), result.failures, asked=case)
            tally.codes[failed.code] = tally.codes.get(failed.code, 0) + 1
            if (failed.code, case.area) not in {(other.code, other.asked.area) for other in self.failed}:
                self.failed.append(failed)
        elif result.refused is not None:
            tally.refused += 1
            tally.why[result.refused[1]] = tally.why.get(result.refused[1], 0) + 1

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
        """Cases that were neither asked nor skipped."""
        return self.questions - sum(tally.asked + tally.skipped for tally in self.areas.values())

    @property
    def wrong(self) -> int:
        """Cases that failed."""
        return sum(tally.failed for tally in self.areas.values())

    @property
    def conforms(self) -> bool:
        """Whether it was asked and no case failed."""
        return self.wrong == 0 and self.asked > sum(tally.refused for tally in self.areas.values())


def alike(case: Case) -> Iterator[tuple[str, bool, Case]]:
    """Other ways to put a question: (words, whether it should make no difference, the question)."""
    yield "when it is asked anew", True, case
    if case.atoms > 1:
        yield "with its atoms in reverse order", True, case.only(np.arange(case.atoms)[::-1])
    if case.steps > 1:
        yield "of a list that is made anew at that step", False, replace(case, stills=case.stills[-1:])
    power = float(np.ldexp(1.0, 1 - int(np.frexp(case.r_cut)[1])))
    if power != 1.0:  # of two, which rounds nothing
        scaled = case.changed(lambda x: power * x, lambda cell: power * cell, r_cut=power * case.r_cut)
        stills = tuple(
            replace(still, skin=None if still.skin is None else power * still.skin) for still in scaled.stills
        )
        scaled = replace(scaled, stills=stills, skin=power * case.skin)
        yield f"with all lengths multiplied by {power:.2g}", False, scaled
    wrapped = replace(
        case, stills=tuple(_wrapped(still, np.array(case.pbc)) for still in case.stills), known=None
    )
    if not wrapped.equals(case):
        yield "with its atoms wrapped into the box", False, wrapped


def _wrapped(still: Still, pbc: np.ndarray) -> Still:
    """The same atoms in the images that lie in the box."""
    if not pbc.any() or not len(still.positions):
        return still
    matrix = completed(still.cell, pbc)
    fractions = np.linalg.solve(matrix.T, still.positions.T).T
    home = still.positions - np.where(pbc, np.floor(fractions), 0.0) @ matrix
    # an atom a hair below a face is wrapped onto the one across, by rounding
    over = np.where(pbc, np.linalg.solve(matrix.T, home.T).T >= 1.0, False)
    return replace(still, positions=home - np.where(over, 1.0, 0.0) @ matrix)
