"""Horizons of real runs against the exact history: far apart for two precisions, and growing with bits."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import small_systems
from mdnum.forks.exact.horizon import (
    POLICIES,
    PolicyHorizon,
    _gained,
    certify,
    compare,
    rounded_start,
    taped,
)

from mdnum.errors import InputError
from mdnum.events.forks import Growth
from mdnum.forks.exact.program import ExactProgram, with_policy
from mdnum.forks.exact.tape import first_difference
from mdnum.precision import PrecisionPolicy
from mdnum.systems.build import Simulation, build

# exact runs
pytestmark = pytest.mark.slow

pytest.importorskip("flint", reason="exact runs need python-flint")

WIDE = PrecisionPolicy()


def liquid(seed: int = 3) -> Simulation:
    return build(
        small_systems.make(
            small_systems.crystal(2, 0.02, 1.68),
            small_systems.LENNARD_JONES,
            {"kind": "hard", "radius": 1.55},
            dynamics={"kind": "nve", "timestep": 0.004, "temperature": 2.9, "seed": seed},
            neighbors={"skin": 0.1},
        )
    )


def test_single_precision_leaves_early_and_double_does_not():
    simulation = liquid()
    names = ("float64", "float32", "float32, accumulate float64", "float64, force bfloat16")
    chosen = {name: POLICIES[name] for name in names}
    certificate = certify(simulation, 400, policies=chosen)
    assert certificate.ranking[0].name == "float64"
    wide, narrow = certificate.of("float64"), certificate.of("float32")
    assert wide.horizon is None and wide.difference is None and np.isnan(wide.margin)
    assert wide.separation.max() < 1e-9 < narrow.separation.max()
    assert narrow.horizon is not None and 20 < narrow.horizon < 400
    difference = narrow.difference
    assert difference is not None and difference.step == narrow.horizon
    exact = certificate.exact
    key = difference.i * simulation.atoms + difference.j
    assert difference.inside == (key in exact.tape.inside(narrow.horizon), narrow.margin < 0)
    # a margin of the size of the separation by then
    assert abs(narrow.margin) < 10 * narrow.separation[narrow.horizon]
    promoted = certificate.of("float32, accumulate float64")
    assert narrow.gain == 0 and np.isnan(wide.gain) and narrow.closer == 0
    # 29 bits more, of which some are lost in rounding more than one number a step
    assert 24 < wide.closer < 34 and abs(promoted.closer) < 1
    assert any("accumulate float64" in word and "gains nothing" in word for word in certificate.says)
    short = certificate.of("float64, force bfloat16")
    assert certificate.ranking[-1] is short and short.horizon is not None
    # eight bits instead of twenty-four, in the pair forces alone
    assert 3 <= short.horizon < narrow.horizon / 5 and short.closer < -6
    assert any("bfloat16 pair forces cost" in word for word in certificate.says)
    assert certificate.steps_per_bit == pytest.approx(np.log(2) / 0.024, rel=0.3)
    assert json.loads(json.dumps(certificate.summary()))["policies"][0]["horizon"] is None
    assert any(word.startswith("float64 keeps every decision") for word in certificate.says)
    with pytest.raises(KeyError):
        certificate.of("float16")


def test_a_start_of_fewer_bits_is_exact_and_shared():
    simulation = liquid()
    narrow = POLICIES["float32"]
    wide_start, narrow_start = rounded_start(simulation, WIDE), rounded_start(simulation, narrow)
    assert narrow_start.state.x.dtype == np.float32 and wide_start.state.x.dtype == np.float64
    for name in ("x", "v"):
        a, b = (np.asarray(getattr(s.state, name), np.float64) for s in (wide_start, narrow_start))
        np.testing.assert_array_equal(a, b)
        full = np.asarray(getattr(rounded_start(simulation, WIDE, 53).state, name))
        np.testing.assert_allclose(a, full, rtol=2.0**-24, atol=0)
        assert np.any(a != full)
    certificate = certify(simulation, 40, policies={"float32": narrow}, same_start=True)
    assert certificate.same_start and certificate.ranking[0].separation[0] == 0
    apart = certify(simulation, 40, policies={"float32": narrow})
    assert apart.ranking[0].separation[0] > 0


def test_a_planted_wrong_decision_of_a_run_is_its_horizon():
    simulation = liquid()
    exact = ExactProgram(simulation).run(60)
    run = taped(simulation, 60)
    for row in range(0, run.tape.flips, 7):
        kept = np.arange(run.tape.flips) != row
        tape = replace(
            run.tape,
            step=run.tape.step[kept],
            key=run.tape.key[kept],
            entered=run.tape.entered[kept],
        )
        found = compare("planted", WIDE, simulation, exact, replace(run, tape=tape))
        assert found.horizon == run.tape.step[row]
        assert found.difference is not None
        assert found.difference.i * simulation.atoms + found.difference.j == run.tape.key[row]


def test_steps_and_systems_that_cannot_be_certified():
    with pytest.raises(InputError, match="steps = 0"):
        certify(liquid(), 0)
    with pytest.raises(InputError, match="864 atoms"):
        certify(build("argon/liquid-864"), 10)


@pytest.mark.slow
def test_the_horizon_grows_with_the_bits_of_the_start():
    """Steps per bit are ln 2 over the growth rate, measured on the same runs (slope within 30 %)."""
    bits = np.array([20, 26, 32, 38])
    horizons, rates = [], []
    for seed in (3, 4, 5):
        simulation = liquid(seed)
        exact = ExactProgram(simulation).run(1150)
        row = []
        for b in bits:
            run = taped(simulation, 1150, rounded_start(simulation, WIDE, int(b)))
            found = compare(str(b), WIDE, simulation, exact, run)
            assert found.horizon is not None
            row.append(found.horizon)
            rates.append(found.growth.rate)
        horizons.append(row)
    slope = np.polyfit(bits, np.mean(horizons, axis=0), 1)[0]
    assert slope == pytest.approx(np.log(2) / np.median(rates), rel=0.3)
    assert np.all(np.diff(np.mean(horizons, axis=0)) > 0)


@pytest.mark.slow
def test_two_precisions_prove_the_same_long_history():
    simulation = liquid()
    exact = ExactProgram(simulation).run(1200)
    assert first_difference(exact.tape, ExactProgram(simulation).run(1200, bits=900).tape) is None
    narrow, wide = (
        compare("", policy, simulation, exact, taped(with_policy(simulation, policy), 1200))
        for policy in (POLICIES["float32"], WIDE)
    )
    assert narrow.horizon is not None and wide.horizon is not None
    assert wide.horizon > 3 * narrow.horizon


def test_gains_are_said_in_words():
    growth = Growth(0.1, 0.9, 0, 2)
    row = PolicyHorizon("one", PrecisionPolicy(), 90, None, 0.0, np.zeros(3), growth, "", 0.0, -0.01)
    assert _gained(row, 90, 200, "") == (
        "the promotion gains nothing: it leaves at the same step as single precision, and its positions are "
        "as far from the exact ones"
    )
    assert "leaves 10 steps earlier" in _gained(row, 100, 200, "")
    further = _gained(replace(row, closer=-0.5), 80, 200, "")
    assert "0.5 bits further from the exact ones" in further and "gains nothing (+10 steps" in further
    assert "gains no step" in _gained(replace(row, closer=3.0), 90, 200, "")
