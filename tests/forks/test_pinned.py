"""Decisions taken back: the pinned run is B but for the pairs it is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mdnum.forks.take_back import disagreements, parse_pin

from mdnum.errors import InputError
from mdnum.forks import Fork, Twin, fork, pinned
from mdnum.rollout.frame import Frame
from mdnum.systems.build import build

STEPS = 2200


@pytest.fixture(scope="module")
def found() -> Fork:
    """Two crystals 1e-7 apart whose split hangs on the decision at the fork."""
    a = build("argon/crystal-108")
    noise = np.random.default_rng(0).standard_normal(a.positions.shape)
    b = replace(a, positions=a.positions + 1e-7 * noise)
    return fork(Twin(a, b, "start"), STEPS, split=0.03, repeats=0, counterfactual=False)


def test_the_decision_at_the_fork_alone(found):
    made = found.decision
    (first, end), *_ = disagreements(found, made.i, made.j)
    one = pinned(found)
    assert one.pairs == ((made.i, made.j),) and (one.first, one.last) == (first, end - 1)
    assert one.first == found.dates.fork and one.free == found.dates.split
    # up to the fork the same run, bit for bit; after it another one
    np.testing.assert_array_equal(one.separation[: first + 1], found.series["B"][: first + 1])
    assert one.separation[first + 40] < 0.5 * found.series["B"][first + 40]


def test_a_named_pair_over_the_whole_run_takes_the_split_away(found):
    made = found.decision
    whole = pinned(found, [(made.j, made.i)])
    assert (whole.first, whole.last) == (0, found.steps)
    assert found.dates.split is not None and whole.split is None
    assert whole.separation[: int(1.25 * found.dates.split)].max() < 1e-5
    # in the same window the order of the ends does not matter, and another window is another run
    late = pinned(found, [(made.i, made.j)], first=found.dates.fork + 200)
    np.testing.assert_array_equal(
        late.separation[: found.dates.fork + 200], found.series["B"][: found.dates.fork + 200]
    )
    assert late.split is not None


def test_pins_on_what_agrees_change_nothing(found):
    """A pair that is never decided differently is told what it decides."""
    atoms = found.twin.a.atoms
    differ = {(flip.i, flip.j) for flip in found.flips}
    pair = next((0, j) for j in range(1, atoms) if (0, j) not in differ)
    np.testing.assert_array_equal(pinned(found, [pair], steps=400).separation, found.series["B"][:401])


def test_spells_are_the_cross_run_flips_of_a_pair(found):
    made = found.decision
    spells = disagreements(found, made.i, made.j)
    steps = [flip.step for flip in found.flips if (flip.i, flip.j) == (made.i, made.j)]
    assert [at for spell in spells for at in spell if at is not None] == steps


def test_words_name_a_decision():
    assert parse_pin("fork", 108) == {}
    assert parse_pin("75-3", 108) == {"pairs": [(75, 3)], "first": None, "last": None}
    assert parse_pin("3-75:600..700", 108) == {"pairs": [(3, 75)], "first": 600, "last": 700}
    for text, words in (
        ("three", "names no"),
        ("3-75:9..8", "9 to 8"),
        ("3-3", "no pair"),
        ("3-108", "no pair"),
    ):
        with pytest.raises(InputError, match=words):
            parse_pin(text, 108)


def test_what_cannot_be_pinned_is_refused(found):
    with pytest.raises(InputError, match="no pair 5-5"):
        pinned(found, [(5, 5)])
    with pytest.raises(InputError, match="no pair 3-108"):
        pinned(found, [(3, 108)])
    with pytest.raises(InputError, match="do not fork"):
        pinned(replace(found, decision=None))
    labels = Frame(np.roll(np.arange(108), 1), np.arange(3), np.ones(3), np.zeros(3))
    with pytest.raises(InputError, match="other labels"):
        pinned(replace(found, twin=replace(found.twin, frame=labels)))
