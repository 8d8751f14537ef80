"""What the digits of a file leave undecided is the same whatever transformations are made as it is read."""

from __future__ import annotations

from functools import cache
from typing import Any

import MDAnalysis
import numpy as np
import pytest
from MDAnalysis import transformations as changes

from mdnum.errors import InputError
from mdnum.trajectories import NeighborFlips

SIDE, RADIUS = 17.0, 4.0
#: What each format rounds coordinates to, Å; 0 for floats.
STEPS = {"xtc": 0.01, "gro": 0.01, "xyz": 1e-5, "dcd": 0.0, "trr": 0.0}


@pytest.fixture(scope="module", params=["cubic", "tilted"])
def folder(request, tmp_path_factory):
    """A gas that diffuses out of its box, in every format."""
    folder, rng = tmp_path_factory.mktemp(request.param), np.random.default_rng(8)
    steps = rng.normal(0, 0.6, (9, 300, 3))
    steps[0] = rng.uniform(0, SIDE, (300, 3))
    universe: Any = MDAnalysis.Universe.empty(300, trajectory=True)
    universe.add_TopologyAttr("name", ["Ar"] * 300)
    angles = [90.0] * 3 if request.param == "cubic" else [80.0, 75.0, 65.0]
    universe.load_new(np.cumsum(steps, axis=0), order="fac", dimensions=np.array([SIDE] * 3 + angles))
    for kind in STEPS:
        universe.atoms.write(
            folder / f"a.{kind}", frames="all" if kind != "gro" else universe.trajectory[[0]]
        )
    return folder


@pytest.fixture(scope="module")
def known(folder):
    """What each format gives without transformations, or with those that give it a box: found once."""
    return cache(lambda kind, *workflow: flips_of(folder / f"a.{kind}", *workflow))


def flips_of(path, *workflow, **options):
    universe: Any = MDAnalysis.Universe(str(path))
    made = [make(universe) for make in workflow]
    if made:
        universe.trajectory.add_transformations(*made)
    return NeighborFlips(universe, RADIUS, **options).run().results


def wrapped(universe):
    return changes.wrap(universe.atoms)


def centered(universe):
    return changes.center_in_box(universe.atoms[:20])


def moved(universe):
    return changes.translate([3.0, -70.0, 0.1234567])


def followed(universe):
    return changes.NoJump()


def boxed(universe):
    return changes.set_dimensions([SIDE, SIDE, SIDE, 90, 90, 90])


@pytest.mark.parametrize("kind", ["xtc", "xyz", "dcd", "trr"])
@pytest.mark.parametrize(
    "workflow", [(wrapped,), (centered,), (centered, wrapped), (moved, wrapped), (followed,)]
)
def test_wrapping_and_centering_hide_no_digits(folder, known, kind, workflow):
    # xyz has no box
    before = (boxed,) if kind == "xyz" else ()
    plain, found = known(kind, *before), flips_of(folder / f"a.{kind}", *before, *workflow)
    assert plain.resolution.step == found.resolution.step == STEPS[kind]
    assert found.resolution.kind == plain.resolution.kind
    # never smaller than of the file; larger by what float32 does to the new places
    least = known(kind).bound
    assert (found.bound >= least).all() and (found.bound <= least + 2e-4).all()
    assert abs(len(found.flips) - len(plain.flips)) <= plain.flips.ambiguous.sum() + 2
    if STEPS[kind] == 0.01:
        assert plain.flips.ambiguous.sum() > 10
        assert abs(int(found.flips.ambiguous.sum()) - int(plain.flips.ambiguous.sum())) <= 3


def test_the_bound_holds_where_wrapping_makes_large_coordinates_small(tmp_path):
    """What was far out was rounded there: float32 at 10^5 Å is 0.008 Å."""
    rng = np.random.default_rng(3)
    universe: Any = MDAnalysis.Universe.empty(100, trajectory=True)
    places = rng.uniform(0, SIDE, (4, 100, 3)) + rng.integers(-6000, 6000, (100, 3)) * SIDE
    universe.load_new(places, order="fac", dimensions=np.array([SIDE] * 3 + [90.0] * 3))
    universe.atoms.write(tmp_path / "a.dcd", frames="all")
    plain, found = flips_of(tmp_path / "a.dcd"), flips_of(tmp_path / "a.dcd", wrapped)
    assert (found.bound >= plain.bound).all() and plain.bound.min() > 0.01


def test_other_processes_find_the_same_bound(folder):
    universe: Any = MDAnalysis.Universe(str(folder / "a.xtc"))
    universe.trajectory.add_transformations(changes.wrap(universe.atoms))
    one = NeighborFlips(universe, RADIUS).run().results
    two = NeighborFlips(universe, RADIUS).run(backend="multiprocessing", n_workers=2).results
    np.testing.assert_array_equal(one.bound, two.bound)
    assert one.flips.equals(two.flips)


def test_a_rotation_without_a_box_keeps_the_digits(tmp_path, folder):
    def without(universe):
        return changes.set_dimensions(np.zeros(6))

    def turned(universe):
        return changes.rotateby(40, [1, 2, 3], point=[0, 0, 0])

    path = folder / "a.xtc"
    plain, found = flips_of(path, without), flips_of(path, without, turned)
    assert plain.resolution.step == found.resolution.step == 0.01
    assert abs(len(found.flips) - len(plain.flips)) <= plain.flips.ambiguous.sum() + 2


def scaled(universe):
    def ts_of(ts):
        ts.positions *= 10
        return ts

    return ts_of


def averaged(universe):
    return changes.PositionAverager(2)


@pytest.mark.parametrize("make", [scaled, averaged])
def test_where_distances_change_the_digits_cannot_be_known(folder, make):
    with pytest.raises(InputError, match=r"change distances .*\d Å.*bound=LENGTH"):
        flips_of(folder / "a.xtc", make)
    assert set(flips_of(folder / "a.xtc", make, bound=0.25).bound) == {0.25}


def test_where_transformations_were_made_in_memory_the_digits_cannot_be_known(folder):
    for open_it in (
        lambda: MDAnalysis.Universe(str(folder / "a.xtc"), in_memory=True),
        lambda: MDAnalysis.Universe(str(folder / "a.gro")),
    ):
        universe: Any = open_it()
        universe.trajectory.add_transformations(changes.wrap(universe.atoms))
        with pytest.raises(InputError, match=r"in memory.*bound=LENGTH"):
            NeighborFlips(universe, RADIUS).run()
        NeighborFlips(universe, RADIUS, bound=0.02).run()
