"""How much is asked depends on calls and a person's deadline, never on how fast the clock runs."""

from __future__ import annotations

import time

import pytest
from ase import Atoms
from audit import planted
from audit.planted import chain, subject
from audit.test_state import at_cutoff

from mdnum.audit.base import Check, TimeUp
from mdnum.audit.curl import Curl
from mdnum.audit.dynamics import Dynamics
from mdnum.audit.forces import Forces
from mdnum.audit.invariance import Invariance
from mdnum.audit.smoothness import Smoothness
from mdnum.audit.state import State
from mdnum.audit.thresholds import walk_pairs

CHECKS: dict[str, Check] = {
    "smoothness": Smoothness(neighbors=8, routes=1),
    "invariance": Invariance(),
    "forces": Forces(),
    "curl": Curl(),
    "state": State(at_cutoff),
    "dynamics": Dynamics(at_cutoff, steps=16),
}


class Deadline:
    """Passes after so many looks at it."""

    def __init__(self, looks: int):
        self.looks = looks

    @property
    def passed(self) -> bool:
        self.looks -= 1
        return self.looks < 0


def three() -> Atoms:
    return Atoms("Ar3", positions=chain().positions[:3])


@pytest.mark.parametrize("name", CHECKS)
def test_evidence_is_the_same_on_a_machine_a_million_times_slower(name: str, monkeypatch):
    quick = CHECKS[name](subject(planted.Good, three()))
    clock = iter(range(0, 10**12, 10**6))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    slow = CHECKS[name](subject(planted.Good, three()))
    assert (slow.asked, slow.possible) == (quick.asked, quick.possible)
    assert slow.asked == slow.possible > 0
    assert (slow.says, slow.tables, slow.skipped) == (quick.says, quick.tables, quick.skipped)
    assert slow.seconds > 1e5 > quick.seconds


@pytest.mark.parametrize("name", ["smoothness", "invariance", "forces", "curl", "state"])
def test_a_deadline_leaves_ways_unasked_and_says_which(name: str):
    calls = {"smoothness": walk_pairs(subject(planted.Good, three())).walks[0].calls, "invariance": 0}
    asked = subject(planted.Good, three())
    asked.meter.deadline = Deadline(calls.get(name, 60) + 40)  # pyright: ignore[reportAttributeAccessIssue]
    part = CHECKS[name](asked)
    assert 0 < part.asked < part.possible
    assert sum(why == "the time was up" for _, why in part.skipped) > 0


@pytest.mark.parametrize("name", CHECKS)
def test_nothing_is_told_of_a_check_for_which_there_was_no_time(name: str):
    asked = subject(planted.Good, three())
    asked.meter.deadline = Deadline(0)  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(TimeUp):
        CHECKS[name](asked)
    assert asked.meter.calls < 150
