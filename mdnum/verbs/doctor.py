"""`mdnum doctor`: tests to find out whether this machine computes correct numbers."""

from __future__ import annotations

from mdnum import doctor
from mdnum.report.finding import Finding, conclude
from mdnum.verbs import Reply


def diagnose() -> Reply:
    """Test this machine. Return each test result, with a remedy if the test failed."""
    found = doctor.diagnose()
    rows = [(row.status, row.name, row.seen) for row in found.rows]
    remedies = [f"{row.name}: {row.remedy}" for row in found.rows if row.remedy]
    said = "safe" if found.ok else "UNSAFE: do not trust numbers computed here"
    verdict, status = f"this installation is {said}", "complete" if found.ok else "failed"
    shown = [("", ("status", "test", "seen"), rows), *remedies, f"{verdict} ({found.seconds:.1f} s)"]
    unsafe = [row for row in found.rows if row.remedy]
    findings = [Finding("UNSAFE", "error", row.name, row.seen, str(row.remedy)) for row in unsafe]
    document = {"status": status, "ok": found.ok, **vars(found)}
    return Reply(conclude(findings, headline=verdict, judged=True).judged("doctor", document), shown, status)
