"""Boundaries in a parameter: where closed form and brute force put them, and in another process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ase import Atoms
from rollout.harness import history
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.forks.boundaries import boundaries, digests_elsewhere
from mdnum.forks.worlds import program_of
from mdnum.plain import plain
from mdnum.systems.build import build
from mdnum.systems.parameters import numbers

# processes of their own, and hundreds of runs
pytestmark = pytest.mark.slow

APART, RADIUS, SPEED = 3.0, 2.5, 1.25


def meeting(steps: int = 20):
    """Two free atoms that fly towards each other and feel nothing before they are inside."""
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [APART, 0, 0]], masses=[1.0, 1.0])
    atoms.set_velocities([[0, 0, 0], [-SPEED, 0, 0]])
    cutoff = {"kind": "hard", "radius": RADIUS, "compare": "r2 <"}
    tables = {"kind": "nve", "timestep": 0.05, "steps": steps}
    return make(atoms, LENNARD_JONES, cutoff, dynamics=tables)


def solid():
    """A warm crystal whose third shell flickers across a hard cutoff."""
    cutoff = {"kind": "hard", "radius": 2.2, "compare": "r2 <"}
    return make(crystal(), LENNARD_JONES, cutoff)


def brute(system, key: str, steps: int, values: np.ndarray) -> list[tuple[float, float]]:
    """Adjacent values whose runs hold different sets of pairs at some step, by sets of pairs."""
    number = program_of(system).number(key)
    held = [history(number.at(float(value)).simulation, steps)[1] for value in values]
    rows = zip(values, values[1:], held, held[1:], strict=False)
    return [(float(a), float(b)) for a, b, left, right in rows if left != right]


@pytest.fixture(scope="module")
def crossings():
    return boundaries(meeting(), "timestep", 0.04, 0.105, 9, cells=32)


def test_a_crossing_in_closed_form_is_found_where_it_is(crossings):
    steps, found = 9, crossings
    # inside from the first step k on with APART - SPEED k dt < RADIUS: the boundaries of dt are (1/2)/(5/4)/k
    closed = sorted((APART - RADIUS) / SPEED / k for k in range(4, steps + 1))
    assert len(found.boundaries) == len(closed) == 6
    for boundary, expected, k in zip(found.boundaries, closed, range(steps, 3, -1), strict=True):
        # k additions of a rounded product: each half an ulp of a position below 4
        assert abs(boundary.above.at - expected) <= (k + 1) * 2.0**-52 * 4 / SPEED / k
        assert boundary.above.at == np.nextafter(boundary.below.at, 1.0)
        assert (boundary.step, boundary.subject, boundary.also) == (k, (0, 1), 0)
        assert (boundary.below.decided, boundary.above.decided) == (0, 1)
        # at rest is not inside: the comparison is `<`
        assert boundary.above.margin > 0 >= boundary.below.margin
        assert boundary.confirmed is True
    assert found.histories == 7 and not found.unresolved and not found.complete
    # what is left where fewer are asked for is told
    few = boundaries(meeting(), "timestep", 0.04, 0.105, 9, cells=32, most=2, confirm=False)
    assert [edge.above.at for edge in few.boundaries] == [edge.above.at for edge in found.boundaries[:2]]
    assert len(few.unresolved) == 4 and few.boundaries[0].confirmed is None


def test_a_worker_finds_the_same_boundary(crossings):
    with ThreadPoolExecutor(1) as pool:
        found = boundaries(meeting(), "timestep", 0.1, 0.105, 9, cells=2, confirm=False, on=pool)
    assert plain(found.boundaries) == plain([replace(crossings.boundaries[-1], confirmed=None)])


@pytest.mark.nightly
@pytest.mark.parametrize("processes", [False, True])
def test_workers_find_the_same_to_the_last_bit(crossings, processes):
    with ThreadPoolExecutor(2) as pool:
        on: Any = {"workers": 2} if processes else {"on": pool}
        found = boundaries(meeting(), "timestep", 0.04, 0.105, 9, cells=32, confirm=processes, **on)
        # of the two boundaries in the second cell, the first alone
        few = boundaries(meeting(), "timestep", 0.04, 0.105, 9, cells=4, most=3, confirm=False, on=pool)
    assert plain(found.intervals) == plain(crossings.intervals)
    assert found.evaluations == crossings.evaluations > few.evaluations
    for name in ("at", "loss", "energy"):
        np.testing.assert_array_equal(getattr(found, name), getattr(crossings, name))
    told = [plain(replace(edge, confirmed=None)) for edge in crossings.boundaries]
    assert [plain(replace(edge, confirmed=None)) for edge in found.boundaries] == told
    assert all(edge.confirmed is (True if processes else None) for edge in found.boundaries)
    # what else workers had begun does not show
    alone = boundaries(meeting(), "timestep", 0.04, 0.105, 9, cells=4, most=3, confirm=False)
    assert plain(few.boundaries) == told[:3] and few.unresolved == alone.unresolved
    np.testing.assert_array_equal(few.at, alone.at)


def test_the_last_step_alone_makes_no_jump_and_an_earlier_one_does(crossings):
    last, *earlier = crossings.boundaries
    # the force of a pair acts on positions one step later; what entered at the last step has moved nothing
    assert last.step == 9 and last.separation < 1e-14
    slope = 24 * (RADIUS**-7 - 2 * RADIUS**-13)
    for boundary in earlier:
        # one kick more on one side: both atoms get dt² F per step since
        dt, since = boundary.above.at, 9 - boundary.step
        assert boundary.separation == pytest.approx(slope * dt * dt * since, rel=0.1)


@pytest.mark.parametrize(
    ("key", "at", "width"),
    [("sigma", 1.0, 1e-3), pytest.param("position.17.y", None, 1e-2, marks=pytest.mark.nightly)],
)
def test_brute_force_over_all_floats_finds_the_same(key, at, width):
    system, steps = solid(), 30
    at = program_of(system).number(key).value if at is None else at
    coarse = boundaries(system, key, at, at + width, steps, cells=8, most=1, confirm=False)
    (one,) = coarse.boundaries
    ulp = np.spacing(one.below.at)
    window = one.below.at + ulp * np.arange(-12, 14)
    truth = brute(system, key, steps, window)
    assert truth
    every = boundaries(system, key, window[0], window[-1], steps, cells=len(window), confirm=False)
    assert every.complete and every.resolution <= ulp
    assert [(b.below.at, b.above.at) for b in every.boundaries] == truth
    # bisection meets an odd number of them, and none that is not there
    few = boundaries(system, key, window[0], window[-1], steps, cells=1, confirm=False)
    met = [(b.below.at, b.above.at) for b in few.boundaries]
    assert set(met) <= set(truth) and (len(truth) > 1 or met == truth)


# in the gate those of the first test are confirmed in a fresh process
@pytest.mark.nightly
@pytest.mark.usefixtures("strangers_folder")
@pytest.mark.parametrize(
    ("make", "key", "low", "high", "steps"),
    # a number of the start, and one of the program
    [(solid, "velocity.scale", 1.0, 1.01, 30), (meeting, "cutoff.radius", 2.2, 2.3, 12)],
)
def test_both_sides_differ_in_a_fresh_process(make, key, low, high, steps):
    system = build(make())
    found = boundaries(system, key, low, high, steps, cells=4, most=2)
    assert found.boundaries
    values = [side.at for b in found.boundaries for side in (b.below, b.above)]
    elsewhere = list(digests_elsewhere(system, key, steps, values))
    number = program_of(system, steps).number(key)
    assert elsewhere == [number.at(value).history(steps).digest for value in values]
    for k, boundary in enumerate(found.boundaries):
        below, above = elsewhere[2 * k : 2 * k + 2]
        assert below != above and np.nextafter(values[2 * k], 4.0) == values[2 * k + 1]
        assert [below, above] == [boundary.below.digest, boundary.above.digest] and boundary.confirmed


@pytest.mark.parametrize(
    ("key", "low", "high", "words"),
    [
        ("sigma", 2.0, 1.0, "invalid interval"),
        ("timestep", -1.0, 1.0, "above 0"),
        ("position.7.x", 0.0, 1.0, "no atom 7"),
        ("sgima", 1.0, 2.0, "'sgima'"),
    ],
)
def test_bad_input_is_refused(key, low, high, words):
    system = meeting()
    with pytest.raises(InputError, match=words) as error:
        boundaries(system, key, low, high)
    assert key != "sgima" or all(name in str(error.value) for name in numbers(build(system)))
