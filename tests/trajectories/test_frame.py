"""What no simulation writes into a frame, and what one may well write."""

from __future__ import annotations

import ase.io
import numpy as np
import pytest
from ase import Atoms
from trajectories.files import checked

import mdnum
from mdnum.trajectories.frame import Box, Frame, FrameError, far_out, leap
from mdnum.trajectories.rules import CutoffRule, Nearest, SpeciesCutoffs, smallest_radius


def frames(spoil=lambda k, x: None, pbc=lambda k: True):
    random = np.random.default_rng(0)
    for k in range(4):
        x = random.normal(size=(6, 3))
        spoil(k, x)
        yield Frame(10 * k, float(k), x, Box(9 * np.eye(3), np.full(3, pbc(k))))


def put(number, rows, value):
    def spoil(k, x):
        if k == number:
            x[rows] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (put(2, slice(4, 5), np.nan), r"frame 20: atom 4 is at \(nan, nan, nan\)"),
        (put(2, (slice(1, 4), 2), -np.inf), r"frame 20: atom 1 .*-inf\), and 2 others"),
        (put(2, slice(None), 0.0), "frame 20: all coordinates are 0"),
        (put(2, slice(3, 5), 0.0), "frame 20: atom 3 .* 0, 0, 0, and 1 other"),
        (None, "frame 20 has no box"),
    ],
)
def test_frame_and_atom_are_named(spoil, said):
    seen = []
    with pytest.raises(FrameError, match=said) as caught:
        for frame in checked(frames(pbc=lambda k: k != 2) if spoil is None else frames(spoil)):
            seen.append(frame.index)
    assert seen == [0, 10] and caught.value.frame == 20


@pytest.mark.parametrize(
    ("rows", "value", "atoms"),
    [
        (slice(0), 0.0, None),
        # one atom may be at the origin, and what is not looked at may be anywhere
        (slice(4, 5), 0.0, None),
        (slice(4, 5), np.nan, np.array([0, 1, 2])),
        # large, but a place
        (slice(4, 5), 1e5, None),
    ],
)
def test_what_is_fine_is_not_refused(rows, value, atoms):
    assert len(list(checked(frames(put(2, rows, value)), atoms))) == 4


def test_a_box_without_a_vector_is_named_with_its_frame():
    boxes = [Box(np.diag([9.0, 9.0, 9.0 - k]), np.ones(3, bool)) for k in (0, 9)]
    some = [Frame(90 * k, 0.0, np.ones((1, 3)), box) for k, box in enumerate(boxes)]
    said = r"run\.traj: frame 90: .*along c, but .* 0\.0\]"
    with pytest.raises(FrameError, match=said) as caught:
        list(checked(some, where="run.traj"))
    assert caught.value.frame == 90
    # a direction that does not repeat needs none
    slab = Box(np.diag([9.0, 9.0, 0.0]), np.array([True, True, False]))
    assert len(list(checked([Frame(0, 0.0, np.ones((1, 3)), slab)]))) == 1


def test_the_first_frame_cannot_be_left_out():
    with pytest.raises(FrameError, match="frame 0: atom 4") as caught:
        list(checked(frames(put(0, slice(4, 5), np.nan))))
    assert caught.value.frame == 0 and "@:0" not in str(caught.value)


def gas(side: float | None = 20.0, atoms: int = 60) -> Frame:
    x = np.random.default_rng(3).uniform(0, 20.0, (atoms, 3))
    return Frame(4, 4.0, x, Box() if side is None else Box(np.eye(3) * side, np.ones(3, bool)))


def moved(frame: Frame, atom: int, to: tuple[float, float, float]) -> Frame:
    x = frame.positions.copy()
    x[atom] = to
    return Frame(frame.index, frame.time, x, frame.box)


@pytest.mark.parametrize("side", [20.0, None])
@pytest.mark.parametrize("place", [(1e30, 2.0, 3.0), (2.0, -3e38, 3.0), (2.0, 3.0, 1e9)])
def test_an_atom_that_no_simulation_puts_there_is_named(side, place):
    frame = moved(gas(side), 17, place)
    with pytest.raises(FrameError, match="frame 4: atom 17 is at") as caught:
        list(checked([frame]))
    assert caught.value.frame == 4
    # two of them, and one that nobody asked about
    with pytest.raises(FrameError, match=r"atom 17 .*, and 1 other likewise"):
        list(checked([moved(frame, 2, (0.9 * place[0], 0.9 * place[1], 0.9 * place[2]))]))
    assert len(list(checked([frame], np.arange(10)))) == 1


def test_what_does_fly_off_drifts_or_was_never_wrapped_is_left_alone():
    for side, far in ((20.0, 1e5), (None, 1e6)):
        here = gas(side)
        assert far_out(moved(here, 5, (far, 0.0, 0.0))) is None
        # all of them together, in a box and out of it
        drifted = Frame(0, 0.0, here.positions + 3e7, here.box)
        assert far_out(drifted) is None and leap(here, drifted) is None
    assert far_out(Frame(0, 0.0, np.zeros((1, 3)), Box())) is None
    assert far_out(Frame(0, 0.0, np.array([[0.0, 0, 0], [1e9, 0, 0]]), Box())) is None


def test_floats_that_tell_no_distance_there_are_said_to():
    drifted = gas()
    drifted = Frame(0, 0.0, drifted.positions + 3e7, drifted.box)
    assert far_out(drifted, radius=2.5, bits=64) is None
    found = far_out(drifted, radius=2.5, bits=32)
    assert found is not None and "float32" in found[2] and found[1] == 60
    # the shortest of every rule's own radii, wherever it is written
    for radii in ({("A", "B"): 2.0, ("A", "A"): 6.0}, {("A", "A"): 6.0, ("A", "B"): 2.0}):
        assert smallest_radius([Nearest(3), CutoffRule(4.0), SpeciesCutoffs(radii)]) == 2.0
    assert smallest_radius([Nearest(3)]) == np.inf


def test_a_leap_is_told_and_wrapping_is_none(tmp_path):
    here = gas()
    found = leap(here, moved(here, 9, (5e3, 0.0, 0.0)))
    assert found is not None and found[0] == 9
    assert leap(here, moved(here, 9, (5e3, 0.0, 0.0)), np.arange(9)) is None
    assert leap(here, moved(here, 9, (600.0, 0.0, 0.0))) is None
    frames = [Atoms("Ar60", here.positions, cell=[20.0] * 3, pbc=True) for _ in range(5)]
    frames[3].positions[9] = [1e5, 1.0, 1.0]
    ase.io.write(tmp_path / "a.traj", frames)
    found = mdnum.flips(tmp_path / "a.traj", cutoffs=[4.0], out=tmp_path / "f", report=False).summary
    assert found["leaps"] == {"frames": 2, "frame": 3, "atom": 9, "distance": pytest.approx(1e5, rel=1e-3)}
    said = next(one for one in found["findings"] if one["code"] == "LEAP")
    assert said["severity"] == "warning" and "at frame 3" in said["title"] and "atom 9" in said["text"]
