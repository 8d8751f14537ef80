"""How much an audit asks: a verdict after a few dozen calls, and a limit whatever it is given."""

from __future__ import annotations

import pytest
from audit import planted
from audit.planted import but

import mdnum
from mdnum.audit.base import CALLS_UP, Meter
from mdnum.audit.building import BUILDING_CALLS
from mdnum.audit.checks import CHECKS
from mdnum.audit.conclusion import needed_to
from mdnum.audit.thresholds import WALKING_CALLS
from mdnum.cli.output import EXIT_UNDECIDED, exit_code
from mdnum.verbs import frame

#: Of an audit with all checks, the building of its structure included: two minutes at 10 ms a call.
MOST = 12_000


class ByCalls:
    """A calculator, and a deadline that passes after so many of its calls: as if each took a second."""

    def __init__(self, kind, monkeypatch):
        clock = self
        self.calls = 0

        class Timed(kind):
            def calculate(self, *words, **more):
                clock.calls += 1
                super().calculate(*words, **more)

        class Deadline:
            # for the clock that interrupts a call, which is not this one
            left = float("inf")

            def __init__(self, minutes=None):
                self.minutes, self.end = minutes, float("inf")
                if minutes is not None:
                    self.end = clock.calls + 60 * minutes

            @property
            def passed(self):
                return clock.calls >= self.end

        self.make = Timed
        monkeypatch.setattr("mdnum.deadline.Deadline", Deadline)


@pytest.mark.parametrize(
    ("kind", "atoms", "answer"),
    [
        (planted.Good, planted.crystal(), "as far as tested"),
        (planted.Good, planted.chain(), "as far as tested"),
        (planted.Single, planted.crystal(), "as far as tested"),
        (planted.Whirl, planted.chain(), "no"),
        (planted.drops(0.3, 7), planted.crystal(), "no"),
        (planted.NoSwitchInForce, planted.crystal(), "no"),
    ],
)
def test_two_minutes_of_calls_of_a_second_end_in_a_verdict(kind, atoms, answer, monkeypatch, tmp_path):
    timed = ByCalls(kind, monkeypatch)
    outcome = mdnum.audit_calculator(timed.make, atoms, time=2.0, out=tmp_path / "a", report=False)
    summary = outcome.summary
    assert summary["safe_to_run"] == summary["safe_to_differentiate"] == answer
    assert summary["status"] == frame.PARTIAL
    assert exit_code(outcome.verdict.findings, summary["status"]) == (answer == "no")
    # one call may be on its way when the time is up, and repeats end what they began
    assert timed.calls <= 135


def test_time_that_is_up_before_a_verdict_says_so(monkeypatch, tmp_path):
    timed = ByCalls(planted.Good, monkeypatch)
    outcome = mdnum.audit_calculator(
        timed.make, planted.crystal(), time=0.5, out=tmp_path / "a", report=False
    )
    assert outcome.summary["status"] == frame.UNDECIDED
    assert exit_code(outcome.verdict.findings, outcome.summary["status"]) == EXIT_UNDECIDED
    assert outcome.summary["safe_to_run"] == "not tested"
    # resumed without a limit, it is whole
    done = mdnum.audit_calculator(timed.make, resume=tmp_path / "a", report=False)
    assert done.summary["status"] == "complete" and done.summary["safe_to_run"] == "yes"


def test_all_checks_together_have_a_limit_of_calls():
    assert BUILDING_CALLS + WALKING_CALLS + sum(CHECKS[name].calls for name in CHECKS) + 150 <= MOST
    basic = {name for name in CHECKS if CHECKS[name].basic}
    assert basic == {"forces", "curl", "state", "dynamics"}
    assert all(needed_to(question) & basic for question in ("run", "differentiate"))


# of a clean one the gate counts the calls in `test_audit`
@pytest.mark.nightly
@pytest.mark.parametrize(
    "kind", [planted.Good, planted.ByAppearance, planted.HardEdge, planted.FirstSix, planted.drops(0.02, 0)]
)
def test_a_whole_audit_of_two_elements_stays_within_its_calls(kind, monkeypatch, tmp_path):
    """Counted by the calculator itself, whatever is wrong with it, its structure included."""
    timed = ByCalls(kind, monkeypatch)
    outcome = mdnum.audit_calculator(timed.make, out=tmp_path / "a", report=False)
    assert outcome.summary["status"] == "complete" and len(outcome.summary["parts"]) == len(list(CHECKS))
    assert timed.calls <= MOST


def test_a_check_whose_calls_are_used_up_is_not_fine(monkeypatch, tmp_path):
    # no check leaves another what it did not need
    monkeypatch.setattr(Meter, "spare", property(lambda meter: 0, lambda meter, calls: None))
    monkeypatch.setattr(CHECKS["invariance"], "calls", 60)
    monkeypatch.setattr(CHECKS["dynamics"], "calls", 50)
    checks = ",".join(needed_to("run"))
    found = mdnum.audit_calculator(planted.Good, planted.crystal(), checks=checks, out=tmp_path / "a")
    parts = {one["name"]: one for one in found.summary["parts"]}
    assert 0 < parts["invariance"]["asked"] < parts["invariance"]["possible"]
    # of dynamics the brief form is known
    assert (parts["dynamics"]["asked"], parts["dynamics"]["possible"]) == (1, 2)
    assert found.summary["status"] == "complete" and found.summary["safe_to_run"] == "as far as tested"
    assert {one["why"] for one in found.summary["left_out"]} >= {CALLS_UP}


def test_a_meter_counts_what_may_not_be_left():
    meter = Meter(most=0)
    meter.count()
    assert meter.calls == 1


@pytest.mark.parametrize("logged", [True, False])
def test_the_energy_that_a_run_logs_is_repeated_too(logged: bool):
    """Noise on one of two energies alone, whichever it is."""

    def calculate(self, *words, **more):
        planted.TwoEnergies.calculate(self, *words, **more)
        self.draws = getattr(self, "draws", 0) + 1
        self.results["energy" if logged else "free_energy"] += 1e-3 * self.draws

    found = planted.codes(planted.asked("state", but(planted.TwoEnergies, calculate=calculate)))
    assert found["NOT_REPEATABLE"] == "error"
    assert "NOT_REPEATABLE" not in planted.codes(planted.asked("state", planted.TwoEnergies))
