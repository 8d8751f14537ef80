"""The determinism demonstration and the run-twice check behind it."""

from __future__ import annotations

import dataclasses
import platform
from pathlib import Path

import jax
import numpy as np
import pytest

from mdnum.ball.contacts import Impact
from mdnum.ball.demos import run
from mdnum.ball.demos.determinism import START, STEPS
from mdnum.ball.determinism import fingerprint, require_deterministic
from mdnum.ball.integrators import SemiImplicitEuler
from mdnum.ball.problem import Problem
from mdnum.ball.world import World
from mdnum.errors import InputError, NumericalError

# the whole demonstration is run
pytestmark = pytest.mark.slow

G, H, E = 9.81, 0.01, 0.8


def first_contact(y: float) -> int:
    v, a = 0.0, -G
    for step in range(1, 100):
        v = v + H * a
        y = y + H * v
        if y < 0:
            return step
    return -1


@pytest.mark.usefixtures("strangers_folder")
def test_the_demonstration():
    demo = run("determinism")
    assert [check.what for check in demo.checks if not check.ok] == []
    assert demo.numbers["fingerprints"] == 1
    assert demo.numbers["processes"] == 3
    # rounded operation by operation, as Python does it
    assert demo.numbers["first_contact"] == first_contact(START) == 48
    assert first_contact(float(np.nextafter(START, 2.0))) == 49
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    if platform.machine() == "x86_64" and " fma " in flags:
        # with a fused multiply-add the plain program takes the other branch
        assert demo.numbers["plain_first_contacts"] == [49, 48]
        assert demo.numbers["plain_fingerprints"] == 2
        assert demo.numbers["plain_is_off"] > 0.1


@pytest.fixture
def problem() -> Problem:
    return Problem(World.create(Impact(E), SemiImplicitEuler(H)), START, 0.0, STEPS)


def test_a_fingerprint_notices_the_last_bit_and_every_decision(problem: Problem):
    first = problem.run()
    same = fingerprint(first)
    y = first.y.copy()
    y[-1, 0] = np.nextafter(y[-1, 0], 9.0)
    assert fingerprint(dataclasses.replace(first, y=y)) != same
    contact = ~first.contact
    assert fingerprint(dataclasses.replace(first, contact=contact)) != same
    assert fingerprint(problem.run()) == same


def test_running_twice_passes_what_repeats_and_names_where_it_does_not(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
):
    assert require_deterministic(problem) == fingerprint(problem.run())
    with pytest.raises(InputError, match="times = 1"):
        require_deterministic(problem, times=1)
    other = problem.run()
    y = other.y.copy()
    y[7, 0] = np.nextafter(y[7, 0], 9.0)
    runs = iter([other, dataclasses.replace(other, y=y)])
    monkeypatch.setattr(Problem, "run", lambda self, **options: next(runs))
    monkeypatch.setattr(jax, "clear_caches", lambda: None)
    with pytest.raises(NumericalError, match="first at step 7, ball 0"):
        require_deterministic(problem)
