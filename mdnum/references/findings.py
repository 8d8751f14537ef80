"""What a check found, in the form that the command line prints and the summary keeps."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

Severity = Literal["info", "warning", "error"]


def finding(code: str, severity: Severity, title: str, text: str, remedy: str = "") -> dict[str, str]:
    """One finding.

    Args:
        code: short stable name, for filtering.
        severity: info (nothing to do), warning (look at it), error (the numbers are wrong).
        title: one line.
        text: what was seen and what it means.
        remedy: what to do, an imperative sentence.
    """
    return {"code": code, "severity": severity, "title": title, "text": text, "remedy": remedy}


def plain(value: Any) -> Any:
    """A dataclass, and what is in it, as dictionaries, lists and Python numbers."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value
