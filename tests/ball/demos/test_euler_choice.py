"""The two Eulers against a plain loop, differentiated by differences of the loop."""

from __future__ import annotations

import pytest

from mdnum.ball import demos

# the whole demonstration is run
pytestmark = pytest.mark.slow

G, STEPS, H = 9.81, 200, 0.01


def height(y0: float, k: float, *, old: bool) -> tuple[float, int]:
    """Height at the end and the step of the first contact; moves with the old or with the new velocity."""
    y, v, first = y0, 0.0, -1
    for step in range(STEPS):
        a = -G - (k * y if y < 0 else 0.0)
        if y < 0 and first < 0:
            first = step + 1
        before, v = v, v + H * a
        y = y + H * (before if old else v)
    return y, first


def test_two_programs_have_two_gradients():
    demo = demos.run("euler-choice")
    assert demo.ok, [check for check in demo.checks if not check.ok]
    numbers = demo.numbers
    for name, old in (("explicit", True), ("semi_implicit", False)):
        shift = 1e-6
        by_y0 = (height(1 + shift, 100, old=old)[0] - height(1 - shift, 100, old=old)[0]) / (2 * shift)
        by_k = (height(1, 100 + shift, old=old)[0] - height(1, 100 - shift, old=old)[0]) / (2 * shift)
        assert numbers[f"dy_dy0_{name}"] == pytest.approx(by_y0, rel=1e-7)
        assert numbers[f"dy_dk_{name}"] == pytest.approx(by_k, rel=1e-5)
        assert numbers[f"first_contact_{name}"] == height(1, 100, old=old)[1]
    found = [numbers[f"dy_dy0_{name}"] for name in ("explicit", "semi_implicit", "exact")]
    assert [round(x, 2) for x in found] == [3.73, -2.97, -2.69]
    assert [numbers["first_contact_explicit"], numbers["first_contact_semi_implicit"]] == [47, 46]
