"""The event model: threshold, margin, decision, ledger, flip."""

from __future__ import annotations

from mdnum.events.bits import changed_bits, changes_in_time, count_set, set_bits
from mdnum.events.hysteresis import Hysteresis
from mdnum.events.ledger import Ledger, broken_alternations, sort_rows
from mdnum.events.threshold import Threshold

__all__ = [
    "Hysteresis",
    "Ledger",
    "Threshold",
    "broken_alternations",
    "changed_bits",
    "changes_in_time",
    "count_set",
    "set_bits",
    "sort_rows",
]
