"""Overridden decisions: the pinned run is B but for the pairs that are imposed; the pairs that are blamed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from forks.harness import crystal, followed
from rollout.harness import furthest, history, moved, nearest

from mdnum.errors import InputError
from mdnum.forks import Fork
from mdnum.forks.replays import disagreements, minimal_cause, parse_pin, pinned
from mdnum.rollout.compared import ReferenceFrame
from mdnum.rollout.epoch import Pin, Pins


@pytest.fixture(scope="module")
def found() -> Fork:
    """Two crystals 1e-7 apart whose split hangs on the decision at the fork."""
    return followed(1e-7, 2200, split=0.03, repeats=0, counterfactual=False)


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
    pairs = sorted({(flip.i, flip.j) for flip in found.flips})
    a, b = (inside(simulation, found.steps, pairs) for simulation in (crystal(), moved(crystal(), 1e-7)))
    differ = a != b
    assert len(pairs) > 1 and len(differ) == found.steps + 1
    for k, (i, j) in enumerate(pairs):
        changes = changed(differ[:, k])
        expected = [*changes, None] if differ[-1, k] else changes
        assert disagreements(found, i, j) == list(zip(expected[::2], expected[1::2], strict=True))


def inside(simulation, last, pairs) -> np.ndarray:
    """Whether the distance of each pair is below the cutoff at each step."""
    x, _ = history(simulation, last)
    i, j = np.array(pairs).T
    return np.sum(nearest(simulation, x[:, i] - x[:, j]) ** 2, axis=2) < simulation.r_cut**2


def changed(decided: np.ndarray) -> tuple[int, ...]:
    """Steps at which it is another than at the step before."""
    return tuple((np.flatnonzero(np.diff(decided)) + 1).tolist())


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
        with pytest.raises(InputError, match=f"pair {bad[0]}-{bad[1]}"):
            pinned(found, [bad])
    with pytest.raises(InputError, match="do not fork"):
        pinned(replace(found, decision=None))
    with pytest.raises(InputError, match="stayed close together"):
        minimal_cause(followed(1e-7, 37, repeats=0, counterfactual=False))
    labels = ReferenceFrame(np.roll(np.arange(108), 1), np.arange(3), np.ones(3), np.zeros(3))
    other = replace(found.twin, b=replace(found.twin.b, frame=labels))
    with pytest.raises(InputError, match="different orders"):
        pinned(replace(found, twin=other))


# --- minimal causes -----------------------------------------------------------------------------------


def test_one_decision_of_four_thousand_did_it(found):
    cause = minimal_cause(found)
    assert cause.code == "alone" and cause.proven and cause.tests == 1
    assert cause.pairs == (found.decision.subject,) and cause.candidates > 100
    # once more by hand: A's flips of this pair, from A's positions alone
    a, b, last = crystal(), moved(crystal(), 1e-7), cause.horizon
    (pair,) = cause.pairs
    own = inside(a, last, [pair])[:, 0]
    pin = Pin(*pair, 0, last, changed(own), bool(own[0]))
    end = history(a, last)[0][-1]
    assert furthest(a, history(b, last)[0][-1], end) > 0.02
    assert furthest(a, history(b, last, pins=Pins([pin]))[0][-1], end) < 1e-5


def test_several_decisions_none_of_which_can_be_left_out():
    """Two crystals 1e-6 apart, whose split hangs on several decisions."""
    quick = followed(1e-6, 900, split=0.03, repeats=0, counterfactual=False)
    cause = minimal_cause(quick)
    assert cause.pairs is not None and cause.code == "proven"
    assert 1 < len(cause.pairs) < 20 and cause.tests <= 80
    # within few runs a set is enough, but not proven smallest
    cause = minimal_cause(quick, tests=6)
    assert cause.tests == 6 and cause.code == "unproven" and cause.pairs is not None
