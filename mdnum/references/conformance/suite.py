"""One list through all questions: which it answers as it should, and the first failure of each kind."""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mdnum.deadline import Deadline
from mdnum.references.conformance.alike import looked_into
from mdnum.references.conformance.answers import Answers, as_row
from mdnum.references.conformance.case import AREAS, KEPT, Case, one
from mdnum.references.conformance.catalog import gas
from mdnum.references.conformance.crowds import LARGE_EDGE, SMALL_EDGE, lattice, vast
from mdnum.references.conformance.judge import CODES, Conventions, Failure, judge, measures_well
from mdnum.references.conformance.lists import Outcome, PairList, Session
from mdnum.references.conformance.questions import as_kept, drawn, questions
from mdnum.references.conformance.remote import RemoteSession
from mdnum.references.conformance.results import Failed, Report, Tally
from mdnum.references.conformance.truth import DOUBLE, SINGLE, Truth, truth

Progress = Callable[[int, int, dict[str, Any]], None]

#: Random cases by default; a list that is asked for a share of them has fewer.
CASES = 500
#: Seconds that the 100,000 atoms may be expected to take.
_PATIENCE = 30.0
#: Share of wrong answers above which one that would be right in float32 says nothing about precision.
_MISTAKES = 0.1
#: Atoms, edge and seed of the crowd that shows how far a list that is kept has all pairs, and its skin.
_CROWD = (160, 6.0, 130)
_SKIN = 0.3
#: How much of the smallest motion a lost pair is followed for.
_FURTHEST = 2.5


class Examiner:
    """Asks a list and judges its answers; finds out its conventions first.

    Args:
        tested: the list.
        reuse: ask one object in all cases.
        apart: call it in a process of its own, which may crash.
    """

    def __init__(self, tested: PairList, reuse: bool = False, apart: bool = False):
        self.tested = tested
        self.session: Session | RemoteSession = (
            RemoteSession(tested, reuse) if apart and tested.word else Session(tested, reuse)
        )
        self.report = Report(tested)
        # the smallest refused case by the words of the exception, but for numbers
        self.refused: dict[str, tuple[str, Case]] = {}
        self._refused_at = 0
        # what became of the plainest questions
        self.opening: list[tuple[Case, Outcome]] = []
        self._find_conventions()

    def _find_conventions(self) -> None:
        """Full or half, signs of shifts and vectors, from a question that nobody gets wrong otherwise."""
        tested, report = self.tested, self.report
        full, sign, toward = tested.full, 1, 1
        triple = one("a triple through a face", "few", [[0.2, 2, 2], [3.8, 2.1, 2], [0.5, 2.4, 2.2]], 4.0)
        free = one("a free triple", "few", [[0.2, 2, 2], [-0.2, 2.1, 2], [0.5, 2.4, 2.2]])
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
        report.how = Conventions(True if full is None else full, sign, toward, tested.unit or DOUBLE)
        self.superset = bool(tested.superset)
        if tested.kept:
            self._look_at_skin()
        report.superset = self.superset

    def _look_at_skin(self) -> None:
        """Whether a list that is kept gives what its skin holds, and how far it has all pairs.

        Its padding is where the nearest pair is that it lacks, or what it says.
        """
        report, tested = self.report, self.tested
        crowd = replace(one("a crowd", "few", gas(*_CROWD), _CROWD[1]), skin=_SKIN)
        if tested.limits.refusal(crowd) is not None:
            crowd = replace(one("a free crowd", "few", gas(*_CROWD)), skin=_SKIN)
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
            there = np.isin(right.i * crowd.atoms + right.j, rows)
            edge = float(right.distance[~there].min(initial=np.inf))
            below = float(right.distance[right.distance < edge].max(initial=0.0))
        if tested.superset is None:
            # what does not answer is taken for the usual
            self.superset = answer is None or below > crowd.r_cut + 0.1 * _SKIN
            report.found_out.append("with its skin" if self.superset else "without its skin")
        if outcome.skin is not None:
            report.padding, report.said = outcome.skin / _SKIN, True
        elif self.superset and crowd.r_cut < edge < np.inf:
            # the nearest pair that is lacking lies somewhat beyond the edge
            whole = below < crowd.r_cut + _SKIN <= edge
            report.padding = 1.0 if whole else (edge - crowd.r_cut) / _SKIN

    def unusable(self) -> str | None:
        """Why nothing can be learned from it: no plain question had an answer that is one; None otherwise.

        An exception that it means, a crash and a time without an answer are for the suite to tell.
        """
        told = [
            f"asked about {case.name}, {outcome.malformed or f'it raised {outcome.raised}'}"
            for case, outcome in self.opening
            if outcome.malformed or (outcome.raised and not outcome.refused)
        ]
        return told[0] if told and len(told) == len(self.opening) else None

    def failures(self, case: Case) -> list[Failure]:
        """What is wrong with the answers to a case, at the first step where anything is; empty if nothing.

        A call that raises counts as a failure; one that refuses does not.
        """
        return self.outcome(case)[0]

    def outcome(self, case: Case) -> tuple[list[Failure], Outcome | None]:
        """(failures, the outcome that ended the case: a refusal, or None)."""
        began = time.perf_counter()
        outcomes = self.session.ask(case)
        self.report.asking += time.perf_counter() - began
        for step, outcome in enumerate(outcomes):
            if outcome.aliased and self.report.aliased is None:
                self.report.aliased = case.name
            found = self._judged(case, step, outcome)
            if found:
                return [failure.at(step) for failure in found], None
            if outcome.refused:
                self._refused_at = step
                self._remember(case.until(step + 1), str(outcome.raised))
                return [], outcome
        return [], None

    def told(self, case: Case) -> tuple[list[Failure], Outcome | None, dict[str, Any]]:
        """`outcome`, and what of it an examination that goes on needs to know, for JSON."""
        report = self.report
        ties, asking = list(report.ties), report.asking
        aliased, single = report.aliased, report.single
        failures, refused = self.outcome(case)
        kept = {
            "case": case.name,
            "failures": [as_row(one) for one in failures],
            "refused": None if refused is None else [self._refused_at, str(refused.raised)],
            "ties": [now - then for now, then in zip(report.ties, ties, strict=True)],
            "aliased": report.aliased is not aliased,
            "single": report.single is not single,
            "seconds": report.asking - asking,
        }
        return failures, refused, kept

    def recalled(self, case: Case, kept: Mapping[str, Any]) -> tuple[list[Failure], Outcome | None]:
        """`outcome` as it was, without asking."""
        report = self.report
        report.asking += kept["seconds"]
        report.ties = [have + more for have, more in zip(report.ties, kept["ties"], strict=True)]
        if kept["aliased"] and report.aliased is None:
            report.aliased = case.name
        if kept["single"]:
            self._take_for_single(case.until(1))
        if kept["refused"] is not None:
            step, words = kept["refused"]
            self._remember(case.until(step + 1), words)
            return [], Outcome(raised=words, refused=True)
        return [Failure(*one) for one in kept["failures"]], None

    def _take_for_single(self, case: Case) -> None:
        """From here on it is taken for a list in float32, and told to be one."""
        self.report.how, self.report.single = replace(self.report.how, unit=SINGLE), case
        self.report.found_out.append("float32")

    def _remember(self, case: Case, words: str) -> None:
        """Keeps the smallest question that an exception was met at."""
        kind = re.sub(r"[-+\d.e]+", "#", words)
        if kind not in self.refused or (case.steps, case.atoms) < (
            self.refused[kind][1].steps,
            self.refused[kind][1].atoms,
        ):
            self.refused[kind] = words, case

    def _judged(self, case: Case, step: int, outcome: Outcome) -> list[Failure]:
        if outcome.crashed is not None:
            return [Failure("CRASHED", outcome.crashed)]
        if outcome.late is not None:
            return [Failure("NO_ANSWER", outcome.late)]
        if outcome.raised is not None:
            return [] if outcome.refused else [Failure("RAISED", outcome.raised)]
        if outcome.malformed is not None:
            return [Failure("MALFORMED", outcome.malformed)]
        assert outcome.answer is not None
        changed = (
            [Failure("CHANGED_INPUT", f"the call wrote to its {outcome.changed}")] if outcome.changed else []
        )
        # what is listed may have come as far as the skin lets it, from either side
        reach = self.report.reach(case) if self.superset else None
        how = self.report.how
        right = truth(case, step, reach=reach, unit=how.unit)
        found = judge(outcome.answer, right, how)
        if found and step and self.superset and any(failure.code == "EXTRA" for failure in found):
            # a box that grows takes listed pairs further apart than any skin: harmless, and no phantoms
            found = judge(outcome.answer, _with_earlier(case, step, right, reach or case.r_cut), how)
        # a list that is stale by a hair is not one in single precision
        new = step == 0 and not case.known and len(outcome.answer) > 0 and self._mostly_right()
        if found and new and self.tested.unit is None and how.unit == DOUBLE:
            coarse = replace(how, unit=SINGLE)
            # whoever measures in double and decides in single loses pairs that it knows to be inside
            if not measures_well(outcome.answer, right, how) and not judge(
                outcome.answer, truth(case, step, reach=reach, unit=SINGLE), coarse
            ):
                self._take_for_single(case.until(step + 1))
                found = []
        if not found and step == 0 and right.tie.any() and how.unit == DOUBLE:
            self._count_ties(outcome, right)
        return found + changed

    def _mostly_right(self) -> bool:
        """Whether what it was asked so far says anything about its arithmetic."""
        return self.report.wrong <= _MISTAKES * self.report.asked

    def _count_ties(self, outcome: Outcome, right: Truth) -> None:
        """Which pairs at exactly the cutoff are there, from cases in which no rounding can blur them."""
        if self.superset or not _whole(right):
            return
        assert outcome.answer is not None
        rows = set(zip(outcome.answer.i.tolist(), outcome.answer.j.tolist(), strict=True))
        near = np.abs(right.distance - right.r_cut) > 1e-6
        for i, j in zip(right.i[right.tie].tolist(), right.j[right.tie].tolist(), strict=True):
            if near[(right.i == i) & (right.j == j)].any():
                continue  # another image of the pair is inside
            self.report.ties[0 if (i, j) in rows or (j, i) in rows else 1] += 1


def _with_earlier(case: Case, step: int, right: Truth, reach: float) -> Truth:
    """The truth at a step, where pairs that were listed rightly earlier in the list's life may still be."""
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


def _whole(right: Truth) -> bool:
    """Whether all numbers are whole and small: then no arithmetic on them rounds."""
    numbers = np.concatenate([right.positions.ravel(), right.cell.ravel(), [right.r_cut]])
    return bool((numbers == np.rint(numbers)).all() and np.abs(numbers).max(initial=0.0) < 1e6)


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
    answers: Answers | None = None,
) -> Report:
    """Put a list through the suite.

    Args:
        cases: random ones, beside those with a name.
        seed: of the random ones.
        large: ask about 5,000 and 100,000 atoms, too.
        stop: at the first failure.
        shrink: bring failures down to a few atoms.
        apart: call it in a process of its own, so that a crash is told as one; needs a list from `load`.
        asked: instead of all questions.
        progress: called with (cases done, cases, words).
        examiner: that knows its conventions already, instead of a new one.
        deadline: after which no case is begun; what was not asked by then is counted.
        answers: of an earlier examination of the same questions, which are not asked again; each new one is
            put there.

    Returns:
        what was asked and what came of it. A list may raise, return anything and write to its input: that is
        told as a failure.
    """
    from mdnum.references.conformance.shrink import shrunk

    began = time.perf_counter()
    examiner = examiner or Examiner(tested, reuse=True, apart=apart)
    report = examiner.report
    deadline, answers = deadline or Deadline(), Answers() if answers is None else answers
    every = list(questions(tested, cases, seed, False, report.padding) if asked is None else asked)
    if asked is None and apart and tested.word:
        every += as_kept(tested, vast())
    edges = (SMALL_EDGE, LARGE_EDGE) if large and asked is None else ()
    report.questions = total = len(every) + len(edges)
    seen: set[tuple[str, str]] = set()
    going = True
    for number, case in enumerate(itertools.chain(every, map(lattice, edges))):
        if progress is not None:
            progress(number, total, {"phase": "asking", "unit": "cases"})
        if going and (answers.of(number, case) is not None or not deadline.passed):
            failures = _taken(examiner, case, number, answers)
            if failures:
                failed = Failed(case.until(failures[0].step + 1), tuple(failures), case)
                key = (failed.code, case.area)
                if key not in seen:
                    seen.add(key)
                    report.failed.append(failed)
            going = not (stop and failures)
        if number + 1 == len(every) and going and not deadline.passed:
            _order(examiner)
    if shrink:
        examiner.session.reuse = False
        if not deadline.passed:
            report.refusals = looked_into(examiner, dict(examiner.refused.values()))
        for number, failed in enumerate(report.failed):
            if progress is not None:
                progress(number, len(report.failed), {"phase": "shrinking", "unit": "failures"})
            small = answers.shrunk(failed)
            if small is None:
                if deadline.passed:
                    report.whole = False
                    continue
                # a new process: what the list kept from other questions must not be part of it
                examiner.session.close()
                small = _deepest(examiner, shrunk(examiner, failed, deadline))
                if deadline.passed:
                    report.whole = False
                else:
                    answers.put_shrunk(failed, small)
            report.failed[number] = small
        report.failed = _distinct(report.failed)
    report.areas = {area: report.areas[area] for area in AREAS if area in report.areas}
    examiner.session.close()
    report.seconds = time.perf_counter() - began
    return report


def _taken(examiner: Examiner, case: Case, number: int, answers: Answers) -> list[Failure]:
    """The failures of a case, counted; asked only where there is no answer yet."""
    report = examiner.report
    tally = report.areas.setdefault(case.area, Tally())
    kept = answers.of(number, case)
    why = examiner.tested.limits.refusal(case)
    if why is None and kept is None and case.area == "large":
        why = _too_long(report, case)
    if why is not None:
        tally.skipped += 1
        tally.why[why] = tally.why.get(why, 0) + 1
        return []
    tally.asked += 1
    if kept is None:
        failures, refused, kept = examiner.told(case)
        answers.put(number, kept)
    else:
        failures, refused = examiner.recalled(case, kept)
    if case.area == "large":
        report.large = (case.atoms, float(kept["seconds"]))
    if case.motions:
        report.motions += case.motions
        report.calls += case.steps
    if failures:
        tally.failed += 1
        code = min((failure.code for failure in failures), key=CODES.index)
        tally.codes[code] = tally.codes.get(code, 0) + 1
    elif refused is not None:
        tally.refused += 1
        words = str(refused.raised)
        tally.why[words] = tally.why.get(words, 0) + 1
    return failures


def _deepest(examiner: Examiner, failed: Failed) -> Failed:
    """A pair that is lost just inside the cutoff, followed as far in as it stays lost.

    It moves on the way it went, so that what is told is how near a lost pair can be.
    """
    case = failed.case
    if failed.code != "MISSING" or case.area != "rule" or case.steps != 2 or not failed.alone:
        return failed
    first, last = case.stills
    for part in np.arange(1.02, _FURTHEST, 0.04):
        moved = first.positions + part * (last.positions - first.positions)
        further = replace(case, stills=(first, replace(last, positions=moved)))
        found = tuple(one for one in examiner.failures(further) if one.code == "MISSING" and one.step == 1)
        if not found:
            break
        failed = replace(failed, case=further, failures=found)
    return failed


def _order(examiner: Examiner) -> None:
    """Whether the same question has the same rows in the same order, twice in a row."""
    for case in (one("order", "reuse", gas(40, 6.0, 120), 6.0), one("order", "reuse", gas(40, 3.0, 120))):
        case = replace(case, skin=0.3 if examiner.tested.kept else 0.0)
        if examiner.tested.limits.refusal(case) is None:
            answers = [examiner.session.ask(case)[0].answer for _ in range(3)]
            first = answers[0]
            if first is not None:
                examiner.report.keeps_order = all(
                    other is not None and first.same(other) for other in answers[1:]
                )
            return


def _too_long(report: Report, case: Case) -> str | None:
    """Why a large question is not asked: it would take longer than anybody waits, by the one before it."""
    if report.large is None:
        return None
    atoms, seconds = report.large
    # lists that are not linear in the number of atoms are squared in it
    expected = seconds * (case.atoms / atoms) ** (2 if seconds > 1.0 else 1)
    return f"{case.atoms:,} atoms would take more than {_PATIENCE:.0f} s" if expected > _PATIENCE else None


def _distinct(failed: list[Failed]) -> list[Failed]:
    """The smallest failure of each kind: one mistake is met in many areas, and one script of it is enough.

    Those of a code that need as many atoms, steps and axes that repeat are taken for the same mistake;
    exceptions and what is no list of pairs, where they say the same but for numbers.
    """
    from mdnum.references.conformance.shrink import kind

    kept: dict[Any, Failed] = {}
    for one_failed in sorted(failed, key=_size):
        case = one_failed.case
        key: Any = kind(one_failed.worst)
        if one_failed.code not in ("RAISED", "CRASHED", "MALFORMED"):
            key = (key, min(case.atoms, 3), min(case.steps, 2), any(case.pbc))
            if not one_failed.alone:
                # what was kept from other questions is a mistake of its own, and its case was not shrunk
                key = (one_failed.code, "not alone")
        kept.setdefault(key, one_failed)
    return sorted(kept.values(), key=lambda one: (CODES.index(one.code), list(AREAS).index(one.case.area)))


def _size(failed: Failed) -> tuple[bool, int, int, int]:
    case = failed.case
    return not failed.alone, case.atoms, case.steps, sum(case.pbc)


__all__ = ["CASES", "KEPT", "Examiner", "Failed", "Report", "Tally", "drawn", "examine", "questions"]
