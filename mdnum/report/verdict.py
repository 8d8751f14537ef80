"""Findings on a run and the verdict in words that they add up to, whatever was simulated."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from mdnum.report.words import listed, many
from mdnum.store import RunFolder

Severity = Literal["info", "warning", "error"]
_ORDER = ("error", "warning", "info")


@dataclass(frozen=True)
class Finding:
    """One thing a person should know about a run.

    Attributes:
        code: stable name, for scripts.
        severity: error: do not use the numbers; warning: look before you do; info: good to know.
        title: one line, without a capital or a full stop.
        text: what was seen, with its numbers.
        remedy: what to do, empty if nothing.
    """

    code: str
    severity: Severity
    title: str
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Verdict:
    """What to think of a run.

    Attributes:
        tone: the worst severity; "good" if there is neither error nor warning.
        headline: the verdict in one sentence.
        evidence: what it rests on, a sentence each.
        findings: errors first.
    """

    tone: Literal["good", "warning", "error"]
    headline: str
    evidence: tuple[str, ...]
    findings: tuple[Finding, ...]

    @property
    def text(self) -> str:
        """Headline and evidence."""
        return " ".join((self.headline, *self.evidence))

    def store(self, folder: RunFolder, summary: Mapping[str, Any]) -> None:
        """Writes findings and verdict into a folder's summary.json, beside what summary holds."""
        findings = [dataclasses.asdict(finding) for finding in self.findings]
        folder.write_summary({**summary, "findings": findings, "verdict": self.text})


def conclude(found: Iterable[Finding], evidence: Iterable[str], complete: bool) -> Verdict:
    """The verdict on findings.

    Args:
        found: in the order in which they are to be told, whatever their severity.
        evidence: what the verdict rests on, a sentence each.
        complete: whether the run came to its end.
    """
    findings = tuple(sorted(found, key=lambda finding: _ORDER.index(finding.severity)))
    errors, warnings, notes = (
        [finding.title for finding in findings if finding.severity == severity] for severity in _ORDER
    )
    if len(errors) > 2:
        # the first is the cause more often than not
        errors[1:] = [f"{len(errors) - 1} more errors below"]
    if errors:
        headline = f"Do not rely on this run: {listed(errors)}."
    elif warnings:
        headline = (
            f"The record is complete; look at {many(len(warnings), 'point')} first: {listed(warnings)}."
        )
    else:
        headline = "The record is complete" if complete else "As far as it went, the record is complete"
        headline += (
            f"; to be known: {listed(notes)}." if notes else ", and none of the checks found anything."
        )
    tone = "error" if errors else "warning" if warnings else "good"
    return Verdict(tone, headline, tuple(evidence), findings)


def restore(kept: Mapping[str, Any]) -> Finding:
    """A finding that was written into summary.json."""
    values = {field.name: str(kept.get(field.name) or "") for field in dataclasses.fields(Finding)}
    if values["severity"] not in _ORDER:
        values["severity"] = "info"
    return Finding(**values)  # type: ignore[arg-type]
