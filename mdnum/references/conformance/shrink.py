"""A failing case brought down to a few atoms, few steps and round numbers that fail in the same way."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mdnum.deadline import Deadline
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.judge import Failure
from mdnum.references.conformance.lists import completed
from mdnum.references.oracle import widths

if TYPE_CHECKING:
    from mdnum.references.conformance.suite import Examiner, Failed

#: Questions and seconds that a shrink may take; a slow list has this many questions, and at most so long.
TRIES, SECONDS = 600, 8.0
LEAST_TRIES, PATIENCE = 80, 60.0
_MOST_IMAGES = 3000


def shrunk(examiner: Examiner, failed: Failed, deadline: Deadline | None = None) -> Failed:
    """The smallest case found that fails with the same code.

    Args:
        examiner: asks the list; a new object of a kept list for each try.
        failed: the case as it was met.
        deadline: after which it is left as small as it is.
    """
    deadline = deadline or Deadline()
    wanted, sought = failed.code, kind(failed.worst)
    least = min(1, failed.case.atoms)
    tries, began = 0, time.perf_counter()

    def still_fails(case: Case) -> bool:
        nonlocal tries
        tries += 1
        if case.atoms < least or not _sensible(case) or examiner.tested.limits.refusal(case) is not None:
            return False
        how, single = examiner.report.how, examiner.report.single
        failures = examiner.failures(case)
        if examiner.report.how is not how:  # it passed for float32: the conventions stay as they were
            examiner.report.how, examiner.report.single = how, single
            return False
        return any(kind(failure) == sought for failure in failures)

    def spent() -> bool:
        seconds = time.perf_counter() - began
        return deadline.passed or tries >= TRIES or seconds > (SECONDS if tries >= LEAST_TRIES else PATIENCE)

    case = failed.case
    if wanted == "NO_ANSWER":
        return failed  # every try would take as long
    if not still_fails(case):
        # what it kept from earlier questions was part of it: told as it is
        return replace(failed, alone=False)
    changed = True
    while changed and not spent():
        changed = False
        for step in (_fewer_stills, _fewer_atoms, _simpler_box, _rounder):
            smaller = step(case, still_fails, spent)
            if smaller is not case:
                case, changed = smaller, True
    failures = examiner.failures(case)
    found = tuple(failure for failure in failures if failure.code == wanted) or failed.failures
    return replace(failed, case=case.until(found[0].step + 1), failures=found)


def kind(failure: Failure) -> tuple[str, str]:
    """What a smaller case has to show: the code; of an exception or a crash also which, without numbers."""
    said = failure.text if failure.code in ("RAISED", "CRASHED", "MALFORMED") else ""
    return failure.code, re.sub(r"[-+\d.e]+", "#", said)


def _sensible(case: Case) -> bool:
    """Whether it is a question: finite numbers, a box with room in it, not too many images to count."""
    if not (case.r_cut > 0 and np.isfinite(case.r_cut)):
        return False
    pbc = np.array(case.pbc)
    for still in case.stills:
        if not (np.isfinite(still.positions).all() and np.isfinite(still.cell).all()):
            return False
        if pbc.any():
            with np.errstate(all="ignore"):
                used = still.cell[pbc]
                if np.linalg.matrix_rank(used) < len(used):
                    return False
                matrix = completed(still.cell, pbc)
                if not abs(np.linalg.det(matrix)) > 0:
                    return False
                images = np.prod(2 * np.floor((case.r_cut + 2 * case.skin) / widths(matrix)[pbc]) + 3)
            if not images <= _MOST_IMAGES:
                return False
    return True


def _fewer_stills(case: Case, fails: Callable[[Case], bool], spent: Callable[[], bool]) -> Case:
    """Steps that it fails without are left out: halves first, then one by one."""
    size = case.steps // 2
    while size >= 1 and not spent():
        at = 0
        while at < case.steps and case.steps > 1 and not spent():
            rest = replace(case, stills=case.stills[:at] + case.stills[at + size :])
            if rest.steps and fails(rest):
                case = rest
            else:
                at += size
        size //= 2
    return case


def _fewer_atoms(case: Case, fails: Callable[[Case], bool], spent: Callable[[], bool]) -> Case:
    """Atoms that it fails without are left out.

    Source: Zeller and Hildebrandt, Simplifying and Isolating Failure-Inducing Input, IEEE TSE 28, 183 (2002).
    """
    size = max(1, case.atoms // 2)
    while not spent():
        at = 0
        while at < case.atoms and not spent():
            kept = np.concatenate([np.arange(at), np.arange(at + size, case.atoms)])
            smaller = _known_again(case.only(kept))
            if len(kept) < case.atoms and fails(smaller):
                case = smaller
            else:
                at += size
        if size == 1:
            break
        size = max(1, min(size // 2, case.atoms // 2))
    return case


def _known_again(case: Case) -> Case:
    """Few atoms need no pairs in closed form."""
    return replace(case, known=None) if case.known is not None and case.atoms <= 400 else case


def _simpler_box(case: Case, fails: Callable[[Case], bool], spent: Callable[[], bool]) -> Case:
    """Axes that need not repeat, cells that need not lean."""
    for axis in range(3):
        if case.pbc[axis] and not spent():
            pbc = tuple(on and n != axis for n, on in enumerate(case.pbc))
            case = _taken(case, replace(case, pbc=pbc, known=None), fails)  # type: ignore[arg-type]
    if not any(case.pbc) and any(np.any(still.cell) for still in case.stills):
        case = _taken(case, _with(case, cell=lambda cell: np.zeros((3, 3))), fails)
    leaning = any(np.count_nonzero(still.cell - np.diag(np.diag(still.cell))) for still in case.stills)
    if leaning and not spent():
        case = _taken(case, _with(case, cell=lambda cell: np.diag(np.diag(cell))), fails)
    return case


def _rounder(case: Case, fails: Callable[[Case], bool], spent: Callable[[], bool]) -> Case:
    """Numbers with fewer digits, the first atom near the origin, coordinates that may be 0."""
    for digits in (1, 2, 3, 5, 8):
        if spent():
            return case
        rounded = _with(case, lambda x, d=digits: np.round(x, d), lambda c, d=digits: np.round(c, d))
        rounded = replace(rounded, r_cut=round(case.r_cut, digits), skin=round(case.skin, digits))
        if _same(rounded, case):
            break
        if fails(rounded):
            case = rounded
            break
    for smaller in _one_by_one(case):
        if spent():
            break
        if not _same(smaller(case), case) and fails(smaller(case)):
            case = smaller(case)
    return case


def _one_by_one(case: Case) -> Iterator[Callable[[Case], Case]]:
    """Changes of single coordinates: to 0, or to fewer digits."""
    if case.atoms > 12:
        return
    for digits in (0, 1, 2):
        yield lambda c, d=digits: _with(c, cell=lambda cell: np.round(cell, d))
        for atom in range(case.atoms):
            for axis in range(3):
                yield lambda c, a=atom, x=axis, d=digits: _moved(c, a, x, d)


def _moved(case: Case, atom: int, axis: int, digits: int) -> Case:
    """One coordinate of one atom rounded at every step."""

    def change(positions: np.ndarray) -> np.ndarray:
        if atom < len(positions):
            positions = positions.copy()
            positions[atom, axis] = np.round(positions[atom, axis], digits)
        return positions

    return _with(case, change)


def _with(case: Case, positions=None, cell=None) -> Case:
    """A case with its coordinates or cells changed at every step."""
    stills = tuple(
        replace(
            still,
            positions=still.positions if positions is None else positions(still.positions),
            cell=still.cell if cell is None else cell(still.cell),
        )
        for still in case.stills
    )
    return replace(case, stills=stills, known=None)


def _taken(case: Case, other: Case, fails: Callable[[Case], bool]) -> Case:
    return other if fails(other) else case


def _same(a: Case, b: Case) -> bool:
    return (a.r_cut, a.skin) == (b.r_cut, b.skin) and all(
        np.array_equal(x.positions, y.positions) and np.array_equal(x.cell, y.cell)
        for x, y in zip(a.stills, b.stills, strict=True)
    )
