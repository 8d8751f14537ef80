"""Damage that leaves finite numbers: atoms in a plane, on a line, at a point, or shifted far.

What is planar, straight, drifting or wrapped by nature stays what it is.
"""

from __future__ import annotations

import re
from pathlib import Path

import ase.io
import MDAnalysis
import numpy as np
import pytest
from ase import Atoms
from trajectories.files import checked

import mdnum
from mdnum.reading import FrameError
from mdnum.store import RunFolder
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.frame import Box, Frame

DATA = Path(__file__).with_name("data")
SIDE = 12.0


def liquid(atoms: int = 40, frames: int = 8, seed: int = 2, step: float = 0.2):
    """Positions of atoms anywhere in a box, which walk."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, SIDE, (atoms, 3))
    for _ in range(frames):
        yield x.copy()
        x = x + rng.normal(0, step, x.shape)


def examined(positions, side: float | None = SIDE, atoms=None) -> list[Frame]:
    """Frames with a cubic box, or none, up to the first that is refused."""
    box = Box() if side is None else Box(np.eye(3) * side, np.ones(3, bool))
    frames = (Frame(number, float(number), x, box) for number, x in enumerate(positions))
    return list(checked(frames, atoms))


def refused(said: str, positions, side: float | None = SIDE, frame: int = 5, atoms=None) -> None:
    with pytest.raises(FrameError, match=f"frame {frame}:? ?.*{said}") as caught:
        examined(positions, side, atoms)
    assert caught.value.frame == frame and {f"@:{frame}", f"@{frame}:"} & set(
        re.findall(r"@[\d:]+", str(caught.value))
    )


def spoiled(how, positions=None, number: int = 5):
    for k, x in enumerate(liquid() if positions is None else positions):
        yield how(x) if k >= number else x


def put(axis, value):
    def how(x):
        x[:, axis] = value
        return x

    return how


def put_some(axis, value, count):
    """The same of so many atoms here and there."""

    def how(x):
        x[np.ix_(np.random.default_rng(3).permutation(len(x))[:count], np.atleast_1d(axis))] = value
        return x

    return how


def along(x, *directions):
    """Positions without what is not along these directions, about their middle."""
    basis = np.linalg.qr(np.array(directions, float).T)[0]
    return x.mean(axis=0) + (x - x.mean(axis=0)) @ basis @ basis.T


@pytest.mark.parametrize("side", [SIDE, None])
@pytest.mark.parametrize(
    ("how", "said"),
    [
        (put(2, 2**31 / 100), "in a plane, z = 2.147"),
        (put(0, 0.0), "in a plane, x = 0"),
        (put(1, 3.0), "in a plane, y = 3"),
        (put([0, 2], 7.5), "on a line, x = 7.5, z = 7.5"),
        (put([0, 1, 2], 4.0), "at one point"),
        (lambda x: along(x, (1, 2, 3), (3, -1, 1)), "in a plane"),
        (lambda x: along(x, (1, 2, 3)) + 1e-4 * x, "on a line"),
        (lambda x: x * [1.0, 1e-4, 1.0], "in a plane"),
        (lambda x: x * [1.0, 1.0, 1e-2], "in a plane"),
        # a coordinate of some of the atoms
        (put_some(2, 0.0, 20), "50% of all atoms have z = 0"),
        (put_some(0, 2**31 / 1e8, 12), "30% of all atoms have x = 21.47"),
        (put_some([0, 1], 3.5, 25), "have [xy] = 3.5"),
        (lambda x: x + np.array([0.0, 2**31 / 1000, 0.0]), "shifted by 2.15e"),
        (lambda x: x - 1e6, "shifted by 1.73e"),
    ],
)
def test_a_frame_that_collapsed_or_was_shifted_far_ends_the_file(how, said, side):
    refused(said, spoiled(how), side)


@pytest.mark.parametrize("side", [SIDE, None])
@pytest.mark.parametrize("bad", [1, 2, 5])
@pytest.mark.parametrize(
    ("axis", "value", "said"),
    [
        (2, 2**31 / 100, "z = 2.14748e.07"),
        (2, 0.0, "z = 0"),
        (0, 6.0, "x = 6"),
        ([0, 1], 3.0, "x = 3, y = 3"),
        ([0, 1, 2], 4.0, "x = 4, y = 4, z = 4"),
    ],
)
def test_first_frames_that_collapsed_are_named_and_not_the_good_one_behind_them(axis, value, said, side, bad):
    positions = [put(axis, value)(x) if k < bad else x for k, x in enumerate(liquid())]
    refused(f"is the first .* have {said}: ", positions, side, bad)
    assert len(examined(positions[bad:], side)) == 8 - bad


@pytest.mark.parametrize("side", [SIDE, None])
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("last", [6, 8])
def test_a_part_of_the_atoms_that_is_far_out_is_damage_as_one_is(share, last, side):
    """In one frame, or from one on."""
    positions = list(liquid(32))
    for x in positions[5:last]:
        x[: int(32 * share), 1] += 2**31 / 100
    refused(r"atom .* away .*, and \d+ others", positions, side)


@pytest.mark.parametrize("atoms", [5, 40])
def test_a_cluster_without_a_box_does_not_leap_by_hundreds_of_its_sizes(atoms):
    """Nor is it left where it was by a shift of some sizes, to the middle of a box that the file lacks."""
    cluster = [x * 7 / SIDE for x in liquid(atoms)]
    refused(
        "all .* shifted by 2.15e",
        [x + (k > 4) * 2**31 / 1e6 * np.eye(3)[2] for k, x in enumerate(cluster)],
        None,
    )
    for far in (7.0, 100.0):
        assert len(examined([x + (k > 4) * far for k, x in enumerate(cluster)], None)) == 8


@pytest.mark.parametrize("atoms", [5, 8, 500, 3000])
def test_it_does_not_depend_on_how_many_atoms_there_are(atoms):
    refused("in a plane, z = 21", spoiled(put(2, 2**31 / 1e8), liquid(atoms, 7)))
    # a slab, far thinner than it is wide
    slab = [x * [4.0, 4.0, 0.6] for x in liquid(max(atoms, 200), 7)]
    refused("in a plane, z = 1", spoiled(put(2, 1.0), slab), side=50.0)


def test_only_the_atoms_that_matter_matter():
    some = np.arange(10, 40)

    def how(x):
        x[:12, 2] = 3.0
        return x

    assert len(examined(spoiled(how), atoms=some)) == 8
    refused("in a plane", spoiled(put(2, 3.0)), atoms=some)


def rotated(x, rng):
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return x @ q


RNG = np.random.default_rng(7)
HONEYCOMB = np.array(
    [[1.42 * (1.5 * i), 2.46 * (j + 0.5 * (i % 2)), 0.0] for i in range(8) for j in range(8)]
)
RING = np.array([[np.cos(a) * r, np.sin(a) * r, 0.0] for r in (1.4, 2.48) for a in np.arange(6) * np.pi / 3])
AMMONIA = np.array([[0.0, 0, 0.28], [0.94, 0, -0.1], [-0.47, 0.81, -0.1], [-0.47, -0.81, -0.1]])
CHAIN = np.arange(20)[:, None] * [1.3, 0.0, 0.0]
CRYSTAL = np.stack(np.meshgrid(*[np.arange(4) * 3.0] * 3), -1).reshape(-1, 3)
FINE = {
    # planar from the beginning, in any direction, frozen or not, and once all of its ripples are gone
    "two dimensions": (x * [1, 1, 0] for x in liquid()),
    "a tilted plane": (along(x, (1, 2, 3), (3, -1, 1)) for x in liquid()),
    "graphene that is minimized": (
        HONEYCOMB + RNG.normal(0, 0.3, (64, 3)) * [1, 1, 20.0**-k] for k in range(8)
    ),
    "a ring that is minimized": (RING + RNG.normal(0, 0.2, (12, 3)) * 30.0**-k for k in range(8)),
    "a chain that is straightened": (CHAIN + RNG.normal(0, 0.5, (20, 3)) * 30.0**-k for k in range(8)),
    "a sheet that is minimized, in few digits": (
        np.round(HONEYCOMB + RNG.normal(0, 0.3, (64, 3)) * [1, 1, 20.0**-k], 2) for k in range(8)
    ),
    # layers of a crystal, at the start of each of two runs; one that never moves; a wall that catches atoms
    "two runs from a crystal": (x if k % 4 else CRYSTAL for k, x in enumerate(liquid(64))),
    "a layer that is held": (put_some(2, 0.0, 20)(x) for x in liquid()),
    "atoms that settle one by one": (put_some(2, 0.0, 2 * k)(x) for k, x in enumerate(liquid())),
    "a line": (along(x, (1, 2, 3)) for x in liquid()),
    # planar, straight or of layers in the first frames, and not for ever
    "a sheet that begins to ripple": (
        HONEYCOMB + RNG.normal(0, 0.02, (64, 3)) * [1, 1, 0.5 * k] for k in range(8)
    ),
    "a molecule that is planar at first": (AMMONIA * [1, 1, k / 3] for k in range(4)),
    "a ring that is planar at first": (RING + RNG.normal(0, 0.1, (12, 3)) * (k > 0) for k in range(8)),
    "a gas that starts in a plane": (x * [1, 1, k > 0] for k, x in enumerate(liquid(step=4.0))),
    "a gas that starts on a line": (x * [1, k > 0, k > 0] for k, x in enumerate(liquid(step=4.0))),
    "a crystal that melts": (CRYSTAL + RNG.normal(0, 0.3 * k, (64, 3)) for k in range(8)),
    "two atoms on an axis at first": (x[:2] * [1, k > 0, k > 0] for k, x in enumerate(liquid())),
    "three atoms on an axis at first": (x[:3] * [1, k > 0, k > 0] for k, x in enumerate(liquid())),
    # few atoms
    "one atom": (x[:1] for x in liquid(step=5.0)),
    "one atom that drifts": (np.full((1, 3), 1e5 * k) for k in range(8)),
    "two atoms": (x[:2] for x in liquid(step=5.0)),
    "three atoms": (x[:3] for x in liquid(step=5.0)),
    "ammonia turns inside out": (AMMONIA * [1, 1, f] for f in (1, 0.5, 0.1, 1e-6, -0.1, -0.5, -1)),
    "a molecule tumbles": (rotated(AMMONIA + 1e-3, RNG) for _ in range(8)),
    # conventions
    "moved by a box length or two": (
        x + SIDE * np.array([0, k > 4, -2 * (k > 5)]) for k, x in enumerate(liquid())
    ),
    "centered": (x - (k > 4) * x.mean(axis=0) for k, x in enumerate(liquid())),
    "wrapped again after a long run": (
        x % SIDE if k > 5 else x for k, x in enumerate(liquid(frames=8, step=3e3))
    ),
    # a run that drifts, unwrapped
    "a slow drift": (x + 40.0 * k * SIDE for k, x in enumerate(liquid())),
    "a fast drift": (x + 500.0 * k * SIDE for k, x in enumerate(liquid())),
    "a drift that gets faster": (x + 60.0 * 3.0**k * SIDE for k, x in enumerate(liquid())),
    # physics
    "a gas that condenses": (
        6.0 + (x[:: 1 if k < 5 else -1] - 6.0) * (1.0 if k < 5 else 0.08)
        for k, x in enumerate(liquid(step=4.0))
    ),
    "it expands": (x * 2.0**k for k, x in enumerate(liquid())),
}


@pytest.mark.parametrize("name", FINE)
def test_what_a_simulation_may_do_is_left_alone(name):
    positions = list(FINE[name])
    for side in (SIDE, None):
        if not (side is None and "drift" in name and "fast" in name):
            assert len(examined(positions, side)) == len(positions)


def test_a_box_that_shrinks_takes_its_atoms_along():
    frames = [
        Frame(k, float(k), x * f, Box(np.eye(3) * SIDE * f, np.ones(3, bool)))
        for k, (x, f) in enumerate(zip(liquid(frames=4), (1.0, 1.0, 0.25, 0.25), strict=True))
    ]
    assert len(list(checked(frames))) == 4


@pytest.mark.nightly
def test_what_was_good_before_a_coordinate_overflowed_is_kept(tmp_path):
    path = DATA / "overflowed_coordinate.extxyz"
    found = mdnum.flips(path, cutoffs=[5.0], out=tmp_path / "a", report=False)
    assert found.summary["frames"] == 6 and found.summary["status"] == "stopped"
    assert RunFolder.open(found.folder).read("frames")["pairs"].tolist() == [192, 195, 197, 195, 197, 195]
    assert "frame 6" in found.summary["stopped"] and "z = 2.14748e+07" in found.summary["stopped"]
    whole = mdnum.flips(f"{path}@:6", cutoffs=[5.0], out=tmp_path / "b", report=False)
    assert found.summary["rules"][0]["flips"] == whole.summary["rules"][0]["flips"]


@pytest.mark.parametrize("parts", [pytest.param(1, marks=pytest.mark.nightly), 3])
def test_the_analysis_stops_there_too_and_may_run_again(tmp_path, parts):
    frames = [Atoms("Ar40", x, cell=[SIDE] * 3, pbc=True) for x in spoiled(put(2, 50.0))]
    for atoms in frames:
        atoms.positions *= [1, 1, 1]
    ase.io.write(tmp_path / "run.xyz", frames, format="xyz")
    universe = MDAnalysis.Universe(str(tmp_path / "run.xyz"))
    analysis = NeighborFlips(universe, 5.0)
    for _ in range(2):
        with pytest.raises(FrameError, match=r"frame 5: .*plane, z = 50"):
            analysis.run(n_parts=parts)
        assert analysis.frames.tolist() == [0, 1, 2, 3, 4]
    assert len(NeighborFlips(universe, 5.0).run(start=5).frames) == 3


@pytest.mark.parametrize("bad", [1, 2])
def test_a_file_whose_first_frames_collapsed_is_refused_and_read_from_the_good_one_on(tmp_path, bad):
    frames = [
        Atoms("Ar40", put(2, 2**31 / 100)(x) if k < bad else x, cell=[SIDE] * 3, pbc=True)
        for k, x in enumerate(liquid())
    ]
    ase.io.write(tmp_path / "run.extxyz", frames)
    with pytest.raises(FrameError, match=f"frame {bad} .*first .*@{bad}:"):
        mdnum.flips(tmp_path / "run.extxyz", cutoffs=[5.0], out=tmp_path / "a", report=False)
    found = mdnum.flips(tmp_path / f"run.extxyz@{bad}:", cutoffs=[5.0], out=tmp_path / "a", report=False)
    assert found.summary["frames"] == 8 - bad and found.summary["status"] != "stopped"
