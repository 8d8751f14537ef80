"""What became of each question, in numbers and words that JSON holds: an examination that stops goes on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mdnum.errors import InputError
from mdnum.references.conformance.case import Case, Still
from mdnum.references.conformance.judge import Failure
from mdnum.references.conformance.results import Failed

#: Keys of `Answers.plain`, so that a file of another kind is not taken for one.
_KEYS = {"cases", "shrunk"}


class Answers:
    """Answers by the number of the question, and failures that were shrunk already.

    Questions are drawn anew when an examination goes on, the same for the same seed; so none is kept.

    Args:
        kept: `plain` of an earlier one.
        saved: called after each that is put in, with whether it should not be lost.

    Raises:
        InputError: what is kept is of another kind.
    """

    def __init__(self, kept: Mapping[str, Any] | None = None, saved: Callable[[bool], None] | None = None):
        kept = {"cases": {}, "shrunk": {}} if kept is None else kept
        if not (set(kept) >= _KEYS and all(isinstance(kept[key], Mapping) for key in _KEYS)):
            raise InputError("these are no answers of an examination", remedy="Begin again in a new folder")
        self._cases, self._shrunk = dict(kept["cases"]), dict(kept["shrunk"])
        self._saved = saved or (lambda urgent: None)

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
            )
        return kept

    def put(self, number: int, kept: Mapping[str, Any]) -> None:
        """Keeps what became of a question."""
        self._cases[str(number)] = dict(kept)
        self._saved(bool(kept["failures"]))

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
            self._saved(True)


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
    stills = tuple(
        Still(one["positions"], one["cell"], bool(one["fresh"]), one["skin"]) for one in kept["stills"]
    )
    x, y, z = (bool(axis) for axis in kept["pbc"])
    return Case(kept["name"], kept["area"], stills, (x, y, z), kept["r_cut"], kept["skin"])
