"""Overridden decisions: the pinned run is B but for the pairs that are imposed; the pairs that are blamed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from forks.harness import crystal, followed, moved

from mdnum.errors import InputError
from mdnum.forks import Fork
from mdnum.forks.replays import disagreements, minimal_cause, parse_pin, pinned
from mdnum.rollout.compared import ReferenceFrame
from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import Pin, Pins


@pytest.fixture(scope="module")
def found() -> Fork:
    """Two crystals 1e-7 apart whose split hangs on the decision at the fork."""
    return followed(1e-7, 2200, split=0.03, repeats=0, counterfactual=False)


@pytest.fixture(scope="module")
def quick() -> Fork:
    """Two crystals 1e-6 apart, whose split hangs on several decisions."""
    return followed(1e-6, 900, split=0.03, repeats=0, counterfactual=False)


def test_the_decision_at_the_fork_alone(found):
    i, j = found.decision.subject
    (first, end), *_ = disagreements(found, i, j)
    one = pinned(found)
    assert one.pairs == ((i, j),) and (one.first, one.last) == (first, end - 1)
    assert one.first == found.dates.fork and one.free == found.dates.split
    # up to the fork the same run, bit for bit; after it another one
    np.testing.assert_array_equal(one.separation[: first + 1], found.series["B"][: first + 1])
    assert one.separation[first + 40] < 0.5 * found.series["B"][first + 40]
    # spells are the cross-run flips of the pair
    steps = [flip.step for flip in found.flips if (flip.i, flip.j) == (i, j)]
    assert [at for spell in disagreements(found, i, j) for at in spell if at is not None] == steps


def test_spells_are_the_steps_at_which_the_distances_disagree(found):
    """Every pair that was decided differently, judged by the positions of two runs of their own."""
    inside = []
    pairs = sorted({(flip.i, flip.j) for flip in found.flips})
    i, j = np.array(pairs).T
    for simulation in (crystal(), moved(crystal(), 1e-7)):
        box = np.diag(simulation.cell.matrix)
        rows = [
            segment.unsorted("x", row).astype(np.float64)
            for segment in Engine(simulation, found.steps).segments()
            for row in range(segment.rows)
        ]
        d = np.stack([x[i] - x[j] for x in rows])
        d -= box * np.rint(d / box)
        inside.append(np.sum(d**2, axis=2) < simulation.r_cut**2)
    assert len(pairs) > 1 and len(inside[0]) == found.steps + 1
    differ = inside[0] != inside[1]
    for k, (i, j) in enumerate(pairs):
        changes = (np.flatnonzero(np.diff(differ[:, k])) + 1).tolist()
        expected = [*changes, None] if differ[-1, k] else changes
        assert disagreements(found, i, j) == list(zip(expected[::2], expected[1::2], strict=True))


def test_a_named_pair_over_the_whole_run_removes_the_split(found):
    i, j = found.decision.subject
    whole = pinned(found, [(j, i)])
    assert (whole.first, whole.last) == (0, found.steps)
    assert found.dates.split is not None and whole.split is None
    assert whole.separation[: int(1.25 * found.dates.split)].max() < 1e-5
    # in the same window the order of the ends does not matter, and another window is another run
    late = pinned(found, [(i, j)], first=found.dates.fork + 200)
    start = slice(found.dates.fork + 200)
    np.testing.assert_array_equal(late.separation[start], found.series["B"][start])
    assert late.split is not None


def test_pins_on_what_agrees_change_nothing(found):
    """What a pair decides that is never decided differently is imposed on it."""
    differ = {(flip.i, flip.j) for flip in found.flips}
    agreed = next((0, j) for j in range(1, found.twin.a.size) if (0, j) not in differ)
    np.testing.assert_array_equal(pinned(found, [agreed], steps=400).separation, found.series["B"][:401])


def test_words_name_a_decision():
    assert parse_pin("fork", 108) == {}
    assert parse_pin("75-3", 108) == {"pairs": [(75, 3)], "first": None, "last": None}
    assert parse_pin("3-75:600..700", 108) == {"pairs": [(3, 75)], "first": 600, "last": 700}
    for text in ("three", "3-75:9..8", "3-3", "3-108"):
        with pytest.raises(InputError):
            parse_pin(text, 108)


def test_what_cannot_be_pinned_is_refused(found):
    for bad in ((5, 5), (3, 108)):
        with pytest.raises(InputError, match=f"no pair {bad[0]}-{bad[1]}"):
            pinned(found, [bad])
    with pytest.raises(InputError, match="do not fork"):
        pinned(replace(found, decision=None))
    labels = ReferenceFrame(np.roll(np.arange(108), 1), np.arange(3), np.ones(3), np.zeros(3))
    other = replace(found.twin, b=replace(found.twin.b, frame=labels))
    with pytest.raises(InputError, match="other labels"):
        pinned(replace(found, twin=other))


# --- minimal causes -----------------------------------------------------------------------------------


def apart(simulation, one, other) -> float:
    box = np.diag(np.asarray(simulation.cell.matrix))
    d = one - other
    d -= box * np.round(d / box)
    return float(np.linalg.norm(d, axis=1).max())


def last_positions(simulation, last, pins=None):
    *_, segment = Engine(simulation, last, pins=pins).segments()
    return segment.unsorted("x", segment.rows - 1)


def test_one_decision_of_four_thousand_did_it(found):
    cause = minimal_cause(found)
    assert cause.code == "alone" and cause.proven and cause.tests == 1
    assert cause.pairs == (found.decision.subject,) and cause.candidates > 100
    # once more by hand: A's flips of this pair, from A's record alone
    a, b = crystal(), moved(crystal(), 1e-7)
    (pair,) = cause.pairs
    box, inside = np.diag(np.asarray(a.cell.matrix)), []
    for segment in Engine(a, cause.horizon).segments():
        for row in range(segment.rows):
            x = segment.unsorted("x", row)
            d = x[pair[1]] - x[pair[0]]
            d -= box * np.round(d / box)
            inside.append(bool(d @ d < a.r_cut**2))
    changes = tuple(np.flatnonzero(np.diff(np.array(inside, int))) + 1)
    pin = Pin(*pair, 0, cause.horizon, tuple(int(step) for step in changes), inside[0])
    end = last_positions(a, cause.horizon)
    assert apart(a, last_positions(b, cause.horizon), end) > 0.02
    assert apart(a, last_positions(b, cause.horizon, Pins([pin])), end) < 1e-5


def test_several_decisions_none_of_which_can_be_left_out(quick):
    cause = minimal_cause(quick)
    assert cause.pairs is not None and cause.code == "proven"
    assert 1 < len(cause.pairs) < 20 and cause.tests <= 80


def test_within_few_runs_a_set_is_enough_but_not_proven_smallest(quick):
    cause = minimal_cause(quick, tests=6)
    assert cause.tests == 6 and cause.code == "unproven" and cause.pairs is not None


def test_what_did_not_split_has_no_cause():
    with pytest.raises(InputError, match="did not split"):
        minimal_cause(followed(1e-7, 37, repeats=0, counterfactual=False))
