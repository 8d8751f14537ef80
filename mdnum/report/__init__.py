"""What a run folder says, to people: findings, figures, one HTML file."""

from __future__ import annotations
