"""The quantized-state demonstration against a plain loop in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.demos import Demo, run
from mdnum.ball.demos.quantized_state import BALLS, BITS, SPAN, STEPS, H, K, control, heights


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("quantized-state")


def contacts(bits=0, k=K, shaken=None):
    """The balls, an operation at a time, their state on a grid of 2^bits values."""
    y, v, rows = heights(), np.zeros(BALLS), []
    for u in control() if shaken is None else shaken:
        touching = y < 0
        v = v + H * (-9.81 + u + np.where(touching, -k * y, 0.0))
        y = y + H * v
        if bits:
            for x, span in ((y, SPAN["y"]), (v, SPAN["v"])):
                scale = 2 * span / 2**bits
                x[:] = np.clip(np.rint(x / scale), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) * scale
        rows.append(touching)
    return np.array(rows)


def first(a, b):
    differ = a != b
    return float(np.median(np.where(differ.any(axis=0), differ.argmax(axis=0), STEPS)))


def test_every_check_holds(demo: Demo):
    assert [(check.what, check.seen) for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 5


def test_the_horizons_are_those_of_a_loop(demo: Demo):
    reference = contacts()
    for bits in (8, 16):
        seen = demo.data["horizons"]["state"][BITS.index(bits)]
        # the forces are added in another order: a ball may flip a few steps earlier or later
        assert seen == pytest.approx(first(contacts(bits), reference), rel=0.1, abs=5)
    at = BITS.index(12)
    found = demo.data["horizons"]
    coarse = np.rint(K / (2 * SPAN["parameter"] / 2**12)) * (2 * SPAN["parameter"] / 2**12)
    assert found["parameter"][at] == pytest.approx(first(contacts(k=coarse), reference), rel=0.1)
    scale = 2 * SPAN["input"] / 2**12
    shaken = np.rint(control() / scale) * scale
    assert found["input"][at] == pytest.approx(first(contacts(shaken=shaken), reference), rel=0.1)


def test_a_bit_of_state_buys_a_doubling(demo: Demo):
    assert 50 < demo.numbers["steps_per_bit"] < 250
    assert demo.numbers["steps_per_doubling"] == pytest.approx(demo.numbers["steps_per_bit"], rel=1.0)
    horizons = demo.data["horizons"]["state"]
    assert horizons == sorted(horizons) and horizons[0] < 200 < 1000 < horizons[-1]
    assert demo.numbers["lattice_returns"] is True
