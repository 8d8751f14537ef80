"""What a bouncing ball's run folder and the demonstrations say, to people."""

from __future__ import annotations
