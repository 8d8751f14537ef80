"""Table of the causes of findings, read from causes.toml."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mdnum.plain import beside


@dataclass(frozen=True)
class Cause:
    """Cause of a finding: its consequences, alternatives, and tests that distinguish them."""

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
#: Tests that distinguish causes with the same symptoms, by the name under which a check reports that the test
#: was made.
TESTS: dict[str, str] = _ROWS.pop("tests")
#: Causes in order of precedence: a finding is listed below the first row that explains it.
CAUSES = {
    code: Cause(
        tuple(_codes(row.get("brings", ()), code)), tuple(row.get("rivals", ())), tuple(row.get("tests", ())),
        row.get("spares", ""),
    )
    for code, row in _ROWS.items()
}  # fmt: skip

_SEVERITIES = ("info", "warning", "error")


def cause(code: str) -> Cause:
    """Return the cause of a finding code. Codes of other packages have an empty cause."""
    return CAUSES.get(code, Cause())


def heads(findings: Sequence[tuple[str, str]]) -> list[int]:
    """For each finding, return the index of the finding that explains it, or its own index.

    A finding is listed under its deepest cause that is at least as severe. A finding without such a cause is
    listed under the first finding with the same code. A common cause of several findings is likely but not
    proven. Correct the finding that is listed first, and then repeat the audit.

    Args:
        findings: code and severity of each finding, in the order in which the findings were made.
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
