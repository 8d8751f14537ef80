"""Progress on stderr once work has proved to be long: a bar at a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TextIO

from mdnum.cli.output import Stopped

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_WORDS = {
    "start": "starting",
    "compile": "compiling",
    "run": "running",
    "gradient": "differentiating",
    "check": "checking",
    "report": "writing the report",
}


@contextmanager
def watched(remedy: Callable[[], str | None] | None = None) -> Iterator[ProgressBar]:
    """A progress bar around a run; control-C becomes the error that ends the command line.

    Args:
        remedy: asked then what to do about it.

    Raises:
        Stopped: somebody pressed control-C.
    """
    try:
        with ProgressBar() as progress:
            yield progress
    except KeyboardInterrupt:
        raise Stopped("stopped", remedy=remedy() if remedy is not None else None) from None


class ProgressBar:
    """Called by a rollout as progress(step, steps, info); shows steps/s, flips, rebuilds and ETA.

    What counts something else than steps says so: info["unit"] names it.

    The bar is started by a timer rather than by a call, because the first thing a run does is compile,
    for seconds, without calling.

    Args:
        stream: where to draw a bar, or to print lines where it is no terminal.
        delay: seconds of run before the bar appears.
        pause: seconds to the first line where it is no terminal, doubled after each up to a minute.
    """

    def __init__(self, stream: TextIO | None = None, delay: float = 2.0, pause: float = 10.0):
        self._stream = sys.stderr if stream is None else stream
        self._delay = delay
        self._pause = pause
        self._began = time.monotonic()
        self._lock = threading.Lock()
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._timer: threading.Timer | None = None
        self._last: tuple[int, int, dict[str, Any]] = (0, 0, {"phase": "start"})
        self._closed = False

    def __enter__(self) -> Self:
        self._began = time.monotonic()
        if self._stream.isatty():
            self._after(self._delay, self._start)
        else:
            self._after(self._pause, self._print)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._closed = True
            if self._timer is not None:
                self._timer.cancel()
            if self._bar is not None:
                self._bar.stop()

    def __call__(self, step: int, steps: int, info: dict[str, Any]) -> None:
        """What a rollout reports: the step reached, of how many, and counts so far."""
        with self._lock:
            self._last = (step, steps, dict(info))
            self._draw()

    @property
    def shown(self) -> bool:
        """Whether the bar has appeared."""
        return self._bar is not None

    def _after(self, seconds: float, action: Callable[[], None]) -> None:
        self._timer = threading.Timer(seconds, action)
        self._timer.daemon = True
        self._timer.start()

    def _print(self) -> None:
        with self._lock:
            if self._closed:
                return
            step, steps, info = self._last
            phase = str(info.get("phase", "run"))
            line = f"mdnum: {_WORDS.get(phase, phase)}"
            if _counts(steps, info):
                line += f", {describe(step, steps, info)}"
            with suppress(OSError, ValueError):  # whoever read it has gone
                print(f"{line} ({time.monotonic() - self._began:.0f} s)", file=self._stream, flush=True)
            self._pause = min(2 * self._pause, 60.0)
            self._after(self._pause, self._print)

    def _start(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

        with self._lock:
            if self._closed:
                return
            self._bar = Progress(
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(bar_width=None),
                TextColumn("{task.fields[line]}"),
                console=Console(file=self._stream),
                transient=True,
                expand=True,
            )
            self._task = self._bar.add_task("", total=None, line="")
            self._bar.start()
            self._draw()

    def _draw(self) -> None:
        if self._bar is None or self._task is None:
            return
        step, steps, info = self._last
        phase = str(info.get("phase", "run"))
        counting = _counts(steps, info)
        self._bar.update(
            self._task,
            description=_WORDS.get(phase, phase),
            total=steps if counting else None,
            completed=step,
            line=describe(step, steps, info) if counting else "",
        )


def _counts(steps: int, info: dict[str, Any]) -> bool:
    return steps > 0 and (info.get("phase", "run") == "run" or "unit" in info)


def describe(step: int, steps: int, info: dict[str, Any]) -> str:
    """The numbers beside the bar, in one line."""
    parts = [f"{step:,} of {steps:,} {info.get('unit', 'steps')}"]
    rate = info.get("steps_per_second")
    if rate:
        parts.append(f"{rate:,.0f} steps/s")
    for name in ("flips", "rebuilds"):
        if name in info:
            parts.append(f"{info[name]:,} {name}")
    if rate:
        parts.append("ETA " + time.strftime("%H:%M:%S", time.gmtime((steps - step) / rate)))
    return "  ".join(parts)
