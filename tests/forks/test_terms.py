"""Forks of terms with different radii: a pair has a decision for each, and they are imposed one by one."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from forks.harness import crystal, pair
from rollout.harness import history, moved, nearest

import mdnum
from mdnum import Cut, LennardJones, Term
from mdnum.forks import fork
from mdnum.forks.replays import neighborhood, pinned
from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import Pin, Pins
from mdnum.rollout.flips import PairRecorder

STEPS, RADII = 900, {"core": crystal().r_cut, "tail": 1.945}


@cache
def two_terms():
    """The cold crystal whose second shell lies at the cutoff, with a weak tail that ends at its third."""
    plain = crystal()
    terms = {
        "core": Term(LennardJones(sigma=1.0, epsilon=1.0), Cut("hard", RADII["core"])),
        "tail": Term(LennardJones(sigma=1.0, epsilon=0.02), Cut("hard", RADII["tail"])),
    }
    return mdnum.simulation(
        plain.structure, terms, units="lj", timestep=plain.timestep, skin=plain.rule.skin,
        temperature=plain.draw.temperature, seed=plain.draw.seed,
    )  # fmt: skip


@pytest.fixture(scope="module")
def found():
    return fork(pair(two_terms(), moved(two_terms(), 1e-7)), STEPS, split=0.03, repeats=0)


def decided(simulation, x):
    """{(channel, i, j)} of distances, at one step."""
    i, j = np.triu_indices(simulation.atoms, 1)
    square = np.sum(nearest(simulation, x[i] - x[j]) ** 2, axis=1)
    return {
        (channel, int(a), int(b))
        for channel, radius in enumerate(RADII.values())
        for a, b in zip(i[square < radius**2], j[square < radius**2], strict=True)
    }


def test_cross_flips_are_those_of_the_distances(found):
    a, b = (two_terms(), moved(two_terms(), 1e-7))
    last = min(found.steps, 500)
    (xa, _), (xb, _) = (history(one, last) for one in (a, b))
    differ = [decided(a, one) ^ decided(b, other) for one, other in zip(xa, xb, strict=True)]
    np.testing.assert_array_equal(found.series["cross"][: last + 1], [len(one) for one in differ])
    changes = {(step, *key) for step in range(1, last + 1) for key in differ[step] ^ differ[step - 1]}
    atoms = a.atoms
    assert changes == {(f.step, *divmod(f.i, atoms), f.j) for f in found.flips if f.step <= last}
    assert {key[1] for key in changes} == {0, 1}


def test_decisions_are_imposed_term_by_term(found):
    # under the decisions of A the runs stay together where they would not
    free, imposed = found.series["B"], found.series["B|A"]
    assert np.nanmax(imposed) < 1e-5 and np.nanmax(free) > 20 * np.nanmax(imposed)
    alone = pinned(found)
    assert alone.pairs == (tuple(found.decision.subject),)
    fork_at = found.dates.fork
    np.testing.assert_array_equal(alone.separation[: fork_at + 1], found.series["B"][: fork_at + 1])
    around = neighborhood(found)
    assert around is not None and around.margins[0] * around.margins[1] < 0


@pytest.mark.parametrize("channel", [0, 1])
def test_a_pin_is_one_of_its_term(channel):
    simulation = two_terms()
    x, _ = history(simulation, 5)
    i, j = sorted(next(key[1:] for key in sorted(decided(simulation, x[0])) if key[0] == channel))
    pins = Pins([Pin(i + channel * simulation.atoms, j, 0, 5, (), False)])
    other, _ = history(simulation, 5, pins=pins)
    force = np.abs(other[-1] - x[-1]).sum(axis=1)
    # without the energy of this pair in one term its atoms move apart from where they would be
    assert set(np.argsort(force)[-2:]) == {i, j}
    # and not as where the other term is pinned
    pins = Pins([Pin(i + (1 - channel) * simulation.atoms, j, 0, 5, (), False)])
    assert not np.array_equal(history(simulation, 5, pins=pins)[0], other)


def test_a_lost_pair_is_lost_in_the_term_that_it_belongs_to():
    """A list that is never rebuilt: what new lists find enters the term whose radius holds it."""
    hot = mdnum.simulation(
        crystal().structure,
        {key: Term(LennardJones(sigma=1.0, epsilon=0.1), Cut("hard", r)) for key, r in RADII.items()},
        units="lj", timestep=0.01, skin=0.05, temperature=1.5, seed=1, rebuild=(20, 0, False),
    )  # fmt: skip
    recorder, flips, missed = PairRecorder(hot), [], 0
    for segment in Engine(hot, 60).segments():
        flips.append(recorder.flips(segment))
        missed += recorder.missed
    assert missed > 0
    members = decided(hot, history(hot, 0)[0][0])
    for ledger in flips:
        for i, j, entered in zip(ledger.i.tolist(), ledger.j.tolist(), ledger.entered.tolist(), strict=True):
            key = (*divmod(i, hot.atoms), j)
            assert (key in members) != entered
            (members.add if entered else members.discard)(key)
