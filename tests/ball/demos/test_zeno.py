"""The time to rest against a sum of fifty-digit flights, and the fixed steps against a plain loop."""

from __future__ import annotations

import mpmath
import pytest
from mpmath import mpf

from mdnum.ball import demos

G, E = 9.81, 0.8


def to_rest(y0, e, impacts=2000):
    """Time of an impact far beyond what double precision resolves, added up flight by flight."""
    g = mpf(G)
    speed = mpmath.sqrt(2 * g * y0)
    time = speed / g
    for _ in range(impacts):
        speed = e * speed
        time += 2 * speed / g
    return time


def chatter(h: float, time: float) -> tuple[int, float]:
    """Contacts and last speeds of a ball put back on the floor at the end of the step."""
    y, v, contacts, speeds = 1.0, 0.0, 0, []
    for _ in range(round(time / h)):
        v = v - h * G
        y = y + h * v
        if y < 0:
            y, v, contacts = 0.0, -E * min(v, 0.0), contacts + 1
        speeds.append(abs(v))
    return contacts, max(speeds[-100:])


def test_one_program_rests_and_the_other_never_does():
    demo = demos.run("zeno")
    assert [check.what for check in demo.checks if not check.ok] == []
    numbers = demo.numbers
    with mpmath.workdps(50):
        exact = to_rest(mpf(1), mpf(E))
        assert abs(numbers["rest_time"] - exact) < 4e-15
        # stopped at 1e-12 m/s the last flights are missing: 2 v / (g (1 - e)) at most
        assert 0 < exact - numbers["rest_time_located"] < 2e-12 / (G * (1 - E))
        by_y0 = mpmath.diff(lambda y: to_rest(y, mpf(E)), 1)
        by_e = mpmath.diff(lambda e: to_rest(mpf(1), e), mpf(E))
    assert numbers["rest_by_y0"] == pytest.approx(float(by_y0), rel=1e-13)
    assert numbers["rest_by_restitution"] == pytest.approx(float(by_e), rel=1e-13)
    assert numbers["rest_by_y0_located"] == pytest.approx(float(by_y0), rel=1e-6)
    assert numbers["rest_by_restitution_located"] == pytest.approx(float(by_e), rel=1e-6)
    assert round(numbers["rest_time"], 4) == 4.0637
    for h in ("0.01", "0.001"):
        contacts, speed = chatter(float(h), 8)
        assert numbers["contacts_in_fixed_steps"][h] == contacts
        assert numbers["speed_left_in_fixed_steps"][h] == pytest.approx(speed, rel=1e-9)
    # the speed with which a ball chatters: v = e (h g - v)
    assert numbers["speed_left_in_fixed_steps"]["0.01"] == pytest.approx(E / (1 + E) * 0.01 * G, rel=1e-9)
