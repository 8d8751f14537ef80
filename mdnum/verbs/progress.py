"""Progress display of a command: a bar in a terminal or notebook, otherwise lines of text."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from html import escape
from pathlib import Path
from typing import Any, Self, TextIO

#: Function that is called occasionally with (done, total, {"phase": ..., "unit": ...}); total is 0 if
#: unknown.
Progress = Callable[[int, int, dict[str, Any]], None]
#: Values of the keyword `progress` of a verb: a `Progress`, True, False or None; see `reported`.
Wanted = Any

_WORDS = {
    "start": "starting", "compile": "compiling", "run": "running", "gradient": "differentiating",
    "check": "checking", "report": "writing the report",
}  # fmt: skip
# taken by the verb that is under way: verbs that it calls, and those of other threads, have no bar
_OUTERMOST = threading.Lock()


@contextmanager
def reported(progress: Wanted) -> Iterator[Progress | None]:
    """Context manager: yield the function to which progress is reported, or None.

    A function `progress` receives the reports. If `progress` is True, a bar is always shown; if False, never.
    If `progress` is None, worker processes and nested commands show no bar.
    """
    from multiprocessing import parent_process

    outermost = _OUTERMOST.acquire(blocking=False)
    shown = progress is True or (progress is None and outermost and parent_process() is None)
    given: Any = nullcontext(progress or None)
    try:
        with ProgressBar() if shown else given as report_to:
            yield report_to
    finally:
        if outermost:
            _OUTERMOST.release()


class ProgressBar:
    """Progress bar with steps/s, flips, list rebuilds and time left. Call it as progress(step, steps, info).

    If the unit of progress is not a step, info["unit"] names it. A separate thread draws the bar, because
    compilation sends no reports.

    Args:
        stream: where to draw a bar, or to print lines if the stream is no terminal; default stderr, or the
            output of a notebook's cell.
        delay: seconds of run before the bar appears.
        pause: seconds until the first line if the stream is no terminal, doubled after each line up to a
            minute.
    """

    def __init__(self, stream: TextIO | None = None, delay: float = 2.0, pause: float = 10.0):
        self._stream = sys.stderr if stream is None else stream
        ipython = sys.modules.get("IPython") if stream is None else None
        notebook = hasattr(ipython and ipython.get_ipython(), "kernel")
        self._draw = _Cell if notebook else _drawn if self._stream.isatty() else None
        self._pause = pause if self._draw is None else delay
        self._bar: Any = None
        self._last: tuple[int, int, dict[str, Any]] = (0, 0, {"phase": "start"})
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self.folder: Path | None = None  # that the rollout writes, once it has named it

    def __enter__(self) -> Self:
        self._began = time.monotonic()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, step: int, steps: int, info: dict[str, Any]) -> None:
        """Receive a report: the current step, the number of steps, and further counts."""
        self._last = (step, steps, dict(info))
        self.folder = info.get("folder", self.folder)

    def _watch(self) -> None:
        """Draw the bar or print a line until the progress bar is stopped."""
        while not self._over.wait(self._pause):
            step, steps, info = self._last
            phase = str(info.get("phase", "run"))
            counts = steps > 0 and (phase == "run" or "unit" in info)
            phase, line = _WORDS.get(phase, phase), describe(step, steps, info) if counts else ""
            if self._draw is None:
                seconds = f"({time.monotonic() - self._began:.0f} s)"
                with suppress(OSError, ValueError):  # whoever read it has gone
                    words = ", ".join(filter(None, (phase, line)))
                    print(f"mdnum: {words} {seconds}", file=self._stream, flush=True)
                self._pause = min(2 * self._pause, 60.0)
                continue
            if self._bar is None:
                self._bar, self._pause = self._draw(self._stream), 0.2
            total = steps if line else None
            self._bar.update(0, description=phase, total=total, completed=step, line=line, refresh=True)


def _drawn(stream: TextIO) -> Any:
    """Start and return a progress bar. Call `stop` to end the bar."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

    bar = Progress(
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=None),
        TextColumn("{task.fields[line]}"), console=Console(file=stream), transient=True, expand=True,
        auto_refresh=False,
    )  # fmt: skip
    bar.add_task("", total=None, line="")
    bar.start()
    return bar


class _Cell:
    """A progress bar below a notebook cell. Call `stop` to end the bar."""

    def __init__(self, stream: TextIO):
        from IPython.display import display  # pyright: ignore[reportMissingImports]

        self._shown: Any = display({"text/plain": ""}, raw=True, display_id=True)

    def update(self, _: int, *, description: str, total: int | None, completed: int, line: str, **_more: Any):
        value = "" if total is None else f' value="{completed}" max="{total}"'
        words = f"{description}  {line}".rstrip()
        html = f"<div><progress{value}></progress> {escape(words)}</div>"
        self._shown.update({"text/plain": words, "text/html": html}, raw=True)

    def stop(self) -> None:
        self._shown.update({"text/plain": ""}, raw=True)


def describe(step: int, steps: int, info: dict[str, Any]) -> str:
    """Format the text next to the bar: counts, steps per second and remaining time."""
    unit = info.get("unit", "steps")
    parts = [f"{step:,} of {steps:,} {unit}"]
    parts += [f"{info[name]:,} {name}" for name in ("flips", "rebuilds") if name in info]
    if rate := info.get(f"{unit}_per_second"):
        parts.insert(1, f"{rate:,.0f} {unit}/s" if rate >= 10 else f"{rate:.2g} {unit}/s")
        parts.append("ETA " + time.strftime("%H:%M:%S", time.gmtime((steps - step) / rate)))
    return "  ".join(parts)
