"""Time limit of a command. The command reports missing results."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from mdnum.errors import InputError

T = TypeVar("T")
#: Seconds after the deadline at which a call in progress is interrupted.
GRACE = 10.0


class TimeUp(Exception):
    """Raised if the deadline passes during a calculation, which therefore has no result."""

    why = "the time was up"


class Deadline:
    """A deadline, after which a command does not start further work.

    The amount of evidence is counted in function calls, since time depends on the machine. A deadline can
    reduce the number of calls. The command reports the reduced number.

    Args:
        minutes: time from now in minutes; None for no limit.

    Raises:
        InputError: minutes is not a positive number.
    """

    def __init__(self, minutes: float | None = None):
        if minutes is not None and not (math.isfinite(minutes) and minutes > 0):
            raise InputError(
                f"--time {minutes:g} leaves no time to compute", remedy="Give a number of minutes above 0"
            )
        self.minutes = minutes
        self._end = math.inf if minutes is None else time.monotonic() + 60 * minutes

    @property
    def left(self) -> float:
        """Remaining time in seconds; infinite without a limit, and 0 after the deadline."""
        return max(0.0, self._end - time.monotonic())

    def part(self, share: float) -> Deadline:
        """Return an earlier deadline, which allows only a fraction of the remaining time."""
        sooner = Deadline()
        sooner._end = time.monotonic() + share * self.left
        return sooner

    @property
    def passed(self) -> bool:
        """True if the deadline has passed."""
        return self.left == 0.0


@contextmanager
def interrupting(deadline: Deadline, grace: float = GRACE) -> Iterator[None]:
    """Raise `TimeUp` in the main thread if the `with` block exceeds the deadline by `grace` seconds.

    `TimeUp` is raised repeatedly, because code in the block may catch it. Compiled code is not interrupted.
    """
    if math.isinf(deadline.left) or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, deadline.left + grace, grace)
    try:
        yield
    except KeyboardInterrupt:
        raise TimeUp if deadline.passed else KeyboardInterrupt from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def fewest(
    items: Sequence[T], enough: Callable[[list[T]], bool], spent: Callable[[], bool] = lambda: False
) -> list[T]:
    """Return a subset that satisfies a condition. The subset is minimal unless time ran out.

    Args:
        items: items that are sufficient together.
        enough: returns whether a subset, in the order of items, is sufficient.
        spent: returns whether the search must stop.

    Source: Zeller and Hildebrandt, Simplifying and Isolating Failure-Inducing Input, IEEE TSE 28, 183 (2002);
        complements only.
    """
    kept = list(items)
    size = max(1, len(kept) // 2)
    while not spent():
        at, before = 0, len(kept)
        while at < len(kept) and not spent():
            rest = kept[:at] + kept[at + size :]
            if enough(rest):
                kept = rest
            else:
                at += size
        if size == 1 and len(kept) == before:
            break
        size = max(1, min(size // 2, len(kept) // 2))
    return kept
