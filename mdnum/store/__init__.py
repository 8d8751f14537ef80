"""Storage of a run in a folder: tables, frames, JSON and text files, readable even if the run is killed."""

from __future__ import annotations

from mdnum.store.folder import RunFolder, expect, restoring
from mdnum.store.layout import Layout

__all__ = ["Layout", "RunFolder", "expect", "restoring"]
