"""The judge against answers whose faults are known, and its truth against Fractions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from mdnum.references.conformance.answer import ListAnswer, Malformed, read
from mdnum.references.conformance.case import gas, once
from mdnum.references.conformance.judge import DOUBLE, SINGLE, Conventions, conditioning, judge, truth
from mdnum.references.conformance.questions import lattice
from mdnum.references.oracle import all_pairs, rounding_bound

_CASE = once("a gas", "few", gas(20, 3.0, 0), 3.0)


def _right() -> ListAnswer:
    pairs = truth(_CASE, 0)
    i, j = np.concatenate([pairs.i, pairs.j]), np.concatenate([pairs.j, pairs.i])
    shift = np.concatenate([pairs.shift, -pairs.shift])
    vector = pairs.positions[j] - pairs.positions[i] + shift @ pairs.cell
    return ListAnswer(i, j, shift, np.linalg.norm(vector, axis=1), vector)


def _with(**changes) -> ListAnswer:
    right = _right()
    return ListAnswer(
        *(changes.get(name, getattr(right, name)) for name in ("i", "j", "shift", "distance", "vector"))
    )


def _codes(answer: ListAnswer, how: Conventions | None = None) -> list[str]:
    return [failure.code for failure in judge(answer, truth(_CASE, 0), how or Conventions())]


def test_what_is_right_has_no_failure():
    right = _right()
    assert len(right) > 40
    assert _codes(right) == []
    assert _codes(ListAnswer(right.i, right.j)) == []
    assert _codes(ListAnswer(right.i, right.j, None, right.distance)) == []
    assert _codes(ListAnswer(right.i, right.j, -right.shift), Conventions(sign=-1)) == []
    half = right.i < right.j
    half_answer = ListAnswer(right.i[half], right.j[half], right.shift[half])
    assert _codes(half_answer, Conventions(full=False)) == []
    turned = ListAnswer(right.j[half], right.i[half], -right.shift[half])
    assert _codes(turned, Conventions(full=False)) == []
    order = np.random.default_rng(0).permutation(len(right))
    assert _codes(ListAnswer(right.i[order], right.j[order], right.shift[order])) == []


def test_each_fault_has_its_code():
    right = _right()
    most = len(right)
    cut = slice(0, most - 1)
    assert _codes(ListAnswer(right.i[cut], right.j[cut], right.shift[cut])) == ["ONE_SIDED"]
    without = (right.i != right.i[0]) | (right.j != right.j[0])
    without &= (right.j != right.i[0]) | (right.i != right.j[0])
    assert _codes(ListAnswer(right.i[without], right.j[without])) == ["MISSING"]
    twice = np.append(np.arange(most), 0)
    assert _codes(ListAnswer(right.i[twice], right.j[twice], right.shift[twice])) == ["DUPLICATE"]
    far = int(np.argmax(~np.isin(np.arange(20), right.j[right.i == 0]) & (np.arange(20) > 0)))
    more = ListAnswer(np.append(right.i, [0, far]), np.append(right.j, [far, 0]))
    assert _codes(more) == ["EXTRA"]
    own = ListAnswer(np.append(right.i, 3), np.append(right.j, 3))
    assert _codes(own) == ["SELF"]
    assert _codes(_with(i=np.where(np.arange(most) == 2, 20, right.i))) == ["RANGE"]
    assert _codes(_with(i=np.where(np.arange(most) == 2, -1, right.i))) == ["RANGE"]
    assert _codes(_with(shift=np.roll(right.shift, 1, axis=0))) == ["SHIFTS"]
    assert _codes(_with(distance=right.distance + 1e-9)) == ["DISTANCES"]
    assert _codes(_with(distance=np.where(np.arange(most) == 5, np.nan, right.distance))) == ["DISTANCES"]
    assert _codes(_with(vector=-right.vector)) == ["VECTORS"]
    assert _codes(_with(vector=-right.vector), Conventions(toward=-1)) == []
    # turned around they are right, rolled they are not
    for shift, turned in ((-right.shift, True), (np.roll(right.shift, 1, axis=0), False)):
        (wrong,) = judge(_with(shift=shift), truth(_CASE, 0), Conventions())
        assert wrong.code == "SHIFTS" and ("the other atom" in wrong.text) == turned


def test_what_shifts_cannot_mend_is_not_called_a_shift():
    """Pairs told from one side, and atoms with themselves, whose atoms alone look right."""
    edge = once("at the cutoff", "images", [[0.5, 0.5, 0.5]], 1.0, r_cut=1.0 + 2.0**-60)
    right = truth(edge, 0)
    assert len(right.i) == 3 and set(right.i) == set(right.j) == {0}
    zero, i = np.zeros(1, int), np.zeros(7, int)
    shift = np.vstack([right.shift, -right.shift, np.zeros((1, 3), int)])
    cases = (
        (ListAnswer(zero, zero, right.shift[:1]), ["ONE_SIDED"]),
        (ListAnswer(i[:5], i[:5], shift[:5]), ["ONE_SIDED"]),
        (ListAnswer(zero, zero, shift[6:]), ["SELF"]),
        (ListAnswer(i[:6], i[:6], shift[:6]), []),
    )
    for answer, codes in cases:
        found = judge(answer, right, Conventions())
        assert [failure.code for failure in found] == codes


def test_shifts_of_wrapped_positions_are_told_as_such():
    moved = once(
        "outside", "outside", _CASE.stills[0].positions + [3.0, -6.0, 0.0] * np.arange(20)[:, None], 3.0
    )
    right = truth(moved, 0)
    home = np.floor(right.positions / 3.0).astype(int)
    shift = right.shift - home[right.i] + home[right.j]
    i, j = np.concatenate([right.i, right.j]), np.concatenate([right.j, right.i])
    found = judge(ListAnswer(i, j, np.concatenate([shift, -shift])), right, Conventions())
    assert [failure.code for failure in found] == ["SHIFTS"]
    assert "wrapped" in found[0].text


@pytest.mark.parametrize("ulps", [-1, 0, 1])
def test_a_pair_within_rounding_may_be_there_or_not_but_from_both_atoms(ulps: int):
    r_cut = 2.5 + ulps * float(np.spacing(2.5))
    case = once("tie", "ties", [[1.0, 1, 1], [3.5, 1, 1]], 8.0, r_cut=r_cut)
    right = truth(case, 0)
    for i, j, codes in (([], [], []), ([0, 1], [1, 0], []), ([0], [1], ["ONE_SIDED"])):
        answer = ListAnswer(np.array(i, int), np.array(j, int))
        assert [failure.code for failure in judge(answer, right, Conventions())] == codes
    # the truth itself is that of Fractions
    exact = Fraction(5, 2) ** 2 - Fraction(r_cut) ** 2
    assert right.inside.tolist() == [exact < 0]
    assert right.tie.tolist() == [exact == 0]


def test_what_float32_may_decide_float64_may_not():
    case = once("near", "ties", [[1.0, 1, 1], [3.5 - 1e-7, 1, 1]], 8.0, r_cut=2.5)
    nothing = ListAnswer(np.zeros(0, int), np.zeros(0, int))
    assert judge(nothing, truth(case, 0, unit=SINGLE), Conventions(unit=DOUBLE))
    assert not judge(nothing, truth(case, 0, unit=SINGLE), Conventions(unit=SINGLE))


def test_rounding_that_is_allowed_grows_with_the_angles_of_a_box_and_not_with_its_lengths():
    """For two edges at an angle the condition number is the cotangent of half of it."""
    angle, every = 0.3, np.ones(3, bool)
    tilted = np.array([[1.0, 0, 0], [np.cos(angle), np.sin(angle), 0], [0, 0, 1.0]])
    for lengths in ((1.0, 1.0, 1.0), (4.0, 700.0, 0.02)):
        scaled = np.array(lengths)[:, None]
        assert conditioning(scaled * np.eye(3), every) == 1.0
        assert conditioning(scaled * tilted, every) == pytest.approx(1 / np.tan(angle / 2), rel=1e-9)
        # directions that do not repeat have no say
        assert conditioning(scaled * tilted, np.array([True, False, True])) == pytest.approx(1.0, rel=1e-12)
        assert conditioning(scaled * tilted, ~every) == 1.0
    long = once("a channel", "few", [[1.0, 1, 1], [2.0, 1, 900]], np.diag([8.0, 8.0, 1000.0]), r_cut=2.5)
    still = long.stills[0]
    assert truth(long, 0).scale == rounding_bound(still.positions, still.cell, 2.5, unit_roundoff=1.0)


def test_a_lattice_is_known_as_brute_force_finds_it():
    case = lattice(6, seed=4)
    still = case.stills[0]
    right = all_pairs(still.positions, still.cell, np.ones(3, bool), case.r_cut)
    right = right.select(right.inside)
    assert case.known is not None
    rows = [set(zip(one.i, one.j, *one.shift.T, strict=True)) for one in (right, case.known)]
    assert len(rows[0]) > 2000 and rows[0] == rows[1]
    # as it does when only some of its atoms are left
    few = case.only(np.array([70, 3, 9, 41, 12, 100, 101]))
    again = truth(few, 0)
    plain = all_pairs(few.stills[0].positions, still.cell, np.ones(3, bool), case.r_cut)
    assert int(plain.inside.sum()) == len(again.i)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (None, "returned None"),
        (3, "not \\(i, j\\)"),
        ("pairs", "not \\(i, j\\)"),
        ({"i": [0]}, "no i and j"),
        (([0, 1], [1]), "1"),
        (([0.0, 1.0], [1, 0]), "dtype float64"),
        (([[0, 1]], [[1, 0]]), "shape"),
        (([0], [1], [[0.5, 0, 0]], [[1, 0, 0.5]]), "two of its parts"),
        ({"i": [0], "j": [1], "shift": [[0.5, 0, 0]]}, "whole numbers"),
        ({"i": [0], "j": [1], "distance": [1.0, 2.0]}, "distance has shape"),
        (([0], [1], ["far"]), "dtype"),
        ([[0, 1], [2, 3], [4, 5]], "whole numbers; .*tuples"),
        ([[0, 1]] * 6, "6 parts.*tuples"),
        ([(0, 1, 2)], "row \\(i, j\\)"),
        (np.zeros((2, 7), int), "row \\(i, j\\)"),
        ((row for row in ((0, 1), (1, 0))), "generator"),
        (np.array(3), "row \\(i, j\\)"),
        (([object()], [1]), "no array of numbers"),
    ],
)
def test_what_is_no_list_of_pairs_is_told(given, said: str):
    with pytest.raises(Malformed, match=said):
        read(given)


def test_forms_of_an_answer():
    rows = ([0, 1], [1, 0])
    shift, distance = [[0, 0, 1], [0, 0, -1]], [1.0, 1.0]
    for given in (
        rows, [*rows], np.array(rows), np.array(rows).T, {"i": rows[0], "j": rows[1]},
        {"senders": rows[0], "receivers": rows[1]},
    ):  # fmt: skip
        answer = read(given)
        assert answer.i.tolist() == [0, 1] and answer.shift is None
    for given in (
        (*rows, shift, distance),
        (*rows, distance, np.array(shift, float)),
        (np.array(rows), shift),
    ):
        answer = read(given)
        assert answer.shift is not None and answer.shift.tolist() == shift
    assert read((*rows, [[0.5, 0, 0], [-0.5, 0, 0]])).vector is not None
    for nothing in (([], []), [], np.zeros((0, 2), int), np.array([]), {"i": [], "j": []}):
        assert len(read(nothing)) == 0


@pytest.mark.parametrize("pairs", range(8))
def test_pairs_one_by_one_are_read_alike_however_many(pairs: int):
    rows = [(2 * n, 2 * n + 1) for n in range(pairs)]
    for given in (rows, np.array(rows, int).reshape(-1, 2)):
        answer = read(given)
        assert list(zip(answer.i.tolist(), answer.j.tolist(), strict=True)) == rows
        assert answer.distance is None
