"""The energies of the stiffness demonstration against a plain loop, and the map's three classes."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball import demos

# the whole demonstration is run
pytestmark = pytest.mark.slow

G, H = 9.81, 0.01


def energy(z: float, steps: int, *, old: bool) -> float:
    """Largest E / E(0) of a ball from 1 m by a plain loop; moves with the old or with the new velocity."""
    k = (z / H) ** 2
    y, v, most = 1.0, 0.0, 0.0
    for _ in range(steps):
        a = -G - (k * y if y < 0 else 0.0)
        before, v = v, v + H * a
        y = y + H * (before if old else v)
        most = max(most, G * y + v * v / 2 + (k * y * y / 2 if y < 0 else 0.0))
    return most / G


def test_a_stable_ball_loses_its_derivative():
    demo = demos.run("stiffness")
    assert [check.what for check in demo.checks if not check.ok] == []
    numbers = demo.numbers
    for name, old in (("energy_semi_implicit", False), ("energy_explicit", True)):
        for z, seen in numbers[name].items():
            # chaos: the bits of the loop and of the program are not the same for long
            assert seen == pytest.approx(energy(float(z), 600, old=old), rel=0.05), (name, z)
    assert {z: round(e, 1) for z, e in numbers["energy_explicit"].items()} == {
        "0.03": 1.7,
        "0.32": 22.7,
        "1.0": 272.1,
    }
    assert numbers["limit"] == 2
    assert 0.1 < numbers["first_unbounded_gradient"] < 0.5
    assert numbers["gradient_overflows_at_step"] < 40_000
    region = demo.plots[0].region
    assert region is not None
    assert region.value.shape == (len(region.y), len(region.x))
    # below a tenth of the limit everything is bounded, above the limit nothing is
    last = region.value[-1]
    assert set(last[region.x < 0.15]) == {0}
    assert set(last[region.x > 2.1]) == {2}
    assert np.mean(last[(region.x > 0.4) & (region.x < 1.3)] == 1) > 0.8
