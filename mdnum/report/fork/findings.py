"""The verdict of verbs that are not on the frame yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from mdnum.report.verdict import Finding
from mdnum.store import RunFolder


@dataclass(frozen=True)
class Verdict:
    """What to think of a comparison.

    Attributes:
        tone: "good" where the choice changes nothing that was decided, "info" for a fork that is understood,
            "warning" or "error" for the worst finding.
        headline: one sentence.
        evidence: what it rests on, a sentence each.
        findings: errors first.
    """

    tone: Literal["good", "info", "warning", "error"]
    headline: str
    evidence: tuple[str, ...]
    findings: tuple[Finding, ...]

    def store(self, folder: RunFolder, summary: Mapping[str, Any]) -> None:
        """Writes headline and findings into a folder's summary.json, beside what summary holds."""
        findings = [asdict(finding) for finding in self.findings]
        folder.write_summary({**summary, "findings": findings, "headline": self.headline})
