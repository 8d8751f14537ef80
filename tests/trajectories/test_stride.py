"""What is lost between frames: counts against loops, estimates against motion whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trajectories.membership import ledger, random_membership

from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.history import History
from mdnum.trajectories.stride import Strides, between_frames, crossings, doublings


def flips_of(inside: np.ndarray) -> int:
    return int((np.diff(inside.astype(int), axis=1) != 0).sum())


@given(st.integers(0, 10**6), st.integers(1, 9))
@settings(max_examples=30)
def test_flips_of_every_so_manieth_frame(seed: int, stride: int) -> None:
    inside, names = random_membership(seed)
    history = History.of(*ledger(inside, names), inside.shape[1])
    found = Strides.of_history(history, [1, stride])
    assert found.flips[1] == flips_of(inside[:, ::stride])
    assert found.of[1] == flips_of(inside[:, : (inside.shape[1] - 1) // stride * stride + 1])
    assert found.flips[0] == found.of[0] == flips_of(inside)
    doubled = found + found
    np.testing.assert_array_equal(doubled.flips, 2 * found.flips)


def test_strides_leave_four_intervals() -> None:
    assert doublings(1) == doublings(8) == [1]
    assert doublings(9) == [1, 2] and doublings(41) == [1, 2, 4, 8]


def history(inside: np.ndarray) -> History:
    return History.of(*ledger(inside, [(n, n + 1, 0) for n in range(len(inside))]), inside.shape[1])


def test_smooth_motion_tells_what_lies_between_its_frames() -> None:
    """Distances that swing with a few frequencies; the truth is the same motion at 32 times the frames."""
    rng = np.random.default_rng(2)
    fine = np.arange(0, 32 * 120) / 32
    phases, rates = rng.uniform(0, 2 * np.pi, (300, 4, 1)), rng.uniform(0.2, 1.6, (300, 4, 1))
    distance = np.sum(np.cos(rates * fine + phases), axis=1)
    inside = distance < 1.0
    found = between_frames(Strides.of_history(history(inside[:, ::32]), doublings(120)))
    truth = 1 - flips_of(inside[:, ::32]) / flips_of(inside)
    assert found is not None and found.lost is not None
    assert 0.01 < truth < 0.2
    assert found.low is not None and found.high is not None
    assert found.low <= truth <= found.high and truth / 3 < found.lost < 3 * truth


def test_brownian_motion_has_no_number_between_its_frames_and_is_told_so() -> None:
    rng = np.random.default_rng(3)
    inside = np.cumsum(rng.normal(size=(1500, 200)), axis=1) < 0
    found = between_frames(Strides.of_history(history(inside), doublings(200)))
    assert found is not None and found.lost is None and found.high is None and found.doubled > 0.2
    assert "does not die out" in found.says


def test_a_liquid_tells_what_lies_between_its_frames() -> None:
    """Flips left at strides 1, 2, 4, ... of argon/liquid-864, 10,000 steps of 2 fs, as mdnum counted them."""
    left = [218131, 218111, 218089, 217979, 217609, 215709, 209961, 191843, 154071, 109495, 72569]
    of = [218131, 218131, 218131, 218131, 218131, 217773, 217773, 217773, 217773, 212205, 201009]
    share = np.array(left) / np.array(of)
    for start in (4, 5, 6):
        # the run as a file with every 16th, 32nd or 64th step would hold it
        kept = np.round(1e6 * share[start : start + 4] / share[start]).astype(int)
        found = between_frames(Strides(np.array([1, 2, 4, 8]), kept, np.full(4, 10**6), np.zeros(4, int)))
        truth = 1 - share[start]
        assert found is not None and None not in (found.lost, found.low, found.high)
        assert found.low < truth < found.high
        assert found.lost == pytest.approx(truth, rel=0.25)
    # and where flips are few and the loss is small, it says so
    none = np.zeros(4, int)
    few = between_frames(Strides(np.array([1, 2, 4, 8]), np.array(left[:4]), np.array(of[:4]), none))
    assert few is not None and few.lost is not None and few.lost < 1e-3


def test_every_range_has_a_width_that_holds_the_truth_with_three_strides_and_with_few_flips() -> None:
    """Shares of liquid argon's flips at strides 1, 2 and 4 of every 64th step, where 3.7 % were lost."""
    for flips in (10**6, 43_000, 3_000):
        kept = np.round(flips * np.array([1.0, 0.9132, 0.7301])).astype(int)
        found = between_frames(Strides(np.array([1, 2, 4]), kept, np.full(3, flips), np.zeros(3, int)))
        assert found is not None and None not in (found.lost, found.low, found.high)
        assert found.low < 0.037 < found.high < 0.2 and found.low < found.lost < found.high
    nothing = between_frames(Strides(np.array([1, 2, 4]), *np.array([[90] * 3, [90] * 3, [0] * 3])))
    assert nothing is not None and nothing.lost == 0.0 and 0.0 < nothing.high < 0.2


def hovering(rng: np.random.Generator, grid: float) -> tuple[History, int]:
    """Pairs in smooth slow motion, read with and without rounding to a grid; and the flips that happened."""
    time = np.arange(200) / 16
    phases, rates = rng.uniform(0, 2 * np.pi, (400, 4, 1)), rng.uniform(0.2, 1.6, (400, 4, 1))
    distance = 5.0 + np.sum(np.cos(rates * time + phases), axis=1)
    seen = distance + rng.uniform(-grid / 2, grid / 2, distance.shape)
    inside = seen < 6.0
    flips, first = ledger(inside, [(n, n + 1, 0) for n in range(len(inside))])
    near = np.abs(seen - 6.0) <= grid / 2
    # decided by the file: neither end of the flip is further from the threshold than the grid reaches
    unsure = near[flips.i, flips.frame] | near[flips.i, flips.frame - 1]
    return History.of(replace(flips, ambiguous=unsure), first, 200), flips_of(distance < 6.0)


def test_chatter_within_the_digits_of_a_file_is_not_told_as_motion_between_its_frames() -> None:
    rng = np.random.default_rng(11)
    found, happened = hovering(rng, 0.3)
    assert len(found.frame) > 1.2 * happened  # rounding made flips up
    strides = Strides.of_history(found, doublings(200))
    said = between_frames(strides)
    assert said is not None and said.lost is None and said.low is None and "digits" in said.says
    # a grid that is fine for the same motion takes nothing from the number
    fine, happened = hovering(np.random.default_rng(11), 1e-9)
    said = between_frames(Strides.of_history(fine, doublings(200)))
    assert said is not None and said.lost is not None and said.lost < 0.01
    # and the count of what rounding may have made adds up over parts of the pairs
    np.testing.assert_array_equal((strides + strides).doubtful, 2 * strides.doubtful)


def test_too_few_frames_or_no_flips_say_nothing() -> None:
    inside, names = random_membership(5, frames=8)
    one = History.of(*ledger(inside, names), 8)
    assert between_frames(Strides.of_history(one, doublings(8))) is None
    still = History.of(*ledger(np.ones((3, 40), bool), [(0, 1, 0), (0, 2, 0), (1, 2, 0)]), 40)
    assert between_frames(Strides.of_history(still, doublings(40))) is None


def test_the_flux_of_an_ideal_gas_is_the_closed_form() -> None:
    """Points with Gaussian velocities cross r_cut at the rate pairs x 4 pi r² <|v_n|> / volume."""
    rng = np.random.default_rng(7)
    side, atoms, r_cut = 12.0, 1_500, 3.0
    frame = Frame(
        0, 0.0, rng.uniform(0, side, (atoms, 3)), Box(np.eye(3) * side, np.ones(3, bool)),
        rng.normal(size=(atoms, 3)),
    )  # fmt: skip

    def count(one: Frame, other: Frame) -> int:
        sets = []
        for positions in (one.positions, other.positions):
            apart = positions[:, None] - positions[None]
            apart -= side * np.round(apart / side)
            sets.append(np.sum(apart**2, axis=2) < r_cut**2)
        return int(np.triu(sets[0] ^ sets[1], 1).sum())

    found = crossings(frame, count, 0.02)
    assert found is not None
    flips, moment = found
    pairs = atoms * (atoms - 1) / 2
    # the radial part of the difference of two velocities has variance 2
    expected = pairs * 4 * np.pi * r_cut**2 / side**3 * np.sqrt(2) * np.sqrt(2 / np.pi)
    assert flips / moment == pytest.approx(expected, rel=0.1)
    assert moment == pytest.approx(0.02 / np.sqrt(3), rel=0.05)
    resting = Frame(0, 0.0, frame.positions, frame.box, np.zeros_like(frame.positions))
    assert crossings(resting, count, 0.02) is None
    assert crossings(Frame(0, 0.0, frame.positions, frame.box), count, 0.02) is None
