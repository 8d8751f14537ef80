"""What became of each question, in numbers and words that JSON holds: an examination that stops goes on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.references.conformance.case import AREAS, Case, Still
from mdnum.references.conformance.judge import CODES, Failure
from mdnum.references.conformance.results import Failed
from mdnum.store import expect


class Answers:
    """Answers by the number of the question, and failures that were shrunk already.

    Questions are drawn anew when an examination goes on, the same for the same seed; so none is kept.

    Args:
        kept: `plain` of an earlier one, as JSON gives it back.
        where: the file that it is from.

    Attributes:
        saved: called after each that is put in, with whether it should not be lost.

    Raises:
        KeyError, TypeError, ValueError or the like: what is kept is of another kind.
    """

    def __init__(self, kept: Mapping[str, Any] | None = None, where: str | None = None):
        kept = {"cases": {}, "shrunk": {}} if kept is None else kept
        expect(isinstance(kept["cases"], dict) and isinstance(kept["shrunk"], dict), "no answers")
        self._cases, self._shrunk = dict(kept["cases"]), dict(kept["shrunk"])
        for number, one in self._cases.items():
            expect(number.isdecimal() and isinstance(one["case"], str), f"question {number!r}")
            _expect_rows(one["failures"])
            expect(type(one["aliased"]) is bool and type(one["single"]) is bool, "no yes or no")
            expect(len(one["ties"]) == 2 and all(map(_count, one["ties"])), "no two counts")
            expect(_size(one["seconds"]), "no seconds")
            if one["refused"] is not None:
                step, words = one["refused"]
                expect(_count(step) and isinstance(words, str), "no step and words of a refusal")
        for one in self._shrunk.values():
            case = _case(one["case"])
            _expect_rows(one["failures"], case.steps)
            expect(one["failures"] and type(one["alone"]) is bool, "no failure")
        self._where = where
        self.saved: Callable[[bool], None] = lambda urgent: None

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return {"cases": self._cases, "shrunk": self._shrunk}

    def of(self, number: int, case: Case) -> Mapping[str, Any] | None:
        """What became of a question; None where it was not asked yet.

        Raises:
            InputError: another question had that number.
        """
        kept = self._cases.get(str(number))
        if kept is not None and kept.get("case") != case.name:
            raise InputError(
                f"its question {number} was {kept.get('case')!r} and is {case.name!r} now",
                remedy="Begin again in a new folder: the questions are another version's",
                where=self._where,
            )
        steps = [] if kept is None else [row[3] for row in kept["failures"]]
        steps += [kept["refused"][0]] if kept is not None and kept["refused"] is not None else []
        if any(step >= case.steps for step in steps):
            raise InputError(
                f"its question {number} has an answer at a step that it does not have",
                remedy="Begin again in a new folder",
                where=self._where,
            )
        return kept

    def put(self, number: int, kept: Mapping[str, Any]) -> None:
        """Keeps what became of a question."""
        self._cases[str(number)] = dict(kept)
        self.saved(bool(kept["failures"]))

    def shrunk(self, failed: Failed) -> Failed | None:
        """A failure as it was shrunk before; None where it was not."""
        kept = self._shrunk.get(_name(failed))
        if kept is None:
            return None
        case = _case(kept["case"])
        return Failed(case, tuple(Failure(*one) for one in kept["failures"]), failed.asked, kept["alone"])

    def put_shrunk(self, failed: Failed, small: Failed) -> None:
        """Keeps a failure that was shrunk; not one whose pairs are known in closed form alone."""
        if small.case.known is None:
            failures = [as_row(one) for one in small.failures]
            self._shrunk[_name(failed)] = {
                "case": _plain(small.case), "failures": failures, "alone": small.alone,
            }  # fmt: skip
            self.saved(True)


def as_row(failure: Failure) -> list[Any]:
    """The arguments of a failure."""
    return [failure.code, failure.text, failure.count, failure.step]


def _name(failed: Failed) -> str:
    return f"{failed.code} {failed.asked.area} {failed.asked.name}"


def _plain(case: Case) -> dict[str, Any]:
    """A case as JSON can say it: a double's shortest decimal is that double again."""
    stills = [
        {"positions": still.positions.tolist(), "cell": still.cell.tolist(), "fresh": still.fresh,
         "skin": still.skin}
        for still in case.stills
    ]  # fmt: skip
    return {"name": case.name, "area": case.area, "pbc": list(case.pbc), "r_cut": case.r_cut,
            "skin": case.skin, "stills": stills}  # fmt: skip


def _case(kept: Mapping[str, Any]) -> Case:
    stills = []
    for one in kept["stills"]:
        still = Still(one["positions"], one["cell"], one["fresh"], one["skin"])
        expect(np.isfinite(still.positions).all() and np.isfinite(still.cell).all(), "no coordinates")
        expect(still.cell.shape == (3, 3) and type(still.fresh) is bool, "no cell")
        expect(still.skin is None or _size(still.skin), "no skin")
        stills.append(still)
    x, y, z = kept["pbc"]
    expect(stills and all(type(axis) is bool for axis in (x, y, z)), "no axes")
    expect(isinstance(kept["name"], str) and kept["area"] in AREAS, "no question")
    expect(_size(kept["r_cut"]) and kept["r_cut"] > 0 and _size(kept["skin"]), "no cutoff")
    return Case(kept["name"], kept["area"], tuple(stills), (x, y, z), kept["r_cut"], kept["skin"])


def _count(value: object) -> bool:
    return type(value) is int and value >= 0


def _size(value: object) -> bool:
    return isinstance(value, int | float) and type(value) is not bool and 0 <= value < math.inf


def _expect_rows(rows: Any, steps: int | None = None) -> None:
    """Rows are arguments of failures."""
    expect(isinstance(rows, list), "no failures")
    for code, text, count, step in rows:
        expect(code in CODES and isinstance(text, str), "no failure")
        expect(_count(count) and _count(step) and (steps is None or step < steps), "no count and step")
