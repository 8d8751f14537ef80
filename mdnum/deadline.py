"""A limit on the time of a verb: what was not examined by then is said, not guessed."""

from __future__ import annotations

import math
import time

from mdnum.errors import InputError


class Deadline:
    """The moment at which no more work is begun.

    How much evidence a verdict rests on is counted in calls, never in seconds; a deadline only cuts it short,
    and a verb that was cut short says so.

    Args:
        minutes: from now; None for no limit.

    Raises:
        InputError: not a positive number.
    """

    def __init__(self, minutes: float | None = None):
        if minutes is not None and not (math.isfinite(minutes) and minutes > 0):
            raise InputError(f"--time {minutes:g} is no time to work in", remedy="Give minutes above 0")
        self.minutes = minutes
        self._end = math.inf if minutes is None else time.monotonic() + 60 * minutes

    @property
    def left(self) -> float:
        """Seconds that are left; infinite without a limit, never negative."""
        return max(0.0, self._end - time.monotonic())

    @property
    def passed(self) -> bool:
        """Whether the time is up."""
        return self.left == 0.0
