"""A failing case brought down to a few atoms, few steps and round numbers that fail in the same way."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from mdnum.deadline import Deadline, fewest
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.judge import Failure
from mdnum.references.conformance.lists import PairList
from mdnum.references.conformance.results import Failed
from mdnum.references.oracle import completed, widths

#: Questions and seconds that a shrink may take; a slow list has this many questions, and at most so long.
TRIES, SECONDS = 600, 8.0
LEAST_TRIES, PATIENCE = 80, 60.0
_MOST_IMAGES = 3000

Fails = Callable[[Case], bool]


class Asks(Protocol):
    """What asks a list; a new object of a kept list for each question."""

    tested: PairList

    def failures(self, case: Case) -> tuple[Failure, ...]:
        """What is wrong with the answers to a case."""
        ...


def shrunk(examiner: Asks, failed: Failed, deadline: Deadline | None = None) -> Failed:
    """The smallest case found that fails with the same code.

    Args:
        examiner: asks the list.
        failed: the case as it was met.
        deadline: after which it is left as small as it is.
    """
    deadline = deadline or Deadline()
    sought, least = kind(failed.worst), min(1, failed.case.atoms)
    tries, began = 0, time.perf_counter()

    def fails(case: Case) -> bool:
        nonlocal tries
        tries += 1
        if not case.steps or case.atoms < least or not _sensible(case):
            return False
        refused = examiner.tested.limits.refusal(case) is not None
        return not refused and any(kind(failure) == sought for failure in examiner.failures(case))

    def spent() -> bool:
        seconds = time.perf_counter() - began
        return deadline.passed or tries >= TRIES or seconds > (SECONDS if tries >= LEAST_TRIES else PATIENCE)

    if failed.code == "NO_ANSWER":
        return failed  # every try would take as long
    case = failed.case
    if not fails(case):
        # what it kept from earlier questions was part of it: reported as it is
        return replace(failed, alone=False)
    changed = True
    while changed and not spent():
        before = case
        stills = fewest(
            case.stills, lambda stills, case=case: fails(replace(case, stills=tuple(stills))), spent
        )
        case = replace(case, stills=tuple(stills)) if len(stills) < case.steps else case
        atoms = fewest(range(case.atoms), lambda kept, case=case: fails(_only(case, kept)), spent)
        case = _only(case, atoms) if len(atoms) < case.atoms else case
        case = _rounder(_simpler_box(case, fails, spent), fails, spent)
        changed = case is not before
    found = tuple(failure for failure in examiner.failures(case) if failure.code == failed.code)
    found = found or failed.failures
    return replace(failed, case=case.until(found[0].step + 1), failures=found)


def kind(failure: Failure) -> tuple[str, str]:
    """What a smaller case has to show: the code; of an exception or a crash also which, without numbers."""
    text = failure.text if failure.code in ("RAISED", "CRASHED", "MALFORMED") else ""
    return failure.code, re.sub(r"[-+\d.e]+", "#", text)


def _only(case: Case, atoms: list[int]) -> Case:
    """Some of the atoms; few need no pairs in closed form."""
    smaller = case.only(np.array(atoms, int))
    return replace(smaller, known=None) if len(atoms) <= 400 else smaller


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
                full = completed(still.cell, pbc)
                if not abs(np.linalg.det(full)) > 0:
                    return False
                images = np.prod(2 * np.floor((case.r_cut + 2 * case.skin) / widths(full)[pbc]) + 3)
            if not images <= _MOST_IMAGES:
                return False
    return True


def _simpler_box(case: Case, fails: Fails, spent: Callable[[], bool]) -> Case:
    """Axes that need not repeat, cells that need not lean."""
    for axis in range(3):
        if case.pbc[axis] and not spent():
            x, y, z = (on and n != axis for n, on in enumerate(case.pbc))
            smaller = replace(case, pbc=(x, y, z), known=None)
            case = smaller if fails(smaller) else case
    if not any(case.pbc) and any(np.any(still.cell) for still in case.stills):
        smaller = case.changed(cell=np.zeros_like)
        case = smaller if fails(smaller) else case
    leaning = any(np.count_nonzero(still.cell - np.diag(np.diag(still.cell))) for still in case.stills)
    if leaning and not spent():
        smaller = case.changed(cell=lambda cell: np.diag(np.diag(cell)))
        case = smaller if fails(smaller) else case
    return case


def _rounder(case: Case, fails: Fails, spent: Callable[[], bool]) -> Case:
    """Numbers with fewer digits, coordinates that may be 0."""
    for digits in (1, 2, 3, 5, 8):
        rounded = _rounded(case, digits)
        if spent() or rounded.equals(case):
            break
        if fails(rounded):
            case = rounded
            break
    for simpler in _one_by_one(case):
        if spent():
            break
        other = simpler(case)
        if not other.equals(case) and fails(other):
            case = other
    return case


def _rounded(case: Case, digits: int) -> Case:
    def fewer(values: np.ndarray) -> np.ndarray:
        return np.round(values, digits)

    return case.changed(fewer, fewer, r_cut=round(case.r_cut, digits), skin=round(case.skin, digits))


def _one_by_one(case: Case) -> Iterator[Callable[[Case], Case]]:
    """Changes of the cell, and of single coordinates, to fewer digits at every step."""
    if case.atoms > 12:
        return

    def moved(positions: np.ndarray, atom: int, axis: int, digits: int) -> np.ndarray:
        if atom < len(positions):
            positions = positions.copy()
            positions[atom, axis] = np.round(positions[atom, axis], digits)
        return positions

    for digits in (0, 1, 2):
        yield lambda case, d=digits: case.changed(cell=lambda cell: np.round(cell, d))
        for atom, axis in np.ndindex(case.atoms, 3):
            yield lambda case, a=atom, x=axis, d=digits: case.changed(lambda rows: moved(rows, a, x, d))
