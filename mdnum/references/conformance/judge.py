"""An answer against the truth: what is missing, too much, duplicated, misplaced or mismeasured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Literal, get_args

import numpy as np
from annotated_types import Ge
from numpy import ndarray

from mdnum.references.conformance.answer import Answer
from mdnum.references.conformance.case import Case
from mdnum.references.oracle import all_pairs, completed, exactly_inside, rounding_bound

SINGLE, DOUBLE = 2.0**-24, 2.0**-53
_NAMED = 3  # pairs in a message
#: Ways to be wrong, by how bad they are: the first make energies wrong without a word.
Code = Literal[
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
]
CODES: tuple[Code, ...] = get_args(Code)
#: Those of cases in which nothing came back.
SILENT = ("CRASHED", "NO_ANSWER", "RAISED")


@dataclass(frozen=True)
class Truth:
    """Pairs in and around the cutoff at one still.

    Attributes:
        positions, cell: as the list was given them; rows of axes that do not repeat are zero.
        i, j, shift, distance: as in `PairSet`, out to the reach that was asked for.
        tie: the pairs at exactly r_cut.
        r_cut: length.
        scale: `rounding_bound` for a unit roundoff of 1, times what fractional coordinates of a skewed cell
            lose: how far a distance can be off, by the roundoff of the arithmetic.
        reach: pairs as far as this may be listed, length; the cutoff unless a list holds a skin.
        inside: by real arithmetic, r < r_cut.
    """

    positions: ndarray
    cell: ndarray
    i: ndarray
    j: ndarray
    shift: ndarray
    distance: ndarray
    tie: ndarray
    r_cut: float
    scale: float
    reach: float
    inside: ndarray

    def needed(self, unit: float) -> ndarray:
        """The pairs that a list of this roundoff cannot be excused for lacking."""
        return self.distance < self.r_cut - unit * self.scale

    def allowed(self, unit: float) -> ndarray:
        """The pairs that it may have."""
        return self.distance <= self.reach + unit * self.scale


def truth(case: Case, step: int, *, reach: float | None = None, unit: float = DOUBLE) -> Truth:
    """The pairs of one still of a case.

    Args:
        reach: how far pairs may be listed, length; the cutoff by default.
        unit: the coarsest roundoff that will be asked about.
    Error: decisions within rounding of the cutoff are those of rational arithmetic; see `all_pairs`.
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
        positions, cell, pairs.i, pairs.j, pairs.shift, pairs.distance, tie, r_cut, scale, reach, pairs.inside
    )


def conditioning(cell: ndarray, pbc: ndarray) -> float:
    """What going through fractional coordinates and back can multiply a rounding error by; at least 1.

    Source: Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 7.1: the condition number
    of the periodic lattice vectors, each scaled to length 1 because lengths alone cost nothing.
    """
    if not pbc.any():
        return 1.0
    rows = cell[pbc] / np.linalg.norm(cell[pbc], axis=1)[:, None]
    return max(1.0, float(np.linalg.cond(rows)))


def keys(count: int, i: ndarray, j: ndarray, shift: ndarray | None, *others: tuple) -> list[ndarray]:
    """One whole number for each row, equal where rows are: of these rows and of others, (i, j, shift) each.

    Args:
        count: atoms.
        shift: None to tell rows by their atoms alone.
    """
    sets = [(i, j, shift), *others]
    lengths = np.cumsum([0, *(len(rows[0]) for rows in sets)])
    key = np.concatenate([np.asarray(rows[0], np.int64) * count + rows[1] for rows in sets])
    if shift is not None:
        for axis in range(3):
            column = np.concatenate([np.asarray(rows[2])[:, axis] for rows in sets])
            # by rank: shifts of atoms far outside the box are large, but few of them differ
            _, rank = np.unique(column, return_inverse=True)
            _, key = np.unique(key, return_inverse=True)
            key = key * (int(rank.max(initial=0)) + 1) + rank
    return [key[first:last] for first, last in pairwise(lengths)]


@dataclass(frozen=True)
class Conventions:
    """What kind of list it is, which is nobody's mistake.

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
        code: one of `CODES`.
        text: what was seen, with atoms and numbers.
        count: how many rows.
        step: at which still.
    """

    code: Code
    text: str
    count: Annotated[int, Ge(0)] = 1
    step: Annotated[int, Ge(0)] = 0


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
    found = _compare(answer, truth, how)
    # nothing that shifts would mend: a pair listed once, an atom that is its own neighbor where it stands
    plain = {failure.code for failure in found} <= {"ONE_SIDED", "SELF"}
    shifted = found and not plain and answer.shift is not None
    if shifted and not _compare(replace(answer, shift=None), truth, how):
        hint = _shift_hint(answer, truth, how)
        return [Failure("SHIFTS", f"the atoms are right and the shifts are not: {found[0].text}{hint}")]
    return found or _measures(answer, truth, how)


def _compare(answer: Answer, truth: Truth, how: Conventions) -> list[Failure]:
    """What is wrong with the rows of an answer, matched with those of the truth."""
    i, j, shifts = answer.i, answer.j, answer.shift is not None
    shift = how.sign * answer.shift if answer.shift is not None else np.zeros((len(i), 3), np.int64)
    right = _both(truth) if how.full else (truth.i, truth.j, truth.shift)
    if not how.full:
        i, j, shift = _one_way(i, j, shift)
    key, right_key, turned, own = keys(
        len(truth.positions),
        i,
        j,
        shift if shifts else None,
        right,
        (j, i, -shift),
        (i, i, np.zeros_like(shift)),
    )
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
        text = missing(gone, f"missing inside r_cut = {truth.r_cut:.9g}")
        found.append(Failure("MISSING", text, int(gone.sum())))
    if one_sided.any():
        found.append(Failure("ONE_SIDED", missing(one_sided * 1, "from one of its atoms only")))
    excess = surplus[mine] > 0
    selfs = excess & (key == own) & (shifts or allowed[mine] == 0)
    repeated = excess & ~selfs & (allowed[mine] > 0)
    kinds: tuple[tuple[Code, ndarray], ...] = (
        ("EXTRA", excess & ~selfs & ~repeated),
        ("DUPLICATE", repeated),
        ("SELF", selfs),
    )
    for code, rows in kinds:
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
        found.append(Failure(code, text, count))
    if not found and how.full and not np.array_equal(have, mirrored):
        row = int(np.argmax((have != mirrored)[mine]))
        text = (
            f"within rounding of the cutoff, {i[row]} has {j[row]} as a neighbor, and not the other way round"
        )
        found.append(Failure("ONE_SIDED", text, int((have != mirrored).sum())))
    return found


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
            home = np.where(
                axes, np.floor(np.linalg.solve(completed(truth.cell, axes).T, truth.positions.T).T), 0
            )
            shift = shift + how.sign * (home[answer.i] - home[answer.j]).astype(np.int64)
        if not _compare(replace(answer, shift=shift), truth, other):
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
    measured: tuple[tuple[Code, ndarray | None, str], ...] = (
        ("DISTANCES", off, "distance"),
        ("VECTORS", bent, "vector"),
    )
    for code, error, what in measured:
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
