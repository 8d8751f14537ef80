"""What brings about what: causes.toml beside this file, which has a table for each code of a finding."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mdnum.plain import beside


@dataclass(frozen=True)
class Cause:
    """What is known about the finding of one code."""

    brings: tuple[str, ...] = ()  # codes of findings that it explains
    rivals: tuple[str, ...] = ()  # codes of other causes that show the same
    tests: tuple[str, ...] = ()  # names in TESTS, without which it may not be named
    spares: str = ""  # the question ("run", "differentiate") that it does not bear on, whatever its severity


def _codes(names: Sequence[str], code: str) -> Iterator[str]:
    for name in names:
        group = _GROUPS.get(name, [name])
        yield from group[group.index(code) + 1 :] if code in group else group


_ROWS = dict(beside(__file__))
_GROUPS: dict[str, list[str]] = _ROWS.pop("groups")
#: What separates causes that look alike, by the name under which a check reports that it has been done.
TESTS: dict[str, str] = _ROWS.pop("tests")
#: The deepest causes first: a finding goes below the first row that explains it.
CAUSES = {
    code: Cause(
        tuple(_codes(row.get("brings", ()), code)), tuple(row.get("rivals", ())), tuple(row.get("tests", ())),
        row.get("spares", ""),
    )
    for code, row in _ROWS.items()
}  # fmt: skip

_SEVERITIES = ("info", "warning", "error")


def cause(code: str) -> Cause:
    """The row of a code; of one that another package gives, an empty one."""
    return CAUSES.get(code, Cause())


def heads(findings: Sequence[tuple[str, str]]) -> list[int]:
    """For each finding the place of the one that it goes below, its own where it is listed by itself.

    It goes below the deepest mistake found that brings it about and is no less severe, and below the first
    finding of its own code. That it has the same cause is likely and not known: correct the one above, and
    ask again.

    Args:
        findings: code and severity of each, in the order in which they were found.
    """
    ranks = [_SEVERITIES.index(severity) for _, severity in findings]
    first: dict[str, int] = {}
    for place, (code, _) in enumerate(findings):
        if code not in first or ranks[place] > ranks[first[code]]:
            first[code] = place
    found = []
    for place, (code, _) in enumerate(findings):
        above = (
            first[cause]
            for cause, row in CAUSES.items()
            if cause in first and code in row.brings and ranks[first[cause]] >= max(ranks[place], 1)
        )
        found.append(next(above, first[code]))
    # of what goes below one that goes below another, the top
    for _ in found:
        found = [found[place] for place in found]
    return found
