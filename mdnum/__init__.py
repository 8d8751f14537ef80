"""mdnum: neighbor-set flips, forks and gradients of cutoff-based molecular dynamics."""

from __future__ import annotations

__version__ = "0.1.0"
