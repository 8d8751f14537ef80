"""Verdicts at both ends: a crystal whose flips are the cause, one without flips, a run and itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from forks.harness import crystal, followed, made, moved, pair
from small_systems import make

from mdnum.errors import InputError
from mdnum.forks import Fork, fork
from mdnum.forks.pair import displacements
from mdnum.numerics.verdicts import Dates
from mdnum.rollout.engine import Engine
from mdnum.rollout.program import MdProgram
from mdnum.systems import System
from mdnum.systems.build import build


def test_in_a_cold_crystal_the_flips_are_the_cause():
    found = followed(1e-6, 1500, split=0.03, back=True)
    assert found.verdict.word == "cause"
    assert found.splits["B"] is not None and found.splits["B|A"] is None and found.splits["A|B"] is None
    assert np.nanmax(found.series["B|A"]) < 1e-5
    decision = found.decision
    assert decision is not None and decision.step == found.dates.fork
    # the margin is of the size of what separates the runs, and far above rounding
    assert abs(decision.margin) < 20 * decision.separation
    assert not decision.ambiguous and found.dates.first_bit == 0


@pytest.mark.parametrize(
    ("options", "size", "steps", "word"),
    [
        # too close for any pair to be decided otherwise so soon, or a shell of neighbors between two others
        ({}, 1e-12, 200, "no fork"),
        pytest.param({"cutoff__radius": 1.35}, 1e-6, 1500, "no fork", marks=pytest.mark.nightly),
        ({}, 0.0, 200, "same"),
    ],
)
def test_without_a_fork_nothing_is_judged(options, size, steps, word):
    a = crystal(**options)
    found = fork(pair(a, moved(a, size)), steps, split=0.03)
    assert found.verdict.word == word
    assert found.dates.fork is None and found.dates.split is None and found.decision is None


def test_a_horizon_too_short_is_open_and_every_series_ends_at_the_last_step():
    """A's stretches are as long as its program makes them: no 37 steps."""
    found = followed(1e-6, 37, back=True, repeats=0)
    assert {name: len(values) for name, values in found.series.items()} == dict.fromkeys(found.series, 38)
    longer = followed(1e-6, 120, split=0.03, repeats=0)
    assert longer.verdict.word == "open" and longer.dates.fork is not None


@pytest.mark.parametrize("size", [0.0, 1e-3])
def test_nudged_starts_differ_by_the_size_asked_for_and_never_by_nothing(size):
    program = MdProgram(crystal(precision__state="float32"))
    starts = [np.asarray(one.start.state.x, np.float64) for one in (program, *program.nudged(size, 3, 1))]
    largest = [np.sqrt(((x - starts[0]) ** 2).sum(axis=0)).max() for x in starts[1:]]
    assert len(largest) == 3 and min(largest) > 0
    assert not size or largest == pytest.approx([size] * 3, rel=1e-3)
    # no two are the same
    assert len({x.tobytes() for x in starts}) == 4


def test_repeats_are_perturbed_by_what_a_choice_does_at_first_and_by_a_hundredth_of_it():
    first, other = displacements(followed(1e-7, 120, repeats=0))
    assert 1e-7 < first < 1e-5 and other == pytest.approx(first / 100)


@pytest.mark.parametrize(
    ("ulp", "separation", "first", "other"),
    [
        (1e-15, 1e-6, 1e-6, 1e-8),
        # never more than a thousandth of the tolerance, and never less than an ulp
        (1e-15, 1e-3, 2e-5, 2e-7),
        (1e-15, 0.0, 1e-15, 1e-13),
        # where a hundredth is less than an ulp, whichever of an ulp and a hundred times as much is further
        (1e-15, 1e-14, 1e-14, 1e-12),
        (5e-7, 4e-6, 4e-6, 5e-7),
        (5e-7, 6e-7, 6e-7, 2e-5),
        # and there may be no other one
        (1e-3, 1e-3, 1e-3, 1e-3),
    ],
)
def test_the_other_displacement_is_two_decades_away_where_there_is_room(ulp, separation, first, other):
    found = followed(1e-6, 37, back=True, repeats=0)
    program: Any = SimpleNamespace(ulp=ulp)
    made = replace(
        found, twin=replace(found.twin, b=program), dates=Dates(0, 80, 200), steps=300, tolerance=0.02,
        series={"B": np.full(301, separation)},
    )  # fmt: skip
    assert displacements(made) == pytest.approx((first, other), rel=1e-12)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"steps": 0}, "steps = 0"),
        ({"split": -1.0}, "split = -1"),
        ({"repeats": 4, "counterfactual": False}, "repeats = 4, .*decisions of run A"),
        ({"repeats": 3}, "repeats = 3"),
        ({"back": True, "counterfactual": False}, "option `back`"),
    ],
)
def test_what_would_not_be_run_is_refused(options, words):
    with pytest.raises(InputError, match=words):
        fork(pair(crystal(), crystal()), **({"steps": 10} | options))


def test_runs_of_different_size_are_refused():
    with pytest.raises(InputError, match="108 and 864 atoms"):
        fork(pair(crystal(), build("argon/liquid-864")), 10)


@pytest.mark.slow
def test_a_run_that_ends_before_any_decision_differs_is_a_fork_by_itself():
    b = crystal(dynamics__timestep=2.0)
    found = fork(pair(crystal(), b), 4, repeats=0, counterfactual=False)
    assert found.failed.keys() == {"B"} and not found.flips
    assert found.dates.first_bit == found.dates.fork == found.steps
    assert found.verdict.word == "open"


# --- repeats ------------------------------------------------------------------------------------------


def test_the_verdict_on_a_liquid_rests_on_repeats():
    """The crystal melting splits whatever it decides; each repeat is a pair as its start would be alone."""
    start = crystal(dynamics__temperature=3.0)
    hot, steps = pair(start, moved(start, 1e-3)), 300
    found = fork(hot, steps, repeats=4, back=False)
    count = found.verdict.count
    assert count is not None and (count.pairs, count.most) == (5, 5)
    first, others = found.repeats
    assert found.verdict.word != "cause" and len(first) == 4
    # at the other displacement there are some where the first one was clear, and there without the pair
    assert len(others) in ((4, 5) if count.delayed is not None else (0,))
    assert found.displacements == displacements(found)[: 1 + (count.delayed is not None)]
    names = {f"B {number + 1}" for number in range(len(first) + len(others))}
    assert {name for name in found.series if name.startswith("B ")} == names
    # alone, from its start, the pair of runs is followed by another path through the code
    for place, (size, delays) in enumerate(zip(found.displacements, found.repeats, strict=False)):
        starts = hot.b.nudged(size, 4 + place, seed=place)
        alone = fork(replace(hot, b=starts[2]), steps, repeats=0, back=False)
        assert (alone.splits["B"], alone.splits["B|A"]) == (delays[2].free, delays[2].imposed)
    # and the first starts do not depend on how many there are
    ((free, _),) = hot.a.repeats(
        hot.b.nudged(found.displacements[0], 1, 0), steps, found.tolerance, 3 * found.tolerance
    )
    assert int((free > found.tolerance).argmax()) == first[0].free


def test_a_split_near_the_end_is_followed_further():
    """It splits at step 561: in 580 steps that could be a delay, and before it there is nothing to follow."""
    twin, steps = pair(crystal(), moved(crystal(), 1e-6)), 580
    found = fork(twin, steps, back=False)
    assert found.dates.split is not None and 0.9 * steps < found.dates.split <= steps
    assert found.verdict.word == "cause" and found.steps >= 1.2 * found.dates.split > steps
    assert found.repeats == ((), ()) and found.displacements == () and found.verdict.count is None
    before = found.dates.split - 1
    assert fork(twin, before, back=False).steps == before


# --- liquid argon at a violent cutoff, at its switched twin, and at the usual one -----------------------


SIGMA = 3.405
POTENTIAL = {"kind": "lennard-jones", "sigma": SIGMA, "epsilon": 0.0103235}
#: Rahman's box, scaled to 256 atoms.
EDGE = 10.229 * 3.4 * (256 / 864) ** (1 / 3)
#: More at the usual cutoff, where starts differ in what flips do.
STARTS = {"usual": range(6), "violent": range(3), "switched": range(3)}
CUTS = {
    "usual": {"kind": "hard", "radius": 2.5 * SIGMA},
    "violent": {"kind": "hard", "radius": 1.5 * SIGMA},
    "switched": {"kind": "switched", "radius": 1.5 * SIGMA, "onset": 1.35 * SIGMA},
}


# 256 atoms at 94.4 K and the density of argon/liquid-864, from several starts, because one may be lucky; that
# would take minutes with 864 atoms
def argon(atoms: Atoms, cut: str, **dynamics) -> System:
    # Rahman's time step
    dynamics = {"kind": "nve", "timestep": 0.01, "temperature": 94.4, "seed": 1} | dynamics
    return make(atoms, POTENTIAL, CUTS[cut], "metal", neighbors={"skin": 1.0}, dynamics=dynamics)


@cache
def liquid(seed: int) -> Atoms:
    """Melted at 300 K and cooled to 94.4 K, 15 ps each."""
    atoms = bulk("Ar", "fcc", a=EDGE / 4, cubic=True) * (4, 4, 4)
    for kelvin in (300.0, 94.4):
        thermostat = {"kind": "langevin", "friction": 2.0, "temperature": kelvin, "seed": seed}
        simulation = build(argon(atoms, "usual", **thermostat))
        *_, last = Engine(simulation, 1500, record=False).segments()
        atoms = atoms.copy()
        atoms.positions = np.asarray(last.state.x).T
        atoms.set_velocities(np.asarray(last.state.v).T)
    return atoms


@pytest.fixture(scope="module")
def forks() -> dict[str, list[Fork]]:
    """Float32 arithmetic beside float64, by cutoff and start."""
    return {
        cut: [fork(made("precision", argon(liquid(seed), cut)), 1000, back=False) for seed in STARTS[cut]]
        for cut in CUTS
    }


@pytest.mark.nightly
def test_flips_accelerate_at_a_violent_cutoff_and_seldom_at_the_usual_one(forks):
    """E-foldings that flips were worth, at eight to thirteen starts: violent 1.5 to 21, 4.4 in the median;
    usual -0.2 to 2.5, 0.5 in the median (0.8 with 864 atoms and a fifth of the time step), with two starts of
    twelve accelerated; switched -0.5 to 0.15. One is what "accelerated" asks for.
    """
    words = {cut: [one.verdict.word for one in found] for cut, found in forks.items()}
    worth = {cut: float(np.median([one.verdict.e_foldings for one in found])) for cut, found in forks.items()}
    assert words["violent"] == ["accelerated"] * 3
    assert worth["violent"] > 2.5 and worth["violent"] > 2 * worth["usual"]
    # switched off smoothly they only come along
    assert words["switched"] == ["bystander"] * 3
    for found in forks["switched"]:
        assert found.dates.fork < found.dates.split
        assert abs(found.verdict.e_foldings) < 1
    # chaos would have done, at most starts: at the third no pair of 6 is not delayed
    assert words["usual"].count("accelerated") <= 2 and words["usual"].count("bystander") >= 3
    assert worth["usual"] < 1.5
