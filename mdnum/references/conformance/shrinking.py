"""Reduce a failing test case to few atoms, few calls and round numbers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mdnum.deadline import Deadline, TimeUp, fewest
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.judge import Failed, Failure
from mdnum.references.conformance.reproduction import reproduces
from mdnum.references.conformance.session import RemoteSession
from mdnum.references.oracle import completed, widths

if TYPE_CHECKING:
    from mdnum.references.conformance.suite import Examiner

TRIES, SECONDS = 600, 8.0  # questions and seconds of a shrink; those below are of a slow list
LEAST_TRIES, PATIENCE = 80, 60.0
_MOST_IMAGES = 3000
_TRY = 5.0  # seconds for a question on the way to a smaller one
_FURTHEST = 2.5  # how much of the smallest motion a lost pair is followed for

Failures = Callable[[Case], Sequence[Failure]]


def shrunk(failures: Failures, failed: Failed, deadline: Deadline | None = None) -> Failed:
    """Return the smallest test case that fails with the same error code.

    `failures` runs a test case and returns its failures.
    """
    deadline = deadline or Deadline()
    sought, least = failed.worst.kind, min(1, failed.case.atoms)
    tries, began, found = 0, time.perf_counter(), failed.failures

    def fails(case: Case) -> bool:
        nonlocal tries, found
        tries += 1
        seen = failures(case) if case.steps and case.atoms >= least and _sensible(case) else ()
        if any(failure.kind == sought for failure in seen):
            # the smallest so far: whatever fails is kept
            found = tuple(failure for failure in seen if failure.code == failed.code)
            return True
        return False

    def spent() -> bool:
        seconds = time.perf_counter() - began
        return deadline.passed or tries >= TRIES or seconds > (SECONDS if tries >= LEAST_TRIES else PATIENCE)

    if failed.code == "NO_ANSWER":
        return failed  # every try would take as long
    case, before = failed.case, None
    if not fails(case):
        # what it kept from earlier questions was part of it: reported as it is
        return replace(failed, alone=deadline.passed)
    while case is not before and not spent():
        before = case
        stills = fewest(case.stills, lambda kept, case=case: fails(replace(case, stills=tuple(kept))), spent)
        case = replace(case, stills=tuple(stills)) if len(stills) < case.steps else case
        atoms = fewest(range(case.atoms), lambda kept, case=case: fails(_only(case, kept)), spent)
        case = _only(case, atoms) if len(atoms) < case.atoms else case
        for simpler in _simplifications(case):
            if spent():
                break
            other = simpler(case)
            case = other if not other.equals(case) and fails(other) else case
    return replace(failed, case=case.until(found[0].step + 1), failures=found)


def _only(case: Case, atoms: list[int]) -> Case:
    """Return the test case with only the given atoms. Exact pairs may be removed."""
    smaller = case.only(np.array(atoms, int))
    return replace(smaller, known=None) if len(atoms) <= 400 else smaller


def _sensible(case: Case) -> bool:
    """Return whether a test case has finite numbers and a usable box."""
    pbc = np.array(case.pbc)
    if not (0 < case.r_cut < np.inf and all(np.isfinite(still.positions).all() for still in case.stills)):
        return False
    for cell in (still.cell for still in case.stills):
        if not np.isfinite(cell).all() or np.linalg.matrix_rank(cell[pbc]) < pbc.sum():
            return False
        if pbc.any():
            with np.errstate(all="ignore"):
                full = completed(cell, pbc)
                if not abs(np.linalg.det(full)) > 0:
                    return False
                images = np.prod(2 * np.floor((case.r_cut + 2 * case.skin) / widths(full)[pbc]) + 3)
            if not images <= _MOST_IMAGES:
                return False
    return True


def _simplifications(case: Case) -> Iterator[Callable[[Case], Case]]:
    """Yield functions that simplify a test case, for example by removing digits."""
    for axis in range(3):
        yield lambda case, axis=axis: replace(
            case, pbc=tuple(on and n != axis for n, on in enumerate(case.pbc)), known=None
        )
    yield lambda case: case if any(case.pbc) else case.changed(cell=np.zeros_like)
    yield lambda case: case.changed(cell=lambda cell: np.diag(np.diag(cell)))
    for digits in (1, 2, 3, 5, 8):
        yield lambda case, d=digits: case.changed(
            lambda x: np.round(x, d),
            lambda x: np.round(x, d),
            r_cut=round(case.r_cut, d),
            skin=round(case.skin, d),
        )
    for digits in (0, 1, 2) if case.atoms <= 12 else ():
        yield lambda case, d=digits: case.changed(cell=lambda cell: np.round(cell, d))
        for atom, axis in np.ndindex(case.atoms, 3):

            def moved(
                positions: np.ndarray, atom: int = atom, axis: int = axis, digits: int = digits
            ) -> np.ndarray:
                positions = positions.copy()
                # a still may have fewer atoms
                positions[atom : atom + 1, axis] = np.round(positions[atom : atom + 1, axis], digits)
                return positions

            yield lambda case, moved=moved: case.changed(moved)


def deepest(failures: Failures, failed: Failed) -> Failed:
    """Move the atoms of a missing pair closer together while the list omits the pair.

    All atoms move along their displacement between the first two calls of the list. The failure then shows
    the smallest distance of a pair that the list omits.
    """
    case = failed.case
    if failed.code != "MISSING" or case.area != "rule" or case.steps != 2 or not failed.alone:
        return failed
    first, last = case.stills
    for part in np.arange(1.02, _FURTHEST, 0.04):
        moved = first.positions + part * (last.positions - first.positions)
        further = replace(case, stills=(first, replace(last, positions=moved)))
        found = tuple(one for one in failures(further) if one.code == "MISSING" and one.step == 1)
        if not found:
            break
        failed = replace(failed, case=further, failures=found)
    return failed


def reduced(examiner: Examiner, failed: Failed, before: tuple[Case, ...], deadline: Deadline) -> Failed:
    """Reduce a failure, and run the script that reproduces the failure."""

    def failures(case: Case) -> Sequence[Failure]:
        with suppress(TimeUp):
            return examiner.failures(case)
        return ()

    session, report = examiner.session, examiner.report
    # a new process: what the list kept from other questions must not be part of it
    session.close()
    if not isinstance(session, RemoteSession):
        return deepest(failures, shrunk(failures, failed, deadline))
    if (shown := reproduces(report, failed, deadline)) is False:
        needing = _needing(examiner, failed, before, deadline)
        failed = needing or replace(failed, alone=False)
        return replace(failed, reproduced=needing is not None and reproduces(report, needing, deadline))
    failed = replace(failed, reproduced=shown)
    session.most = _TRY if failed.code != "NO_ANSWER" else np.inf
    smaller = deepest(failures, shrunk(failures, failed, deadline))
    session.most = np.inf
    # where its state made a smaller one fail, the one that was met is shown
    again = reproduces(report, smaller, deadline) if smaller.alone and smaller is not failed else None
    return replace(smaller, reproduced=again) if again or not shown else failed


def _needing(
    examiner: Examiner, failed: Failed, before: tuple[Case, ...], deadline: Deadline
) -> Failed | None:
    """Find earlier test cases without which a failure does not occur, or None."""
    session, began = examiner.session, time.perf_counter()

    def fails(cases: Sequence[Case]) -> bool:
        session.close()
        session.reuse = True
        with suppress(TimeUp):
            for case in cases:
                session.ask(case)
            return any(failure.kind == failed.worst.kind for failure in examiner.failures(failed.case))
        return False

    needed = None
    if before and fails(before):
        spent = lambda: deadline.passed or time.perf_counter() - began > PATIENCE  # noqa: E731
        needed = replace(failed, alone=False, earlier=tuple(fewest(before, fails, spent)))
    session.reuse = False
    session.close()
    return needed
