"""Compare the pairs from a neighbor list with the exact pairs."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, Literal, get_args

import numpy as np
from annotated_types import Ge
from numpy import ndarray
from pydantic import FiniteFloat

from mdnum.errors import InputError
from mdnum.references.conformance.answer import ListAnswer
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.lists import PairList
from mdnum.references.oracle import PairSet, all_pairs, completed, exactly_inside, rounding_bound

Count = Annotated[int, Ge(0)]
Seconds = Annotated[FiniteFloat, Ge(0)]
SINGLE, DOUBLE = 2.0**-24, 2.0**-53
_NAMED = 3  # pairs in a message
#: Kinds of errors, in order of severity: the first ones cause wrong energies without an error message.
Code = Literal[
    "CRASHED", "MISSING", "EXTRA", "DUPLICATE", "SELF", "RANGE", "ONE_SIDED", "SHIFTS", "DISTANCES",
    "VECTORS", "MALFORMED", "NO_ANSWER", "CHANGED_INPUT", "RAISED",
]  # fmt: skip
CODES: tuple[Code, ...] = get_args(Code)
SILENT = ("CRASHED", "NO_ANSWER", "RAISED")  # those of cases in which nothing came back


@dataclass(frozen=True)
class Truth(PairSet):
    """Exact pairs of a test case, and pairs slightly beyond the cutoff."""

    # positions, cell: as the list was given them; rows of axes that do not repeat are zero
    positions: ndarray
    cell: ndarray
    tie: ndarray  # the pairs at exactly r_cut
    r_cut: float  # length
    # `rounding_bound` for a unit roundoff of 1, times what fractional coordinates of a skewed cell lose: how
    # far a distance can be off, by the roundoff of the arithmetic
    scale: float
    reach: float  # pairs as far as this may be listed, length; the cutoff unless a list holds a skin

    def needed(self, unit: float) -> ndarray:
        """Return a mask of the pairs that a list with a given unit roundoff must contain."""
        return self.distance < self.r_cut - unit * self.scale

    def allowed(self, unit: float) -> ndarray:
        """Return a mask of the pairs that a list with a given unit roundoff may contain."""
        return self.distance <= self.reach + unit * self.scale


def truth(case: Case, step: int, *, reach: float | None = None, unit: float = DOUBLE) -> Truth:
    """Compute the pairs that a neighbor list must return, and those that it may return.

    Args:
        reach: largest distance of the pairs, length; the cutoff by default.
        unit: the largest unit roundoff of a neighbor list that is compared with these pairs.
    Error: decisions within rounding error of the cutoff use rational arithmetic; see `all_pairs`.
    """
    still, pbc = case.stills[step], np.array(case.pbc)
    positions, r_cut = still.positions, case.r_cut
    cell = np.where(pbc[:, None], still.cell, 0.0)
    scale = rounding_bound(positions, cell, r_cut, unit_roundoff=1.0) * conditioning(cell, pbc)
    reach = r_cut if reach is None else reach
    if case.known is not None and case.steps == 1:
        pairs = case.known
    else:
        pairs = all_pairs(positions, still.cell, pbc, r_cut, reach=reach + unit * scale)
    tie = np.zeros(len(pairs), bool)
    for row in np.flatnonzero(pairs.exact & ~pairs.inside):
        i, j, shift = int(pairs.i[row]), int(pairs.j[row]), pairs.shift[row]
        tie[row] = exactly_inside(positions, cell, i, j, shift, r_cut, closed=True)
    return Truth(
        **vars(pairs), positions=positions, cell=cell, tie=tie, r_cut=r_cut, scale=scale, reach=reach
    )


def conditioning(cell: ndarray, pbc: ndarray) -> float:
    """Factor (at least 1) by which fractional coordinates amplify rounding errors.

    Source: Higham, Accuracy and Stability, 2nd ed., section 7.1. The factor is the condition number of the
    periodic lattice vectors. Each vector is first scaled to length 1.
    """
    if not pbc.any():
        return 1.0
    rows = cell[pbc] / np.linalg.norm(cell[pbc], axis=1)[:, None]
    return max(1.0, float(np.linalg.cond(rows)))


def keys(count: int, i: ndarray, j: ndarray, shift: ndarray | None, *others: tuple) -> list[ndarray]:
    """Return an integer key for each row (i, j, shift). Equal rows have equal keys.

    Keys of the rows of `others` are returned, too. `count` is the number of atoms.
    """
    sets = [(i, j, shift), *others]
    lengths = np.cumsum([0, *(len(rows[0]) for rows in sets)])
    key = np.concatenate([np.asarray(rows[0], np.int64) * count + rows[1] for rows in sets])
    if shift is not None:
        columns = np.concatenate([np.asarray(rows[2]) for rows in sets]).astype(np.int64).T
        largest = count * count
        for column in columns:
            low, high = int(column.min(initial=0)), int(column.max(initial=0))
            largest *= high - low + 1
            if largest >= 2**62:
                # by rank: shifts of atoms far outside the box are large, but few of them differ
                _, column = np.unique(column, return_inverse=True)
                _, key = np.unique(key, return_inverse=True)
                low, high = 0, len(column)
                largest = len(key) * (high + 1)
            key = key * (high - low + 1) + (column - low)
    return [key[first:last] for first, last in pairwise(lengths)]


@dataclass(frozen=True)
class Conventions:
    """Conventions of a neighbor list, such as the sign of shifts. Every convention is accepted."""

    full: bool = True  # every pair from both of its atoms (True), or once (False)
    sign: int = 1  # +1 where shifts are added to atom j, -1 where they are added to atom i
    toward: int = 1  # +1 where vectors point from i to j, -1 where they point from j to i
    unit: float = DOUBLE  # roundoff of its arithmetic: 2**-53 or 2**-24


@dataclass(frozen=True)
class Failure:
    """One error in the pairs returned by a neighbor list."""

    code: Code  # one of `CODES`
    text: str  # what was seen, with atoms and numbers
    step: Count = 0  # at which still

    @property
    def kind(self) -> tuple[str, str]:
        """Error code and exception message. Both stay the same in a reduced test case."""
        text = self.text if self.code in ("RAISED", "CRASHED", "MALFORMED") else ""
        return self.code, without_numbers(text)


def without_numbers(text: str) -> str:
    """Replace the numbers in a message, so that messages can be compared."""
    return re.sub(r"[-+\d.e]+", "#", text)


def judge(answer: ListAnswer, truth: Truth, how: Conventions) -> list[Failure]:
    """Return all errors in the pairs from a neighbor list. Without errors, the result is empty.

    A pair within rounding error of the cutoff (`Truth.scale` times the unit roundoff) may be listed or
    omitted. The lists of its two atoms must agree.

    Args:
        truth: exact pairs, including all distances at which pairs may be listed.
        how: conventions of the neighbor list.
    """
    n = len(truth.positions)
    outside = (answer.i < 0) | (answer.i >= n) | (answer.j < 0) | (answer.j >= n)
    if outside.any():
        row = int(np.argmax(outside))
        text = (
            f"{int(outside.sum())} of {len(answer)} rows name atoms outside 0 ... {n - 1}: row {row} is "
            f"({answer.i[row]}, {answer.j[row]})"
        )
        return [Failure("RANGE", text)]
    found = _compare(answer, truth, how)
    # nothing that shifts would mend: a pair listed once, an atom that is its own neighbor where it stands
    plain = {failure.code for failure in found} <= {"ONE_SIDED", "SELF"}
    shifted = found and not plain and answer.shift is not None
    if shifted and not _compare(replace(answer, shift=None), truth, how):
        hint = _shift_hint(answer, truth, how)
        return [Failure("SHIFTS", f"the atoms are right and the shifts are not: {found[0].text}{hint}")]
    return found or _measures(answer, truth, how)


def _compare(answer: ListAnswer, truth: Truth, how: Conventions) -> list[Failure]:
    """Return the errors found by matching the listed pairs with the exact pairs."""
    i, j, shifts = answer.i, answer.j, answer.shift is not None
    shift = how.sign * answer.shift if answer.shift is not None else np.zeros((len(i), 3), np.int64)
    right = _both(truth) if how.full else (truth.i, truth.j, truth.shift)
    if not how.full:
        i, j, shift = _one_way(i, j, shift)
    own = (i, i, np.zeros_like(shift))
    told = (i, j, shift if shifts else None)
    key, right_key, turned, own = keys(len(truth.positions), *told, right, (j, i, -shift), own)
    needed_rows, allowed_rows = (
        np.tile(rows, 2 if how.full else 1) for rows in (truth.needed(how.unit), truth.allowed(how.unit))
    )
    labels, number = np.unique(np.concatenate([key, right_key, turned]), return_inverse=True)
    mine, theirs, mirror = np.split(number, [len(key), len(key) + len(right_key)])
    have, mirrored = np.bincount(mine, minlength=len(labels)), np.bincount(mirror, minlength=len(labels))
    needed = np.bincount(theirs[needed_rows], minlength=len(labels))
    allowed = np.bincount(theirs[allowed_rows], minlength=len(labels))
    lacking, surplus = np.clip(needed - have, 0, None), np.clip(have - allowed, 0, None)
    found = []

    def missing(gone: ndarray, what: str) -> str:
        rows = np.flatnonzero(needed_rows & (gone[theirs] > 0))
        named = [
            f"{right[0][row]}-{right[1][row]}{_through(right[2][row])} at "
            f"{truth.distance[row % len(truth.i)]:.9g}"
            for row in rows[:_NAMED]
        ]
        more = ", ..." if len(rows) > _NAMED else ""
        return f"{int(gone.sum())} of {int(needed_rows.sum())} rows {what}: {', '.join(named)}{more}"

    # a pair that is there from its other side is a mistake of another kind
    one_sided = (lacking > 0) & (mirrored > have) & how.full
    gone = lacking * ~one_sided
    if gone.any():
        found.append(Failure("MISSING", missing(gone, f"missing inside r_cut = {truth.r_cut:.9g}")))
    if one_sided.any():
        found.append(Failure("ONE_SIDED", missing(one_sided * 1, "from one of its atoms only")))
    excess = surplus[mine] > 0
    selfs = excess & (key == own) & (shifts or allowed[mine] == 0)
    repeated = excess & ~selfs & (allowed[mine] > 0)
    kinds: dict[Code, ndarray] = {"EXTRA": excess & ~selfs & ~repeated, "DUPLICATE": repeated, "SELF": selfs}
    for code, rows in kinds.items():
        if not rows.any():
            continue
        first = int(np.argmax(rows))
        a, b, image = int(i[first]), int(j[first]), _through(shift[first]) if shifts else ""
        count = int(surplus[np.unique(mine[rows])].sum())
        if code == "EXTRA":
            apart = truth.positions[b] - truth.positions[a] + shift[first] @ truth.cell
            far = f" at {np.linalg.norm(apart):.9g}," if shifts else ", which are not inside"
            text = f"{count} rows beyond the cutoff, first {a}-{b}{image}{far} r_cut = {truth.r_cut:.9g}"
        elif code == "DUPLICATE":
            times, right_times = int((mine == mine[first]).sum()), int(allowed[mine[first]])
            text = f"{a}-{b}{image} is listed {times} times instead of {right_times}; {count} rows too many"
        else:
            text = f"atoms that are their own neighbors: {count}, first {a}"
        found.append(Failure(code, text))
    if not found and how.full and not np.array_equal(have, mirrored):
        row = int(np.argmax((have != mirrored)[mine]))
        has = f"{i[row]} has {j[row]} as a neighbor, and not the other way round"
        found.append(Failure("ONE_SIDED", f"within rounding of the cutoff, {has}"))
    return found


def _through(shift: ndarray) -> str:
    """Return a periodic image shift as text. The text of a zero shift is empty."""
    return f" + ({', '.join(str(int(part)) for part in shift)})" if np.any(shift) else ""


def _both(truth: Truth) -> tuple[ndarray, ndarray, ndarray]:
    """Return every exact pair twice, once for each of its two atoms."""
    columns = (truth.i, truth.j), (truth.j, truth.i), (truth.shift, -truth.shift)
    i, j, shift = map(np.concatenate, columns)
    return i, j, shift


def _one_way(i: ndarray, j: ndarray, shift: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Orient every pair so that i < j. For i = j, the first nonzero shift is positive."""
    a, b, c = shift.T if len(shift) else np.zeros((3, 0), np.int64)
    leading = (a > 0) | ((a == 0) & ((b > 0) | ((b == 0) & (c > 0))))
    turn = (i > j) | ((i == j) & ~leading)
    return np.where(turn, j, i), np.where(turn, i, j), np.where(turn[:, None], -shift, shift)


def _shift_hint(answer: ListAnswer, truth: Truth, how: Conventions) -> str:
    """Return, as text, the shift convention that would explain wrong shifts."""
    assert answer.shift is not None
    if not _compare(answer, truth, replace(how, sign=-how.sign)):
        return "; added to the other atom they are right"
    axes = np.any(truth.cell != 0, axis=1)
    home = np.where(axes, np.floor(np.linalg.solve(completed(truth.cell, axes).T, truth.positions.T).T), 0)
    shift = answer.shift + how.sign * (home[answer.i] - home[answer.j]).astype(np.int64)
    right = not _compare(replace(answer, shift=shift), truth, how)
    return "; they are right for positions wrapped into the box" if right else ""


def _measures(answer: ListAnswer, truth: Truth, how: Conventions) -> list[Failure]:
    """Return the errors of distances and vectors for correct pairs."""
    if answer.distance is None and answer.vector is None:
        return []
    # a bound for a length near the cutoff; a code may form it from squares of its coordinates' differences
    bound, bent, found = 2 * how.unit * truth.scale, None, []
    if answer.shift is not None:
        shift = how.sign * answer.shift
        right = truth.positions[answer.j] - truth.positions[answer.i] + shift @ truth.cell
        length = np.linalg.norm(right, axis=1)
        off = None if answer.distance is None else np.abs(answer.distance - length)
        bent = None if answer.vector is None else np.abs(how.toward * answer.vector - right).max(axis=1)
    else:
        # without shifts a row is any of the images of its two atoms: the one whose length is nearest
        mine, theirs = keys(len(truth.positions), answer.i, answer.j, None, _both(truth))
        told = answer.distance
        if told is None:
            assert answer.vector is not None
            told = np.linalg.norm(answer.vector, axis=1)
        off = _nearest(mine, told, theirs, np.tile(truth.distance, 2))
    measured: dict[Code, tuple[ndarray | None, str]] = {
        "DISTANCES": (off, "distance"),
        "VECTORS": (bent, "vector"),
    }
    for code, (error, what) in measured.items():
        if error is None or not (wrong := ~(error <= bound)).any():
            continue
        row = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
        text = (
            f"{int(wrong.sum())} of {len(answer)} rows have a {what} that is off by more than {bound:.2g}, "
            f"most {answer.i[row]}-{answer.j[row]} by {error[row]:.3g}"
        )
        found.append(Failure(code, text))
    return found


def shown_error(answer: ListAnswer, truth: Truth, how: Conventions) -> tuple[float, float] | None:
    """Return the rounding error of the pairs. None if pairs are wrong even for float32."""
    units = 2.0 ** np.arange(-52, -23)
    unit = next((unit for unit in units if not judge(answer, truth, replace(how, unit=unit))), None)
    return None if unit is None else (float(unit * truth.scale), float(unit / DOUBLE))


def measures_well(answer: ListAnswer, truth: Truth, how: Conventions) -> bool:
    """Return whether distances or vectors are as accurate as the declared unit roundoff."""
    given = answer.distance is not None or answer.vector is not None
    n = len(truth.positions)
    named = bool(((answer.i >= 0) & (answer.i < n) & (answer.j >= 0) & (answer.j < n)).all())
    return given and len(answer) > 0 and named and not _measures(answer, truth, how)


def _nearest(mine: ndarray, told: ndarray, theirs: ndarray, length: ndarray) -> ndarray:
    """Return the difference between each value and the nearest reference value with the same key."""
    order = np.lexsort((length, theirs))
    theirs, length = theirs[order], length[order]
    first, last = np.searchsorted(theirs, mine, "left"), np.searchsorted(theirs, mine, "right")
    best = np.full(len(mine), np.inf)
    for back in range(int((last - first).max(initial=0))):
        here = first + back
        ok = here < last
        best[ok] = np.minimum(best[ok], np.abs(told[ok] - length[here[ok]]))
    return np.where(np.isnan(told), np.nan, best)


# --- what becomes of the cases that a list is asked ---


@dataclass(frozen=True)
class CaseResult:
    """Result of one test case."""

    case: str  # its name
    failures: tuple[Failure, ...] = ()  # what was wrong at the first step at which anything was
    refused: tuple[Count, str] | None = None  # the step and the exception by which the list refused it
    ties: tuple[Count, Count] = (0, 0)  # pairs at exactly r_cut (counted, not counted)
    aliased: bool = False  # a call wrote to the arrays of the answer before it
    # where it was decided as float32 does and float64 would not: the error that it shows, length, within a
    # factor of 2; and how many times that of float64 it is
    single: tuple[Seconds, Seconds] | None = None
    seconds: Seconds = 0.0  # that the list took


@dataclass(frozen=True)
class Failed:
    """A failed test case, reduced to a few atoms if possible."""

    case: Case  # up to the step that failed; its name and area are those of the question
    failures: tuple[Failure, ...]  # what was wrong at that step
    # it fails when it is the first that a new process is asked; else what was asked before matters
    alone: bool = True
    earlier: tuple[Case, ...] = ()  # questions that a new process must be asked before it fails
    reproduced: bool | None = None  # whether its script showed it when it was run; None where it was not run

    def __post_init__(self) -> None:
        if not self.failures or any(failure.step >= self.case.steps for failure in self.failures):
            raise ValueError("a test case is marked as failed, but none of its steps has a failure")

    @property
    def worst(self) -> Failure:
        """The most severe failure in the test case, which is the failure reported."""
        return min(self.failures, key=lambda failure: CODES.index(failure.code))

    @property
    def code(self) -> str:
        """Code of the most severe failure in the test case."""
        return self.worst.code


@dataclass
class CaseAnswers:
    """Results of test cases by number, and failures reduced to a few atoms.

    Test cases are not stored: the seed generates them again.
    """

    cases: dict[str, CaseResult] = field(default_factory=dict)
    shrunk: dict[str, Failed] = field(default_factory=dict)

    def of(self, number: int, case: Case) -> CaseResult | None:
        """Return the result of a test case, if any. Raise InputError if the stored case differs."""
        result = self.cases.get(str(number))
        if result is None:
            return None
        steps = [failure.step for failure in result.failures]
        steps += [result.refused[0]] if result.refused is not None else []
        if result.case != case.name or any(step >= case.steps for step in steps):
            raise InputError(
                f"test case {number} in the folder is {result.case!r}; the installed version of mdnum has "
                f"the test case {case.name!r} with {case.steps} steps instead",
                remedy="Start the tests again in a new folder",
            )
        return result


@dataclass(frozen=True)
class RefusalKind:
    """A kind of test case that a neighbor list rejects with an exception."""

    exception: str  # in words
    case: Case  # the smallest question that met it, up to the step that was refused
    # how the same question was put and answered where no list has a reason to treat it differently
    uneven: tuple[str, ...] = ()
    # how it was put and answered where a list may treat it differently: another unit of length, other images
    # of the atoms
    answers: tuple[str, ...] = ()


@dataclass
class AreaTally:
    """Numbers of test cases in one area, by result."""

    # asked, refused, skipped: cases; refused by the list itself, skipped because of its limits
    asked: int = 0
    refused: int = 0
    skipped: int = 0
    codes: dict[str, int] = field(default_factory=dict)  # failed cases by code of their worst failure
    why: dict[str, int] = field(default_factory=dict)  # reasons of refusing and skipping, with how often

    @property
    def failed(self) -> int:
        """Number of test cases with wrong pairs or an exception."""
        return sum(self.codes.values())

    @property
    def silent(self) -> int:
        """Number of test cases in which the neighbor list crashed, raised an error or timed out."""
        return sum(self.codes.get(code, 0) for code in SILENT)

    @property
    def passed(self) -> int:
        """Number of test cases in which the pairs are correct."""
        return self.asked - self.failed - self.refused


@dataclass
class Report:
    """Results of the conformance suite for one neighbor list."""

    tested: PairList  # the list
    how: Conventions = field(default_factory=Conventions)  # its conventions, as declared or found out
    found_out: list[str] = field(default_factory=list)  # which of them were found out rather than declared
    # a case that it decides as float32 does and float64 would not, where that was found out; and its error
    single: Case | None = None
    error: tuple[float, float] = (0.0, 1.0)  # as in `CaseResult.single`
    ties: tuple[int, int] = (0, 0)  # (counted, not counted) pairs at exactly r_cut
    keeps_order: bool | None = None  # whether the same question gives the same rows in the same order
    superset: bool = False  # pairs beyond the cutoff are part of what it gives
    # out to which a list that is kept has all pairs, in units of the skin that it is given; None where it
    # neither states nor shows it
    padding: float | None = None
    stated: bool = False  # it states it, rather than shows it
    shifts: bool = False  # whether it gives the images that pairs are through
    areas: dict[str, AreaTally] = field(default_factory=dict)  # tallies by area
    # the first case in which a call wrote to the arrays of the answer before it, or None
    aliased: str | None = None
    refusals: list[RefusalKind] = field(default_factory=list)  # kinds of refusals, and what each depends on
    # the first failure of each kind and area, in the order in which they were met
    failed: list[Failed] = field(default_factory=list)
    seconds: float = 0.0  # in all
    large: tuple[int, float] | None = None  # (atoms, seconds) of its largest question
    questions: int = 0  # cases that there are, those that it does not claim to do included
    breadth: int = 0  # of them, those at the beginning without which there is no verdict
    running: str | None = None  # the case whose call was cut off when the asking ended
    motions: int = 0  # against its rebuild rule, that it was asked; and calls: of it in those
    calls: int = 0
    whole: bool = True  # all failures were shrunk as far as they are

    def skip(self, case: Case, why: str) -> None:
        """Count a test case that is skipped."""
        tally = self.areas.setdefault(case.area, AreaTally())
        tally.skipped += 1
        tally.why[why] = tally.why.get(why, 0) + 1

    def take(self, case: Case, result: CaseResult) -> None:
        """Count the result of a test case."""
        tally = self.areas.setdefault(case.area, AreaTally())
        tally.asked += 1
        self.ties = (self.ties[0] + result.ties[0], self.ties[1] + result.ties[1])
        if result.aliased and self.aliased is None:
            self.aliased = case.name
        if result.single and self.single is None:
            # from here on it is taken for a list in float32
            self.how, self.single = replace(self.how, unit=SINGLE), case.until(1)
            self.error = result.single
            self.found_out.append("float32")
        if case.area == "large":
            self.large = (case.atoms, result.seconds)
        if case.motions:
            self.motions += case.motions
            self.calls += case.steps
        if result.failures:
            failed = Failed(case.until(result.failures[0].step + 1), result.failures)
            tally.codes[failed.code] = tally.codes.get(failed.code, 0) + 1
            if (failed.code, case.area) not in {(other.code, other.case.area) for other in self.failed}:
                self.failed.append(failed)
        elif result.refused is not None:
            tally.refused += 1
            tally.why[result.refused[1]] = tally.why.get(result.refused[1], 0) + 1

    def reach(self, case: Case) -> float:
        """Return the largest distance of pairs in a list that may go beyond the cutoff.

        Since the search, both atoms of a pair may have moved as far as the skin allows.
        """
        usual = case.r_cut + 2 * case.skin if case.skin else 1.5 * case.r_cut
        own = 0.3 * (self.padding or 1.0)  # asked with a skin of 0.3 cutoffs
        return usual if own < 0.31 else max(usual, (1 + 2 * own) * case.r_cut)

    def total(self, count: str) -> int:
        """Return a count, summed over all areas of the conformance suite."""
        return sum(getattr(tally, count) for tally in self.areas.values())

    @property
    def asked(self) -> int:
        """Number of test cases that were run."""
        return self.total("asked")

    @property
    def left(self) -> int:
        """Number of test cases that were neither run nor skipped."""
        return self.questions - self.asked - self.total("skipped")

    @property
    def wrong(self) -> int:
        """Number of failed test cases."""
        return self.total("failed")

    @property
    def conforms(self) -> bool:
        """True if the neighbor list was tested and no test case failed."""
        return self.wrong == 0 and self.asked > self.total("refused")
