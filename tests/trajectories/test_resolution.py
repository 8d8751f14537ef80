"""The resolution of a file against what was done to its numbers; its effect on flips against the truth."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from MDAnalysisTests import datafiles
from trajectories.files import water
from trajectories.liquid import CUTOFF, liquid, memberships, missed_and_invented

from mdnum.errors import InputError
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.readers import open_trajectory
from mdnum.trajectories.resolution import grid_effect, infer
from mdnum.trajectories.rules import Capped, CutoffRule, Nearest
from mdnum.trajectories.tracker import Tracker

# a liquid at every step takes longer to run than all the rest
STRIDES = pytest.mark.parametrize("stride", [pytest.param(1, marks=pytest.mark.nightly), 4])

TILTED = np.array([[9.0, 0, 0], [2.3, 8.1, 0], [-1.7, 3.3, 10.9]])


def frames_of(positions, matrix=TILTED):
    box = Box(np.asarray(matrix, float), np.ones(3, bool))
    return [Frame(k, float(k), np.asarray(x, np.float64), box) for k, x in enumerate(positions)]


def of_file(trajectory):
    return infer(trajectory.sample(), trajectory.bits, trajectory.format)


def moving(atoms=40, frames=4, seed=0):
    random = np.random.default_rng(seed)
    start = random.uniform(-20, 20, (atoms, 3))
    return start + np.cumsum(random.normal(scale=0.05, size=(frames, atoms, 3)), axis=0)


@pytest.mark.parametrize(
    ("path", "topology", "kind", "step"),
    [
        (datafiles.XTC, datafiles.GRO, "grid", 0.01),
        pytest.param(datafiles.TRR, datafiles.GRO, "float32", 0.0, marks=pytest.mark.nightly),
        (datafiles.DCD, datafiles.PSF, "float32", 0.0),
        pytest.param(datafiles.GRO, None, "grid", 0.01, marks=pytest.mark.nightly),
        (datafiles.PDB_small, None, "grid", 0.001),
        # this one was made from text with three decimals, which its floats still show
        (datafiles.NCDF, datafiles.PRMncdf, "grid", 0.001),
        # six digits, LAMMPS's own format: 0.0963968 and 1.03170
        (datafiles.LAMMPSDUMP, None, "fractions", 1e-5),
        (datafiles.LAMMPSDUMP_image_vf, None, "grid", 1e-4),
    ],
)
def test_of_real_files(path, topology, kind, step):
    resolution = of_file(water() if path == datafiles.XTC else open_trajectory(path, topology))
    assert (resolution.kind, resolution.step) == (kind, pytest.approx(step))


def in_fractions(positions):
    return np.linalg.solve(TILTED.T, positions.reshape(-1, 3).T).T


def quantized(positions, step):
    return np.round(positions / step) * step


@settings(max_examples=120)
@given(
    st.sampled_from(["grid", "fractions", "digits", "float32", "float64"]),
    st.integers(0, 10**6),
    st.sampled_from([1, 12, 60, 200]),
    st.sampled_from([0.05, 0.02, 0.01, 0.005, 1e-3, 2e-4, 1e-4, 1e-6, 1e-9]),
    st.integers(5, 9),
    st.booleans(),
)
def test_what_was_done_to_the_numbers_is_found_and_bounds_every_distance(
    kind, seed, atoms, step, digits, narrow
):
    """Whatever the step and however few numbers; no distance is further off, and the bound no wider."""
    if kind in ("fractions", "digits"):
        step, atoms = 10.0 ** -(seed % 6 + 3), max(atoms, 40)
    true = moving(max(atoms, 12) if kind == "grid" else atoms, seed=seed)
    if kind == "grid":
        kept = quantized(true, step)
    elif kind == "fractions":
        kept = (quantized(in_fractions(true), step) @ TILTED).reshape(true.shape)
    elif kind == "digits":
        kept = np.vectorize(lambda x: float(f"{x:.{digits}g}"))(true)
        # numbers from 10 to 99 have two digits before the point
        step = 10.0 ** (2 - digits)
        assert infer(frames_of(np.round(true, digits - 2))).digits == 0
    else:
        kept, step = true.astype(kind), 0.0
    if (kind == "grid" and step >= 1e-4) or kind == "float32":
        # through float32, as nm
        kept = (kept / 10).astype(np.float32) * np.float32(10) if narrow else kept
    frames = frames_of(kept)
    resolution = infer(frames, bits=32 if narrow and kept.dtype == np.float32 else 64)
    assert resolution.kind == ("grid" if kind == "digits" else kind)
    assert (resolution.step, resolution.digits) == (pytest.approx(step), digits if kind == "digits" else 0)
    first, second = np.triu_indices(true.shape[1], 1)
    for frame, x in zip(frames, true, strict=True):
        off = np.linalg.norm(x[first] - x[second], axis=1) - np.linalg.norm(
            frame.positions[first] - frame.positions[second], axis=1
        )
        bound = resolution.bound(frame)
        assert np.abs(off).max(initial=0.0) <= bound
        if len(first) > 1000 and kind not in ("float64", "digits") and (step >= 1e-4 or kind == "float32"):
            # no wider than it has to be: the worst of so many comes within a factor of 4 (float: 12)
            assert np.abs(off).max() > bound / (12 if kind == "float32" or narrow else 4)
        if len(first) > 1000 and kind == "grid" and not narrow and step >= 1e-6:
            assert off.std() == pytest.approx((2 / 12) ** 0.5 * resolution.usual_step(frame), rel=0.25)


def test_the_sites_of_a_crystal_are_no_resolution():
    # a wall of 13,824 atoms that stand still, and one that moves
    wall = 2.5 * np.stack(np.meshgrid(*[np.arange(24.0)] * 3), -1).reshape(-1, 3)
    random = np.random.default_rng(0)
    frames = [wall.copy() for _ in range(5)]
    for frame in frames[1:]:
        frame[1] += random.normal(size=3)
    found = infer(frames_of(frames, 60 * np.eye(3)))
    assert found.kind == "float64" and found.moved
    still = infer(frames_of(frames[:1], 60 * np.eye(3)))
    assert still.kind == "grid" and not still.moved


def test_the_worst_case_is_met():
    # two atoms on the diagonal, half a step off in opposite directions
    frames = frames_of(np.round(moving(30), 2))
    assert infer(frames).bound(frames[0]) == pytest.approx(2 * np.sqrt(3) * 0.005, rel=1e-9)


def nearest_of(positions, length, k):
    """(whether each is among the k nearest of another at each frame, median distance of the last of them)."""
    found, reach = [], []
    for x in positions:
        d = x[:, None] - x[None]
        d -= length * np.rint(d / length)
        square = (d * d).sum(axis=2)
        np.fill_diagonal(square, np.inf)
        last = np.partition(square, k - 1, axis=1)[:, k - 1 : k]
        found.append((square <= last).ravel())
        reach.append(float(np.sqrt(np.median(last))))
    return np.array(found), reach[0]


@pytest.mark.parametrize(("k", "within"), [(None, 0.04), (4, 0.03), (12, 0.08)])
@STRIDES
def test_what_the_grid_of_an_xtc_does_to_flips(k, within, stride):
    # sigma = 1 Å and 0.001 nm: 43 % hidden and 57 % of those in the file made up, at every step
    positions, length = liquid(60 if stride == 1 else 20, 0.005, stride)
    kept, reach = quantized(positions, 0.01), CUTOFF
    if k is None:
        true, seen = memberships(positions, length), memberships(kept, length)
    else:
        (true, _), (seen, reach) = (nearest_of(x, length, k) for x in (positions, kept))
    missed, invented = missed_and_invented(true, seen)
    frames = frames_of(kept[:8], length * np.eye(3))
    resolution = infer(frames)
    assert resolution.step == 0.01
    effect = grid_effect(resolution, frames, reach, ranked=k is not None)
    assert effect is not None and missed > (0.1 if k else 0.35 if stride == 1 else 0)
    assert stride != 1 or k or invented > 0.5
    assert effect.missed == pytest.approx(missed, abs=within)
    assert effect.invented == pytest.approx(invented, abs=within)


@pytest.mark.parametrize("rule", [CutoffRule(CUTOFF), Nearest(4), Capped(CUTOFF, 12)])
def test_what_the_file_makes_up_is_marked_as_what_it_cannot_tell(rule):
    positions, length = liquid(20, 0.005, 4)
    true, kept = (frames_of(x, length * np.eye(3)) for x in (positions, quantized(positions, 0.01)))
    resolution = infer(kept)
    trackers = Tracker(rule), Tracker(rule)
    unmarked = invented = 0
    for one, other in zip(true, kept, strict=True):
        happened = trackers[0].step(one)
        seen = trackers[1].step(other, bound=resolution.bound(other) * (1 + rule.directed))
        known = set(zip(happened.i, happened.j, happened.entered, strict=True))
        for i, j, entered, ambiguous in zip(seen.i, seen.j, seen.entered, seen.ambiguous, strict=True):
            if (i, j, entered) not in known:
                invented += 1
                unmarked += not ambiguous
    assert invented > 50 and unmarked == 0


@pytest.mark.parametrize("speed", [0.0002, 0.001, 0.004, 0.1])
def test_what_rounding_adds_to_displacements_is_taken_off(speed):
    random = np.random.default_rng(0)
    start, velocity = random.uniform(0, 60, (20_000, 3)), speed * random.normal(size=(20_000, 3))
    frames = frames_of([quantized(start + k * velocity, 0.01) for k in range(8)], 60 * np.eye(3))
    effect = grid_effect(infer(frames), frames, CUTOFF, draws=1000)
    assert effect is not None and effect.move == pytest.approx(speed, rel=0.02 if speed > 0.001 else 0.05)


def test_doubles_hide_nothing():
    positions, length = liquid(20, 0.005, 4)
    frames = frames_of(positions, length * np.eye(3))
    resolution = infer(frames)
    effect = grid_effect(resolution, frames, CUTOFF)
    assert resolution.kind == "float64" and effect is not None
    assert effect.missed < 1e-6
    move = np.sqrt(((positions[1:] - positions[:-1]) ** 2).mean())
    assert effect.move == pytest.approx(move, rel=0.05)


def test_wrapping_is_no_motion():
    positions, length = liquid(20, 0.005, 4)
    kept = quantized(positions % length, 0.01)
    frames = frames_of(kept[:8], length * np.eye(3))
    plain = frames_of(quantized(positions, 0.01)[:8], length * np.eye(3))
    one, other = (grid_effect(infer(some), some, CUTOFF) for some in (frames, plain))
    assert one is not None and other is not None
    assert one.move == pytest.approx(other.move, rel=0.01)
    assert one.missed == pytest.approx(other.missed, abs=0.02)


def test_nothing_to_find_it_from():
    assert infer(frames_of(np.full((2, 3, 3), np.nan))).kind == "unknown"
    assert infer(frames_of(np.zeros((2, 3, 3)))).step == 0.0
    with pytest.raises(InputError, match="@5: leaves no frame"):
        of_file(open_trajectory(datafiles.GRO, slice="5:"))


def test_an_atom_at_the_origin_tells_nothing_of_what_a_file_keeps():
    some = frames_of(np.zeros((4, 1, 3)))
    found = infer(some)
    assert found.kind == "unknown" and not found.told
    # no warning either, of a division by a grid of steps of 0
    breathing = [
        replace(frame, box=Box((9 + 0.1 * k) * np.eye(3), np.ones(3, bool))) for k, frame in enumerate(some)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert grid_effect(found, breathing, 4.0) is None
    usual = of_file(open_trajectory(datafiles.GRO_huge_box))
    assert (usual.kind, usual.step, usual.told) == ("grid", 0.01, False)
    # told from numbers where there are any
    assert infer(frames_of(np.eye(3)[None].repeat(2, axis=0)), format="GRO").told


def test_of_a_real_xtc():
    oxygens = np.flatnonzero(water().species == "O")
    effect = grid_effect(of_file(water()), water().sample(), 3.5, oxygens)
    # 100 ps between two frames: everything has moved far
    assert effect is not None and effect.missed < 0.02 and effect.move > 1.0
    single = open_trajectory(datafiles.XTC, datafiles.GRO, slice="3")
    assert grid_effect(of_file(single), single.sample(), 3.5, oxygens) is None
