"""What a diagnosis is made of."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Status = Literal["ok", "info", "unsafe"]


@dataclass(frozen=True)
class Row:
    """One test of the installation.

    Attributes:
        name: what was tested.
        status: "ok"; "info" for a fact that changes bits without making them wrong; "unsafe" when
            numbers computed here, or the claims mdnum makes about them, cannot be trusted.
        seen: what was seen.
        remedy: what to do, when something should be done.
    """

    name: str
    status: Status
    seen: str
    remedy: str | None = None


@dataclass(frozen=True)
class Diagnosis:
    """All tests of one installation.

    Attributes:
        rows: the tests in the order they are worth reading.
        seconds: how long they took.
    """

    rows: tuple[Row, ...]
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether no row is unsafe."""
        return all(row.status != "unsafe" for row in self.rows)

    def to_dict(self) -> dict[str, Any]:
        """The diagnosis for JSON."""
        return {"ok": self.ok, "seconds": self.seconds, "rows": [asdict(row) for row in self.rows]}
