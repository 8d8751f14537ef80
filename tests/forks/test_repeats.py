"""Repeats of a pair: each is the pair that its start would be alone, and they are run where they can tell."""

from __future__ import annotations

from dataclasses import replace

import pytest
from mdnum.forks.repeats import perturbed, repeat

from mdnum.errors import InputError
from mdnum.forks import fork
from mdnum.forks.choices import parse
from mdnum.systems import load


@pytest.fixture(scope="module")
def hot():
    """The crystal of 108 atoms melting: the runs split whatever they decide."""
    overrides = {"dynamics.temperature": 3.0}
    return parse("precision").make(load("argon/crystal-108", overrides))


def test_the_verdict_on_a_liquid_rests_on_repeats(hot):
    found = fork(hot, 1100, repeats=4, back=False)
    count = found.verdict.count
    assert count is not None and (count.pairs, count.most) == (5, 5)
    assert found.verdict.word != "cause" and len(found.repeats) == 4
    assert {name for name in found.series if name.startswith("B ")} == {"B 1", "B 2", "B 3", "B 4"}
    # alone, from its start, the pair of runs is followed by another path through the code
    start = perturbed(hot, found.tolerance, 4, seed=0)[2]
    alone = fork(replace(hot, start_b=start), 1100, repeats=0, back=False)
    assert (alone.splits["B"], alone.splits["B|A"]) == (found.repeats[2].free, found.repeats[2].handed)
    # and the first starts do not depend on how many there are
    (one,) = repeat(hot, perturbed(hot, found.tolerance, 1, 0), 1100, found.tolerance, 3 * found.tolerance)
    assert int((one[0] > found.tolerance).argmax()) == found.repeats[0].free


def test_a_cause_needs_no_repeats():
    twin = parse("precision").make(load("argon/crystal-108", {"dynamics.seed": 2}))
    found = fork(twin, 4000, back=False)
    assert found.verdict.word == "cause" and found.repeats == () and found.verdict.count is None


def test_a_split_near_the_end_is_followed_further():
    """It splits at step 784: in 800 steps that could be a delay, and before it there is nothing to follow."""
    twin = parse("precision").make(load("argon/crystal-108", {"dynamics.seed": 2}))
    found = fork(twin, 800, back=False)
    assert found.dates.split is not None and 0.9 * 800 < found.dates.split <= 800
    assert found.verdict.word == "cause" and found.steps >= 1.2 * found.dates.split > 800
    before = found.dates.split - 1
    assert fork(twin, before, back=False).steps == before


def test_what_would_not_be_run_is_refused(hot):
    with pytest.raises(InputError, match="repeats = 4, and no runs under A's decisions"):
        fork(hot, 10, repeats=4, counterfactual=False)
    with pytest.raises(InputError, match="repeats = 3; expected 0, or 4 and more"):
        fork(hot, 10, repeats=3)
    with pytest.raises(InputError, match="A under B's decisions was asked for"):
        fork(hot, 10, back=True, counterfactual=False)
    assert fork(hot, 10, counterfactual=False).repeats == ()
