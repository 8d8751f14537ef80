"""Storage of a run in one folder: tables that survive a kill, exact frames, JSON and text, all atomic."""

from __future__ import annotations

from mdnum.store.folder import RunFolder, expect, restoring
from mdnum.store.layout import Layout

__all__ = ["Layout", "RunFolder", "expect", "restoring"]
