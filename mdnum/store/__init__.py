"""Storage of a run in a folder. A killed run stays readable."""

from __future__ import annotations

from mdnum.store.folder import RunFolder, expect, restoring
from mdnum.store.layout import Layout

__all__ = ["Layout", "RunFolder", "expect", "restoring"]
