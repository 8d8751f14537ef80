"""What is lost between frames, against systems whose every step is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from trajectories.membership import ledger, random_membership

from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.history import History, Strides, doublings
from mdnum.trajectories.lost import FrameMotion, lost_flips
from mdnum.trajectories.resolution import infer


def flips_of(inside: np.ndarray) -> int:
    return int((np.diff(inside.astype(int), axis=1) != 0).sum())


def history_of(inside: np.ndarray) -> History:
    return History.of(*ledger(inside, [(n, n + 1, 0) for n in range(len(inside))]), inside.shape[1])


def test_smooth_motion_tells_what_lies_between_its_frames() -> None:
    """Distances that swing with a few frequencies; the truth is the same motion at 32 times the frames."""
    rng = np.random.default_rng(2)
    fine = np.arange(0, 32 * 120) / 32
    phases, rates = rng.uniform(0, 2 * np.pi, (300, 4, 1)), rng.uniform(0.2, 1.6, (300, 4, 1))
    distance = np.sum(np.cos(rates * fine + phases), axis=1)
    inside = distance < 1.0
    found = lost_flips(Strides.of_history(history_of(inside[:, ::32]), doublings(120)))
    truth = 1 - flips_of(inside[:, ::32]) / flips_of(inside)
    assert found is not None and found.lost is not None
    assert 0.01 < truth < 0.2
    assert found.low is not None and found.high is not None
    assert found.low <= truth <= found.high and truth / 3 < found.lost < 3 * truth


def test_what_brownian_motion_loses_has_no_number_and_that_is_said() -> None:
    rng = np.random.default_rng(3)
    inside = np.cumsum(rng.normal(size=(1500, 200)), axis=1) < 0
    found = lost_flips(Strides.of_history(history_of(inside), doublings(200)))
    assert found is not None and found.lost is None and found.high is None and found.doubled > 0.2
    assert found.reason == "open"


def test_a_liquid_tells_what_lies_between_its_frames() -> None:
    """Flips left at strides 1, 2, 4, ... of argon/liquid-864, 10,000 steps of 2 fs, as mdnum counted them."""
    left = [218131, 218111, 218089, 217979, 217609, 215709, 209961, 191843, 154071, 109495, 72569]
    of = [218131, 218131, 218131, 218131, 218131, 217773, 217773, 217773, 217773, 212205, 201009]
    share = np.array(left) / np.array(of)
    for start in (4, 5, 6):
        # the run as a file with every 16th, 32nd or 64th step would hold it
        kept = np.round(1e6 * share[start : start + 4] / share[start]).astype(int)
        found = lost_flips(Strides(np.array([1, 2, 4, 8]), kept, np.full(4, 10**6), np.zeros(4, int)))
        truth = 1 - share[start]
        assert found is not None and None not in (found.lost, found.low, found.high)
        assert found.low < truth < found.high
        assert found.lost == pytest.approx(truth, rel=0.25)
    # and where flips are few and the loss is small, it says so
    none = np.zeros(4, int)
    few = lost_flips(Strides(np.array([1, 2, 4, 8]), np.array(left[:4]), np.array(of[:4]), none))
    assert few is not None and few.lost is not None and few.lost < 1e-3


def test_every_range_has_a_width_that_holds_the_truth_with_three_strides_and_with_few_flips() -> None:
    """Shares of liquid argon's flips at strides 1, 2 and 4 of every 64th step, where 3.7 % were lost."""
    for flips in (10**6, 43_000, 3_000):
        kept = np.round(flips * np.array([1.0, 0.9132, 0.7301])).astype(int)
        found = lost_flips(Strides(np.array([1, 2, 4]), kept, np.full(3, flips), np.zeros(3, int)))
        assert found is not None and None not in (found.lost, found.low, found.high)
        assert found.low < 0.037 < found.high < 0.2 and found.low < found.lost < found.high
    nothing = lost_flips(Strides(np.array([1, 2, 4]), *np.array([[90] * 3, [90] * 3, [0] * 3])))
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
    said = lost_flips(strides)
    assert said is not None and said.lost is None and said.low is None and said.reason == "rounding"
    # a grid that is fine for the same motion takes nothing from the number
    fine, happened = hovering(np.random.default_rng(11), 1e-9)
    said = lost_flips(Strides.of_history(fine, doublings(200)))
    assert said is not None and said.lost is not None and said.lost < 0.01
    # and the count of what rounding may have made adds up over parts of the pairs
    np.testing.assert_array_equal((strides + strides).doubtful, 2 * strides.doubtful)


def test_too_few_frames_or_no_flips_say_nothing() -> None:
    inside, names = random_membership(5, frames=8)
    one = History.of(*ledger(inside, names), 8)
    assert lost_flips(Strides.of_history(one, doublings(8))) is None
    still = History.of(*ledger(np.ones((3, 40), bool), [(0, 1, 0), (0, 2, 0), (1, 2, 0)]), 40)
    assert lost_flips(Strides.of_history(still, doublings(40))) is None


STEP = 0.02


def walkers(friction: float, steps: int = 1600, atoms: int = 40):
    """(positions, velocities, box, cutoff): particles whose velocities decay and are kicked at each step."""
    rng, side, keep = np.random.default_rng(0), 7.0, math.exp(-friction * STEP)
    v, x = np.empty((2, steps + 1, atoms, 3))
    v[0], x[0] = rng.normal(size=(atoms, 3)), rng.uniform(0, side, (atoms, 3))
    for n in range(steps):
        v[n + 1] = keep * v[n] + math.sqrt(1 - keep**2) * rng.normal(size=(atoms, 3))
        x[n + 1] = x[n] + 0.5 * STEP * (v[n] + v[n + 1])
    return x, v, side, 2.0


def solid(steps: int = 1600):
    """Atoms that swing about the sites of a crystal, whose second shell is at the cutoff."""
    rng = np.random.default_rng(0)
    sites = np.stack(np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij"), -1).reshape(1, -1, 3)
    time, rates = STEP * np.arange(steps + 1)[:, None, None, None], rng.uniform(1, 7, (5, 64, 3))
    swing = 0.05 * np.exp(1j * (rates * time + rng.uniform(0, 2 * np.pi, rates.shape)))
    return sites + swing.real.sum(axis=1), (1j * rates * swing).real.sum(axis=1), 4.0, 2**0.5


SYSTEMS = {
    "ideal gas": lambda: walkers(0.0),
    "damped gas": lambda: walkers(1.0),
    "more damped gas": lambda: walkers(4.0),
    "crystal": solid,
}


def within(x: np.ndarray, side: float, radius: float) -> np.ndarray:
    """Which pairs are inside at each step, (pairs, steps)."""
    i, j = np.triu_indices(x.shape[1], 1)
    apart = x[:, i] - x[:, j]
    apart -= side * np.rint(apart / side)
    return (np.einsum("nki,nki->nk", apart, apart) < radius**2).T


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_range_holds_what_planted_systems_lose(name: str) -> None:
    """Of every nth step as a file would have it, wrapped, with and without velocities."""
    x, v, side, radius = SYSTEMS[name]()
    inside, box, factors = within(x, side, radius), Box(side * np.eye(3), np.ones(3, bool)), []
    for stride in (1, 3, 10, 25, 60):
        frames, seen = range(0, len(x), stride), inside[:, ::stride]
        truth = 1 - flips_of(seen) / flips_of(inside[:, : frames[-1] + 1])
        strides = Strides.of_history(history_of(seen), doublings(len(frames)))
        for velocities in (v, [None] * len(v)):
            sample = [Frame(n, n * STEP, x[n] % side, box, velocities[n]) for n in frames[:8]]
            motion = FrameMotion.of(sample, infer(sample))
            found = lost_flips(strides, motion, reach=radius)
            assert found is not None and motion is not None
            assert math.isfinite(motion.moved) == (velocities is v)
            if found.lost is not None:
                assert found.low <= truth <= found.high, stride
                factors.append(max(found.lost, 1e-3) / max(truth, 1e-3))
    assert len(factors) >= 6 and np.median(np.exp(np.abs(np.log(factors)))) < 1.6
