"""The hysteresis demonstration against loops in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.demos import Demo, run
from mdnum.ball.demos import hysteresis as h

# the whole demonstration is run
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("hysteresis")


def shaken(lift: float) -> int:
    """Contact flips of the shaken balls, an operation at a time."""
    noise = h.SHAKE * np.random.default_rng(0).normal(size=(h.STEPS, h.BALLS))
    y, v = np.full(h.BALLS, -9.81 / h.STIFFNESS), np.zeros(h.BALLS)
    touching, flips = y < 0, 0
    for step in range(h.STEPS):
        now = np.where(touching, y <= lift, y < 0)
        flips += int(np.sum(now != touching))
        touching = now
        push = np.where(now, h.STIFFNESS * -y - h.DAMPING * v, 0.0)
        v = v + h.H * ((noise[step] - 9.81) + push)
        y = y + h.H * v
    return flips


def pressed(reverse: bool, gap: float) -> list[int]:
    """Iterations of each step, with the sum made in float16 term by term."""
    f16, f32 = np.float16, np.float32
    noise = h.WAVER * np.random.default_rng(1).normal(size=(h.PRESSED_STEPS, h.PRESSED))
    free = noise.astype(f32) - f32(h.G)
    tol, enter, counts = f16(h.TOL), f16(gap * h.TOL), []
    for step in range(h.PRESSED_STEPS):
        y, it = f32(h.PRESSED_H) * (f32(h.PRESSED_H) * free[step]), 0
        while True:
            depth = np.maximum(-y, f32(0)).astype(f16)
            total = f16(0)
            for one in depth[::-1] if reverse else depth:
                total = f16(total + one)
            if total < (enter if it == 0 else tol) or it == 50:
                break
            y, it = y + f32(0.25) * np.maximum(-y, f32(0)), it + 1
        counts.append(it)
    return counts


def test_every_check_holds(demo: Demo) -> None:
    assert [check.what for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 8


@pytest.mark.parametrize("lift", [0.0, 0.01])
def test_contact_flips_are_those_of_a_loop(demo: Demo, lift: float) -> None:
    assert demo.data["contact_flips"][str(lift)] == shaken(lift)


def test_the_solver_starts_and_disagrees_where_a_loop_does(demo: Demo) -> None:
    plain = [pressed(reverse, 1.0) for reverse in (False, True)]
    started = np.array(plain[0]) > 0
    assert demo.numbers["stop_flips_without"] == int(np.sum(started[1:] != started[:-1]))
    assert (
        demo.numbers["orders_disagree_without"] == int(np.sum(np.array(plain[0]) != np.array(plain[1]))) > 0
    )
    assert not any(pressed(False, 1.05))
    assert demo.numbers["stop_flips_with"] == demo.numbers["orders_disagree_with"] == 0
