"""The integer ball against Python's integers."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.lattice import LatticeBall
from mdnum.errors import InputError

H, K = 0.01, 1234.5
CONTROL = 2.0 * np.sin(np.arange(700) * 0.1)


def python_run(y, v, bits):
    """The same ball in integers without a size."""
    h, push = round(H * 2**24), round(H * K * 2**24)
    contacts = []
    for u in CONTROL:
        contacts.append(y < 0)
        v += int(np.rint((u - 9.81) * H * 2**bits)) - ((y * push >> 24) if y < 0 else 0)
        y += v * h >> 24
    return y, v, contacts


@pytest.mark.parametrize("bits", [12, 32])
def test_the_bits_are_those_of_pythons_integers(bits):
    ball = LatticeBall.create(K, H, CONTROL, bits=bits)
    start = ball.start([0.3, 0.7, 1.1], -0.5)
    end, contact = ball.run(start)
    for k in range(3):
        y, v, contacts = python_run(int(start.y[k]), int(start.v[k]), bits)
        assert (int(end.y[k]), int(end.v[k])) == (y, v)
        assert np.asarray(contact)[:, k].tolist() == contacts
    assert np.asarray(contact).any(axis=0).all()


def test_a_run_taken_back_returns_every_bit():
    ball = LatticeBall.create(K, H, CONTROL)
    start = ball.start(np.linspace(0.1, 2.0, 50))
    end, _ = ball.run(start)
    back = ball.rewind(end)
    assert np.array_equal(back.y, start.y) and np.array_equal(back.v, start.v)
    assert not np.array_equal(end.y, start.y)


def test_it_follows_the_ball_in_floats_for_a_while():
    ball = LatticeBall.create(K, H, CONTROL[:150], bits=34, deepest=0.5)
    end, _ = ball.run(ball.start(0.8))
    y, v = 0.8, 0.0
    for u in CONTROL[:150]:
        v = v + H * (-9.81 + u + (-K * y if y < 0 else 0.0))
        y = y + H * v
    assert ball.meters(end.y)[0] == pytest.approx(y, abs=1e-5)
    assert ball.meters(end.v)[0] == pytest.approx(v, abs=1e-4)


def test_what_64_bits_cannot_hold_is_refused():
    with pytest.raises(InputError, match="40 bits and numbers up to 1 overflow"):
        LatticeBall.create(K, H, CONTROL, bits=40)
    with pytest.raises(InputError, match="h is below the lattice"):
        LatticeBall.create(K, 1e-9, CONTROL)
