"""One run = one folder: tables that survive a kill, exact frames, JSON and text, all written atomically."""

from __future__ import annotations

from mdnum.store.folder import RunFolder, expect, restoring
from mdnum.store.tables import COLUMNS, TABLES, columns_of

__all__ = ["COLUMNS", "TABLES", "RunFolder", "columns_of", "expect", "restoring"]
