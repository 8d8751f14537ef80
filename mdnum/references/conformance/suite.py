"""Run the conformance suite on a neighbor list. Keep the first failure of each kind."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from mdnum.deadline import Deadline, TimeUp
from mdnum.references.conformance.answer import ListAnswer
from mdnum.references.conformance.case import AREAS, Case, gas, once
from mdnum.references.conformance.judge import (
    CODES,
    DOUBLE,
    SINGLE,
    CaseAnswers,
    CaseResult,
    Conventions,
    Failed,
    Failure,
    RefusalKind,
    Report,
    Truth,
    judge,
    measures_well,
    shown_error,
    truth,
    without_numbers,
)
from mdnum.references.conformance.lists import PairList
from mdnum.references.conformance.questions import alike, plan
from mdnum.references.conformance.session import CallOutcome, RemoteSession, Session
from mdnum.references.conformance.shrinking import reduced

Progress = Callable[[int, int, dict[str, Any]], None]
Saved = Callable[[bool], None]

CASES = 500  # random cases by default; a list that is asked for a share of them has fewer
_PATIENCE = 30.0  # seconds that the 100,000 atoms may be expected to take
_MISTAKES = 0.1  # share of wrong answers above which a right one in float32 shows no precision
_CROWD = (160, 6.0, 130)  # atoms, edge and seed of a crowd that shows how far a kept list has all pairs
_SKIN = 0.3
_ASKING = 0.75  # share of the time after which failures are reproduced, if there are any
_REFUSALS = 6  # refusals that are examined; a list with more kinds of them has other worries


class Examiner:
    """Runs test cases on a neighbor list, and checks the returned pairs.

    Args:
        reuse: use one object of the neighbor list for all test cases.
        apart: call the neighbor list in a separate process, which may crash.
        deadline: time at which this process is terminated, with `TimeUp` for the current test case.
    """

    def __init__(
        self, tested: PairList, reuse: bool = False, apart: bool = False, deadline: Deadline | None = None
    ):
        self.tested = tested
        self.session: Session | RemoteSession = (
            RemoteSession(tested, reuse, deadline) if apart and tested.word else Session(tested, reuse)
        )
        self.report = Report(tested)  # what was found out, of the cases that it was given to `take`
        self.refused: dict[str, RefusalKind] = {}  # the smallest refused case by kind of exception
        self.opening: list[tuple[Case, CallOutcome]] = []  # what became of the plainest questions
        with suppress(TimeUp):
            self._find_conventions()

    def _find_conventions(self) -> None:
        """Determine whether pairs are listed twice, and the signs of shifts and vectors."""
        tested, report = self.tested, self.report
        full, sign, toward = tested.full, 1, 1
        triple = once("a triple through a face", "few", [[0.2, 2, 2], [3.8, 2.1, 2], [0.5, 2.4, 2.2]], 4.0)
        free = once("a free triple", "few", [[0.2, 2, 2], [-0.2, 2.1, 2], [0.5, 2.4, 2.2]])
        for case in (triple, free):
            if tested.limits.refusal(case) is not None:
                continue
            case = replace(case, skin=0.3 if tested.kept else 0.0)
            outcome = self.session.ask(case)[0]
            self.opening.append((case, outcome))
            answer = outcome.answer
            if answer is None or len(answer) == 0:
                continue
            rows = set(zip(answer.i.tolist(), answer.j.tolist(), strict=True))
            if full is None:
                full = all((j, i) in rows for i, j in rows)
                report.found_out.append("full" if full else "half")
            report.shifts = answer.shift is not None
            right = truth(case, 0, reach=case.r_cut + 2 * case.skin)
            for convention in (Conventions(full, a, b) for a in (1, -1) for b in (1, -1)):
                if not judge(answer, right, replace(convention, unit=SINGLE)):
                    sign, toward = convention.sign, convention.toward
                    break
            break
        report.how = Conventions(full is not False, sign, toward, tested.unit or DOUBLE)
        report.superset = bool(tested.superset)
        if tested.kept:
            self._find_padding()

    def _find_padding(self) -> None:
        """Determine whether and how far an updatable list returns pairs beyond the cutoff.

        A declared padding is used. Without it, the padding is the distance of the nearest missing pair minus
        the cutoff.
        """
        report = self.report
        crowd = replace(once("a crowd", "few", gas(*_CROWD), _CROWD[1]), skin=_SKIN)
        if self.tested.limits.refusal(crowd) is not None:
            crowd = replace(once("a free crowd", "few", gas(*_CROWD)), skin=_SKIN)
        # an object of its own: what it keeps of a crowd must not be part of what the suite finds
        reuse, self.session.reuse = self.session.reuse, False
        outcome = self.session.ask(crowd)[0]
        self.session.reuse = reuse
        if isinstance(self.session, Session):
            self.session.close()
        answer, edge, below = outcome.answer, np.inf, 0.0
        if answer is not None:
            right = truth(crowd, 0, reach=0.45 * _CROWD[1])
            rows = np.concatenate([answer.i, answer.j]) * crowd.atoms + np.concatenate([answer.j, answer.i])
            listed = np.isin(right.i * crowd.atoms + right.j, rows)
            edge = float(right.distance[~listed].min(initial=np.inf))
            below = float(right.distance[right.distance < edge].max(initial=0.0))
        if self.tested.superset is None:
            # what does not answer is taken for the usual
            report.superset = answer is None or below > crowd.r_cut + 0.1 * _SKIN
            report.found_out.append("with its skin" if report.superset else "without its skin")
        if outcome.skin is not None:
            report.padding, report.stated = outcome.skin / _SKIN, True
        elif report.superset and crowd.r_cut < edge < np.inf:
            # the nearest pair that is lacking lies somewhat beyond the edge
            whole = below < crowd.r_cut + _SKIN <= edge
            report.padding = 1.0 if whole else (edge - crowd.r_cut) / _SKIN

    def unusable(self) -> str | None:
        """Return the first error if every simple test case failed."""
        reasons = [
            f"for the test case “{case.name}”, {'it raised ' * (why.code == 'RAISED')}{why.text}"
            for case, outcome in self.opening
            if (why := outcome.failure) is not None and why.code in ("RAISED", "MALFORMED")
        ]
        return reasons[0] if reasons and len(reasons) == len(self.opening) else None

    def failures(self, case: Case) -> tuple[Failure, ...]:
        """Return the errors at the first wrong call. No errors if a limit excludes the test case."""
        return () if self.tested.limits.refusal(case) is not None else self.ask(case).failures

    def ask(self, case: Case) -> CaseResult:
        """Run a test case. An accidental exception is a failure, a deliberate rejection is not."""
        began = time.perf_counter()
        outcomes = self.session.ask(case)
        result = CaseResult(case.name, seconds=time.perf_counter() - began)
        how = self.report.how
        for step, outcome in enumerate(outcomes):
            result = replace(result, aliased=result.aliased or outcome.aliased)
            if outcome.refused is not None:
                return replace(result, refused=(step, outcome.refused))
            found = [outcome.failure] if outcome.failure is not None else []
            if outcome.answer is not None:
                found, single, ties = self._judge(case, step, outcome.answer, how)
                how = replace(how, unit=SINGLE) if single else how
                ties = ties if step == 0 else result.ties
                result = replace(result, ties=ties, single=single or result.single)
                if outcome.changed:
                    found.append(Failure("CHANGED_INPUT", f"the call wrote to its {outcome.changed}"))
            if found:
                return replace(result, failures=tuple(replace(failure, step=step) for failure in found))
        return result

    def take(self, case: Case, result: CaseResult) -> None:
        """Record the result of a test case. Keep the smallest rejected case of each kind."""
        self.report.take(case, result)
        if result.refused is not None:
            step, words = result.refused
            case, like = case.until(step + 1), without_numbers(words)
            known = self.refused.get(like)
            if known is None or (case.steps, case.atoms) < (known.case.steps, known.case.atoms):
                self.refused[like] = RefusalKind(words, case)

    def _judge(
        self, case: Case, step: int, answer: ListAnswer, how: Conventions
    ) -> tuple[list[Failure], tuple[float, float] | None, tuple[int, int]]:
        """Return failures, the error of a float32 list (or None), and numbers of pairs at r_cut."""
        reach = self.report.reach(case) if self.report.superset else None
        right = truth(case, step, reach=reach, unit=how.unit)
        found = judge(answer, right, how)
        if found and step and reach is not None and any(failure.code == "EXTRA" for failure in found):
            # a box that grows takes listed pairs further apart than any skin: harmless, and no phantoms
            right = _with_earlier(case, step, right, reach)
            found = judge(answer, right, how)
        # a list that is stale by a hair is not one in single precision, nor one that is wrong anyway; and
        # whoever measures in double and decides in single loses pairs that it knows to be inside
        measures = {failure.code for failure in found} <= {"DISTANCES", "VECTORS"}
        if (
            found and (step == 0 or measures) and not case.known and len(answer) > 0
            and self.report.wrong <= _MISTAKES * (self.report.asked + 1)
            and self.tested.unit is None and how.unit == DOUBLE and not measures_well(answer, right, how)
        ):  # fmt: skip
            coarse = right if step else truth(case, step, reach=reach, unit=SINGLE)
            error = shown_error(answer, coarse, how)
            if error is not None:
                return [], error, (0, 0)
        counts = not found and step == 0 and how.unit == DOUBLE and not self.report.superset
        return found, None, _ties(answer, right) if counts else (0, 0)


def _ties(answer: ListAnswer, right: Truth) -> tuple[int, int]:
    """Return the numbers of listed and unlisted pairs at r_cut. Both are 0 without integer coordinates."""
    numbers = np.concatenate([right.positions.ravel(), right.cell.ravel(), [right.r_cut]])
    if not ((numbers == np.rint(numbers)).all() and np.abs(numbers).max(initial=0.0) < 1e6):
        return 0, 0  # on small integers no arithmetic rounds
    rows = set(zip(answer.i.tolist(), answer.j.tolist(), strict=True))
    off = np.abs(right.distance - right.r_cut) > 1e-6
    listed = [
        (i, j) in rows or (j, i) in rows
        for i, j in zip(right.i[right.tie].tolist(), right.j[right.tie].tolist(), strict=True)
        if not off[(right.i == i) & (right.j == j)].any()  # else another image of the pair is inside
    ]
    return sum(listed), len(listed) - sum(listed)


def _with_earlier(case: Case, step: int, right: Truth, reach: float) -> Truth:
    """Return the correct pairs at this call and at earlier calls since the list was built."""
    rows = [(right.i, right.j, right.shift)]
    for before in range(step - 1, -1, -1):
        if len(case.stills[before].positions) != len(right.positions) or case.stills[before + 1].fresh:
            break
        then = truth(case, before, reach=max(case.r_cut + case.skin, case.r_cut + (reach - case.r_cut) / 2))
        rows.append((then.i, then.j, then.shift))
    i, j, shift = (np.concatenate([part[n] for part in rows]) for n in range(3))
    table = np.unique(np.column_stack([i, j, shift]), axis=0)
    i, j, shift = table[:, 0], table[:, 1], table[:, 2:]
    distance = np.linalg.norm(right.positions[j] - right.positions[i] + shift @ right.cell, axis=1)
    no = np.zeros(len(i), bool)
    return replace(
        right, i=i, j=j, shift=shift, distance=distance, tie=no, inside=distance < case.r_cut, reach=np.inf
    )


def examine(
    tested: PairList,
    *,
    cases: int = CASES,
    seed: int = 0,
    large: bool = True,
    stop: bool = False,
    shrink: bool = True,
    apart: bool = False,
    asked: Iterable[Case] | None = None,
    progress: Progress | None = None,
    examiner: Examiner | None = None,
    deadline: Deadline | None = None,
    answers: CaseAnswers | None = None,
    saved: Saved | None = None,
) -> Report:
    """Run the conformance suite on a neighbor list.

    Args:
        cases: number of random test cases, in addition to the named ones.
        seed: seed of the random test cases.
        large: include test cases with 5,000 and 100,000 atoms.
        stop: stop at the first failure.
        shrink: reduce failing test cases to a few atoms.
        apart: call the list in a separate process, so that a crash is reported; requires a list from `load`.
        asked: test cases to run instead of all.
        progress: called with (test cases done, number of test cases, text).
        examiner: existing examiner in which the list's conventions are known, instead of a new one.
        deadline: no test case starts after this time; the remaining ones are counted.
        answers: results of an earlier examination of the same test cases, which are not run again; new
            results are added.
        saved: called at the beginning and after each new result, with True if it must be saved at once.

    Returns:
        the test cases and their results. A neighbor list may raise exceptions, return any value or write to
        its input: these are reported as failures.
    """
    began = time.perf_counter()
    deadline, answers = deadline or Deadline(), answers or CaseAnswers()
    examiner = examiner or Examiner(tested, reuse=True, apart=apart, deadline=deadline)
    report, session = examiner.report, examiner.session
    saved, progress = saved or (lambda urgent: None), progress or (lambda *_: None)
    far = apart and bool(tested.word)
    parts: list[tuple[int, Iterable[Case]]] = (
        plan(tested, cases, seed, report.padding, far=far, large=large)
        if asked is None
        else [(len(given := list(asked)), given)]
    )
    report.questions, report.breadth = sum(count for count, _ in parts), parts[0][0]
    saved(True)  # a page can be made of the folder from here on
    # where there are failures, some of the time is for them
    asking, last = deadline.part(_ASKING), max(map(int, answers.cases), default=-1)
    # what the process was asked so far, and had been before each failure
    history, starts, stopped = [case for case, _ in examiner.opening], session.starts, False
    earlier: dict[tuple[str, str], tuple[Case, ...]] = {}
    for number, case in enumerate(chain.from_iterable(part for _, part in parts)):
        session.deadline = asking if report.failed else deadline
        if number > last and (stopped or session.deadline.passed):
            break
        progress(number, report.questions, {"phase": "asking", "unit": "cases"})
        known = result = answers.of(number, case)
        why = tested.limits.refusal(case)
        if why is None and result is None and case.area == "large":
            why = _too_long(report, case)
        if why is not None:
            report.skip(case, why)
            continue
        if result is None:
            report.running = case.name
            try:
                result = answers.cases[str(number)] = examiner.ask(case)
            except TimeUp:
                continue
            report.running = None
            saved(bool(result.failures))
            if session.starts != starts:
                starts, history = session.starts, []
        examiner.take(case, result)
        for failed in report.failed:
            earlier.setdefault((failed.code, failed.case.area), () if known else tuple(history))
        if not known:
            history.append(case)
        stopped = stop and bool(result.failures)
    session.deadline = deadline
    with suppress(TimeUp):
        if report.questions and not stopped and not deadline.passed:
            report.keeps_order = _keeps_order(examiner)
        session.reuse = session.reuse and not shrink
        if shrink and not deadline.passed:
            report.refusals = _refusals(examiner)
    if shrink:
        for number, failed in enumerate(report.failed):
            progress(number, len(report.failed), {"phase": "shrinking", "unit": "failures"})
            name = f"{failed.code} {failed.case.area} {failed.case.name}"
            smaller = answers.shrunk.get(name)
            if smaller is None and not deadline.passed:
                # one script with the earlier calls of a code is enough
                done = any(one.earlier for one in report.failed if one.code == failed.code)
                before = () if done else earlier[failed.code, failed.case.area]
                smaller = reduced(examiner, failed, before, deadline)
                if deadline.passed:
                    report.whole = False
                elif smaller.case.known is None:  # pairs that are known in closed form alone are not kept
                    answers.shrunk[name] = smaller
                    saved(True)
            elif smaller is None:
                report.whole = False
            report.failed[number] = smaller or failed
        report.failed = distinct(report.failed)
    report.areas = {area: report.areas[area] for area in AREAS if area in report.areas}
    session.close()
    report.seconds = time.perf_counter() - began
    return report


def _keeps_order(examiner: Examiner) -> bool | None:
    """Return whether three identical calls return the same pairs in the same order. None if a call fails."""
    for case in (once("order", "reuse", gas(40, 6.0, 120), 6.0), once("order", "reuse", gas(40, 3.0, 120))):
        case = replace(case, skin=0.3 if examiner.tested.kept else 0.0)
        if examiner.tested.limits.refusal(case) is None:
            found = (examiner.session.ask(case)[0].answer for _ in range(3))
            answers = [answer for answer in found if answer is not None]
            return all(map(answers[0].same, answers)) if len(answers) == 3 else None
    return None


def _too_long(report: Report, case: Case) -> str | None:
    """Return why a large test case would take too long, or None."""
    if report.large is None:
        return None
    atoms, seconds = report.large
    # lists that are not linear in the number of atoms are squared in it
    expected = seconds * (case.atoms / atoms) ** (2 if seconds > 1.0 else 1)
    return f"{case.atoms:,} atoms would take more than {_PATIENCE:.0f} s" if expected > _PATIENCE else None


def _refusals(examiner: Examiner) -> list[RefusalKind]:
    """Return the kinds of rejected test cases, and the accepted variants of each.

    Each variant runs in a new process, or with a new object.
    """
    found = []
    for refusal in list(examiner.refused.values())[:_REFUSALS]:
        answered: dict[bool, list[str]] = {True: [], False: []}
        for how, even, other in alike(refusal.case):
            if examiner.tested.limits.refusal(other) is None:
                examiner.session.close()
                outcomes = examiner.session.ask(other)
                if len(outcomes) == other.steps and outcomes[-1].answer is not None:
                    answered[even].append(how)
        found.append(replace(refusal, uneven=tuple(answered[True]), answers=tuple(answered[False])))
    return found


def distinct(failed: Iterable[Failed]) -> list[Failed]:
    """Return the smallest failure of each kind. One error can cause many failures.

    Failures with the same code and equal numbers of atoms, calls and periodic axes count as one error.
    Exceptions and malformed results count as one error if their messages differ only in numbers.
    """

    def size(failure: Failed) -> tuple[bool, bool, int, int, int]:
        case, shown = failure.case, failure.reproduced is not False
        return not shown, not failure.alone, case.atoms, case.steps, sum(case.pbc)

    kept: dict[Any, Failed] = {}
    for failure in sorted(failed, key=size):
        case = failure.case
        key: Any = failure.worst.kind
        if failure.code not in ("RAISED", "CRASHED", "MALFORMED"):
            key = (key, min(case.atoms, 3), min(case.steps, 2), any(case.pbc))
            if not failure.alone:
                # what was kept from other questions is a mistake of its own, and its case was not shrunk
                key = (failure.code, "not alone")
        kept.setdefault(key, failure)
    areas = list(AREAS)
    return sorted(kept.values(), key=lambda one: (CODES.index(one.code), areas.index(one.case.area)))
