"""`mdnum doctor`: whether numbers that are computed here can be trusted."""

from __future__ import annotations

from mdnum import doctor
from mdnum.verbs import Reply


def diagnose() -> Reply:
    """What each test saw, and what to do."""
    found = doctor.diagnose()
    rows = [(row.status, row.name, row.seen) for row in found.rows]
    remedies = [f"{row.name}: {row.remedy}" for row in found.rows if row.remedy]
    verdict = "safe" if found.ok else "UNSAFE: do not trust numbers computed here"
    last = f"this installation is {verdict} ({found.seconds:.1f} s)"
    shown = [("", ("status", "test", "seen"), rows), *remedies, last]
    return Reply({"ok": found.ok, **vars(found)}, shown, "complete" if found.ok else "failed")
