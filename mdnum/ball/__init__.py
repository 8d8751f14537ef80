"""The bouncing ball: events, stopping rules and precision in a world small enough to know exactly."""

from __future__ import annotations
