"""How much is asked depends on calls and a person's deadline; checks come from one registry."""

from __future__ import annotations

import time

import pytest
from ase import Atoms
from audit.planted import Good, chain, subject

from mdnum.audit.base import TimeUp, in_order, needed_to
from mdnum.audit.checks import CHECKS
from mdnum.audit.thresholds import walk_pairs

NAMES = ["invariance", "smoothness", "forces", "curl", "state", "dynamics"]


class Looks:
    """A deadline that passes after so many looks at it."""

    def __init__(self, looks: int):
        self.looks = looks

    @property
    def passed(self) -> bool:
        self.looks -= 1
        return self.looks < 0


def three():
    return subject(Good, Atoms("Ar3", positions=chain().positions[:3]))


def check(name: str):
    made = CHECKS[name](steps=16)
    if name == "smoothness":
        made.neighbors, made.routes = 8, 1
    return made


def test_checks_are_known_in_their_order():
    assert in_order(list(CHECKS)) == NAMES
    assert needed_to("run") == {"invariance", "forces", "state", "dynamics"}
    assert needed_to("differentiate") == {"smoothness", "forces", "curl"}
    assert all(CHECKS.description(name).endswith("?") for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_evidence_is_the_same_on_a_machine_a_million_times_slower(name: str, monkeypatch):
    quick = check(name)(three())
    clock = iter(range(0, 10**12, 10**6))
    monkeypatch.setattr("mdnum.audit.base.perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    slow = check(name)(three())
    assert (slow.asked, slow.possible) == (quick.asked, quick.possible)
    assert slow.asked == slow.possible > 0
    assert (slow.says, slow.tables, slow.skipped) == (quick.says, quick.tables, quick.skipped)
    assert slow.seconds > 1e5 > quick.seconds


@pytest.mark.parametrize("name", NAMES[:5])
def test_a_deadline_leaves_ways_unasked_and_says_which(name: str):
    calls = {"smoothness": walk_pairs(three()).walks[0].calls, "invariance": 0}
    asked = three()
    asked.meter.deadline = Looks(calls.get(name, 60) + 40)  # pyright: ignore[reportAttributeAccessIssue]
    result = check(name)(asked)
    assert 0 < result.asked < result.possible
    assert any(why == "the time was up" for _, why in result.skipped)


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_found_by_a_check_for_which_there_was_no_time(name: str):
    asked = three()
    asked.meter.deadline = Looks(0)  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(TimeUp):
        check(name)(asked)
    assert asked.meter.calls < 150
