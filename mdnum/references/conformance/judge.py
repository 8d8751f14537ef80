"""An answer against the truth: what is missing, too much, doubled, misplaced or mismeasured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.answer import Answer
from mdnum.references.conformance.truth import DOUBLE, Truth, keys

_TOLD = 3  # pairs that are named


@dataclass(frozen=True)
class Conventions:
    """How a list speaks, which is nobody's mistake.

    Attributes:
        full: every pair from both of its atoms (True), or once (False).
        sign: +1 where shifts are added to atom j, -1 where they are added to atom i.
        toward: +1 where vectors point from i to j, -1 where they point from j to i.
        unit: roundoff of its arithmetic: 2**-53 or 2**-24.
    """

    full: bool = True
    sign: int = 1
    toward: int = 1
    unit: float = DOUBLE


@dataclass(frozen=True)
class Failure:
    """One way in which an answer is wrong.

    Attributes:
        code: MISSING, EXTRA, DUPLICATE, SELF, ONE_SIDED, SHIFTS, DISTANCES, VECTORS, RANGE, MALFORMED,
            RAISED, NO_ANSWER, CHANGED_INPUT or CRASHED.
        text: what was seen, with atoms and numbers.
        count: how many rows.
        step: at which still.
    """

    code: str
    text: str
    count: int = 1
    step: int = 0

    def at(self, step: int) -> Failure:
        """The same at another still."""
        return replace(self, step=step)


#: Codes by how bad they are: the first is what makes energies wrong without a word.
CODES = (
    "CRASHED",
    "MISSING",
    "EXTRA",
    "DUPLICATE",
    "SELF",
    "RANGE",
    "ONE_SIDED",
    "SHIFTS",
    "DISTANCES",
    "VECTORS",
    "MALFORMED",
    "NO_ANSWER",
    "CHANGED_INPUT",
    "RAISED",
)

#: Those of cases in which nothing came back.
SILENT = ("CRASHED", "NO_ANSWER", "RAISED")


def judge(answer: Answer, truth: Truth, how: Conventions) -> list[Failure]:
    """Everything that is wrong with an answer; nothing where it conforms.

    A pair within rounding of the cutoff (`Truth.scale` times the roundoff of the list) may be there or not,
    but from both of its atoms alike.

    Args:
        truth: listed as far as the answer may reach.
        how: conventions of the list.
    """
    n = len(truth.positions)
    outside = (answer.i < 0) | (answer.i >= n) | (answer.j < 0) | (answer.j >= n)
    if outside.any():
        row = int(np.argmax(outside))
        text = (
            f"{int(outside.sum())} of {len(answer)} rows name atoms outside 0 ... {n - 1}: row {row} is "
            f"({answer.i[row]}, {answer.j[row]})"
        )
        return [Failure("RANGE", text, int(outside.sum()))]
    rows = _Rows(answer, truth, how)
    found = rows.failures()
    # nothing that shifts would mend: a pair told once, an atom that is its own neighbor where it stands
    plain = {failure.code for failure in found} <= {"ONE_SIDED", "SELF"}
    if found and not plain and answer.shift is not None and not rows.only_atoms().failures():
        hint = _shift_hint(answer, truth, how)
        return [Failure("SHIFTS", f"the atoms are right and the shifts are not: {found[0].text}{hint}")]
    if not found:
        found = _measures(answer, truth, how)
    return found


class _Rows:
    """The rows of an answer and of the truth, matched."""

    def __init__(self, answer: Answer, truth: Truth, how: Conventions, shifts: bool = True):
        self.answer, self.truth, self.how = answer, truth, how
        i, j, shift = answer.i, answer.j, answer.shift
        self.shifts = shifts and shift is not None
        if shift is None or not shifts:
            shift = np.zeros((len(i), 3), np.int64)
        shift = how.sign * shift
        if how.full:
            right = _both(truth)
        else:
            i, j, shift = _one_way(i, j, shift)
            right = (truth.i, truth.j, truth.shift)
        self.rows, self.right = (i, j, shift), right
        mine, theirs, turned, own = keys(
            len(truth.positions),
            i,
            j,
            shift if self.shifts else None,
            right,
            (j, i, -shift),
            (i, i, np.zeros_like(shift)),
        )
        self.key, self.right_key, self.turned, self.own = mine, theirs, turned, own
        twice = 2 if how.full else 1
        self.needed = np.tile(truth.needed(how.unit), twice)
        self.allowed = np.tile(truth.allowed(how.unit), twice)

    def only_atoms(self) -> _Rows:
        """The same without looking at shifts."""
        return _Rows(self.answer, self.truth, self.how, shifts=False)

    def failures(self) -> list[Failure]:
        labels, number = np.unique(
            np.concatenate([self.key, self.right_key, self.turned]), return_inverse=True
        )
        a, b = len(self.key), len(self.key) + len(self.right_key)
        mine, theirs, turned = number[:a], number[a:b], number[b:]
        size = len(labels)
        have = np.bincount(mine, minlength=size)
        mirrored = np.bincount(turned, minlength=size)
        needed = np.bincount(theirs[self.needed], minlength=size)
        allowed = np.bincount(theirs[self.allowed], minlength=size)
        lacking = np.clip(needed - have, 0, None)
        surplus = np.clip(have - allowed, 0, None)
        found = []
        if lacking.any():
            # a pair that is there from its other side is a mistake of another kind
            one_sided = (lacking > 0) & (mirrored > have) & self.how.full
            gone = lacking * ~one_sided
            if gone.any():
                found.append(Failure("MISSING", self._missing(gone, theirs), int(gone.sum())))
            if one_sided.any():
                found.append(Failure("ONE_SIDED", self._missing(one_sided * 1, theirs, True)))
        if surplus.any():
            found += self._surplus(surplus, allowed, mine)
        if not found and self.how.full and not np.array_equal(have, mirrored):
            row = int(np.argmax((have != mirrored)[mine]))
            i, j, _ = self._named(self.rows, row)
            text = f"within rounding of the cutoff, {i} has {j} as a neighbor but {j} does not have {i}"
            found.append(Failure("ONE_SIDED", text, int((have != mirrored).sum())))
        return found

    def _missing(self, gone: ndarray, theirs: ndarray, one_sided: bool = False) -> str:
        rows = np.flatnonzero(self.needed & (gone[theirs] > 0))
        half = len(self.truth.i)
        total = int(gone.sum())
        told = []
        for row in rows[:_TOLD]:
            i, j, shift = self._named(self.right, row)
            told.append(f"{i}-{j}{_through(shift)} at {self.truth.distance[row % half]:.9g}")
        of = f"{total} of {int(self.needed.sum())} rows"
        what = "from one of its atoms only" if one_sided else f"missing inside r_cut = {self.truth.r_cut:.9g}"
        return f"{of} {what}: {', '.join(told)}{', ...' if len(rows) > _TOLD else ''}"

    def _surplus(self, surplus: ndarray, allowed: ndarray, mine: ndarray) -> list[Failure]:
        found = []
        rows_of = surplus[mine] > 0
        itself = rows_of & (self.key == self.own)
        if self.shifts:
            selfs = itself
        else:
            selfs = itself & (allowed[mine] == 0)
        repeated = rows_of & ~selfs & (allowed[mine] > 0)
        phantom = rows_of & ~selfs & ~repeated
        for code, rows in (("EXTRA", phantom), ("DUPLICATE", repeated), ("SELF", selfs)):
            if not rows.any():
                continue
            first = int(np.argmax(rows))
            i, j, shift = self._named(self.rows, first)
            count = int(surplus[np.unique(mine[rows])].sum())
            if code == "EXTRA":
                text = f"{count} rows beyond the cutoff, first {i}-{j}{self._where(i, j, shift)}"
            elif code == "DUPLICATE":
                have = int((mine == mine[first]).sum())
                text = (
                    f"{i}-{j}{_through(shift) if self.shifts else ''} is listed {have} times instead of "
                    f"{int(allowed[mine[first]])}; {count} rows too many in all"
                )
            else:
                told = (
                    "1 atom is its own neighbor" if count == 1 else f"{count} atoms are their own neighbors"
                )
                text = f"{told}, first {i}" if count > 1 else f"{told}: {i}"
            found.append(Failure(code, text, count))
        return found

    def _where(self, i: int, j: int, shift: ndarray) -> str:
        """How far apart two atoms are, as the list tells it, or in the images nearest to each other."""
        positions, cell = self.truth.positions, self.truth.cell
        if self.shifts:
            apart = float(np.linalg.norm(positions[j] - positions[i] + shift @ cell))
            return f"{_through(shift)} at {apart:.9g}, r_cut = {self.truth.r_cut:.9g}"
        return f", which are not inside r_cut = {self.truth.r_cut:.9g}"

    @staticmethod
    def _named(rows: tuple[ndarray, ndarray, ndarray], row: int) -> tuple[int, int, ndarray]:
        i, j, shift = rows
        return int(i[row]), int(j[row]), np.asarray(shift)[row]


def _through(shift: ndarray) -> str:
    """The image, where it is not the atom itself."""
    return f" + ({', '.join(str(int(part)) for part in shift)})" if np.any(shift) else ""


def _both(truth: Truth) -> tuple[ndarray, ndarray, ndarray]:
    """Every pair of the truth from both of its atoms."""
    return (
        np.concatenate([truth.i, truth.j]),
        np.concatenate([truth.j, truth.i]),
        np.concatenate([truth.shift, -truth.shift]),
    )


def _one_way(i: ndarray, j: ndarray, shift: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Every row the way the truth names it: i < j, or the leading one of two opposite shifts."""
    a, b, c = shift.T if len(shift) else np.zeros((3, 0), np.int64)
    leading = (a > 0) | ((a == 0) & ((b > 0) | ((b == 0) & (c > 0))))
    turn = (i > j) | ((i == j) & ~leading)
    return np.where(turn, j, i), np.where(turn, i, j), np.where(turn[:, None], -shift, shift)


def _shift_hint(answer: Answer, truth: Truth, how: Conventions) -> str:
    """What the shifts may have been meant for."""
    assert answer.shift is not None
    for text, other in (
        ("; added to the other atom they are right", replace(how, sign=-how.sign)),
        ("; they are right for positions wrapped into the box", how),
    ):
        shift = answer.shift
        if other is how:
            axes = np.any(truth.cell != 0, axis=1)
            completed = truth.cell.copy()
            if not axes.all():
                free = np.flatnonzero(~axes)
                basis = np.linalg.svd(np.vstack([truth.cell[axes], np.zeros((1, 3))]))[2]
                completed[free] = basis[3 - len(free) :]
            home = np.where(axes, np.floor(np.linalg.solve(completed.T, truth.positions.T).T), 0)
            shift = shift + how.sign * (home[answer.i] - home[answer.j]).astype(np.int64)
        if not _Rows(replace(answer, shift=shift), truth, other).failures():
            return text
    return ""


def _measures(answer: Answer, truth: Truth, how: Conventions) -> list[Failure]:
    """Distances and vectors of rows that are all right."""
    if answer.distance is None and answer.vector is None:
        return []
    n, bound = len(truth.positions), how.unit * truth.scale
    found = []
    if answer.shift is not None:
        shift = how.sign * answer.shift
        right = truth.positions[answer.j] - truth.positions[answer.i] + shift @ truth.cell
        length = np.linalg.norm(right, axis=1)
        off = None if answer.distance is None else np.abs(answer.distance - length)
        bent = None if answer.vector is None else np.abs(how.toward * answer.vector - right).max(axis=1)
    else:
        # without shifts a row is any of the images of its two atoms: the one whose length is nearest
        pairs = _both(truth)
        mine, theirs = keys(n, answer.i, answer.j, None, pairs)
        told = answer.distance
        if told is None:
            assert answer.vector is not None
            told = np.linalg.norm(answer.vector, axis=1)
        off = _nearest(mine, told, theirs, np.tile(truth.distance, 2))
        bent = None
    # a bound for a length near the cutoff; a code may form it from squares of its coordinates' differences
    bound = 2 * bound
    for code, error, what in (("DISTANCES", off, "distance"), ("VECTORS", bent, "vector")):
        if error is None or not (wrong := ~(error <= bound)).any():
            continue
        row = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
        text = (
            f"{int(wrong.sum())} of {len(answer)} rows have a {what} that is off by more than {bound:.2g}, "
            f"most {answer.i[row]}-{answer.j[row]} by {error[row]:.3g}"
        )
        found.append(Failure(code, text, int(wrong.sum())))
    return found


def measures_well(answer: Answer, truth: Truth, how: Conventions) -> bool:
    """Whether an answer has distances or vectors, and they are as good as the conventions say."""
    given = answer.distance is not None or answer.vector is not None
    n = len(truth.positions)
    named = bool(((answer.i >= 0) & (answer.i < n) & (answer.j >= 0) & (answer.j < n)).all())
    return given and len(answer) > 0 and named and not _measures(answer, truth, how)


def _nearest(mine: ndarray, told: ndarray, theirs: ndarray, length: ndarray) -> ndarray:
    """Distance of every number from the nearest of those with the same key."""
    order = np.lexsort((length, theirs))
    theirs, length = theirs[order], length[order]
    first, last = np.searchsorted(theirs, mine, "left"), np.searchsorted(theirs, mine, "right")
    best = np.full(len(mine), np.inf)
    for back in range(int((last - first).max(initial=0))):
        here = first + back
        ok = here < last
        best[ok] = np.minimum(best[ok], np.abs(told[ok] - length[here[ok]]))
    return np.where(np.isnan(told), np.nan, best)
