"""What a verb shows of its progress, where, and that nothing of it stays behind."""

from __future__ import annotations

import io
import multiprocessing
import signal
import sys
import threading
import time
import types
from typing import Any

import pytest

import mdnum
from mdnum.verbs import progress
from mdnum.verbs.frame import keywords_checked
from mdnum.verbs.progress import ProgressBar


@pytest.fixture
def bars(monkeypatch: pytest.MonkeyPatch) -> list[ProgressBar]:
    """The bars that verbs make, each drawn from the start."""
    made: list[ProgressBar] = []

    class Noted(ProgressBar):
        def __init__(self) -> None:
            super().__init__(io.StringIO(), pause=0.01)
            made.append(self)

    monkeypatch.setattr(progress, "ProgressBar", Noted)
    return made


def drop(tmp_path, **how: Any) -> Any:
    return mdnum.bounce("ball/drop", steps=20, out=tmp_path / f"x{time.monotonic_ns()}", report=False, **how)


def test_a_verb_shows_a_bar_unless_it_is_given_another_way(tmp_path, bars):
    drop(tmp_path)
    assert len(bars) == 1
    drop(tmp_path, progress=False)
    calls = []
    drop(tmp_path, progress=lambda *told: calls.append(told))
    assert len(bars) == 1 and {info["phase"] for _, _, info in calls} >= {"run", "check"}


def test_the_worker_of_a_pool_shows_none_unless_it_is_asked_to(tmp_path, bars, monkeypatch):
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: object())
    drop(tmp_path)
    assert not bars
    drop(tmp_path, progress=True)
    assert len(bars) == 1


@pytest.mark.parametrize("outer", [None, False, print])
def test_a_verb_that_another_one_calls_shows_none(tmp_path, bars, outer):
    given = []

    @keywords_checked
    def sweep(count: int, *, progress: Any = None) -> None:
        given.append(progress)
        for _ in range(count):
            drop(tmp_path)

    sweep(2, progress=outer)
    assert len(bars) == (outer is None) and given == [bars[0] if bars else outer or None]
    with pytest.raises(mdnum.InputError):
        drop(tmp_path, against=["no"])
    drop(tmp_path)
    assert len(bars) == 2 + (outer is None), "the one after a failure has one again"


@pytest.mark.parametrize("system", ["ball/drop", "argon/crystal-108"])
def test_no_thread_and_no_handler_stays(tmp_path, bars, system):
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    verb = mdnum.run if system.startswith("argon") else mdnum.bounce
    # what compiles beside the first run, and jax, have threads of their own
    verb(system, steps=20, out=tmp_path / "first", report=False)
    before, handlers = set(threading.enumerate()), [signal.getsignal(one) for one in numbers]
    verb(system, steps=20, out=tmp_path / "second", report=False)
    with pytest.raises(mdnum.MdnumError):
        verb(system, steps=20, out=tmp_path / "second", report=False)
    assert len(bars) == 3 and set(threading.enumerate()) <= before
    assert [signal.getsignal(one) for one in numbers] == handlers


def test_a_notebook_shows_a_bar_below_its_cell(monkeypatch):
    shown: list[dict[str, str]] = []

    class Handle:
        def update(self, data: dict[str, str], raw: bool) -> None:
            shown.append(data)

    def display(data: dict[str, str], raw: bool, display_id: bool) -> Handle:
        shown.append(data)
        return Handle()

    shell = types.SimpleNamespace(kernel=object())
    package = types.SimpleNamespace(get_ipython=lambda: shell)
    monkeypatch.setitem(sys.modules, "IPython", package)
    monkeypatch.setitem(sys.modules, "IPython.display", types.SimpleNamespace(display=display))
    monkeypatch.setattr(sys, "stderr", stream := io.StringIO())
    with ProgressBar(delay=0.01) as bar:
        bar(0, 0, {"phase": "compile"})
        until = time.monotonic() + 20
        while not any("compiling" in one.get("text/html", "") for one in shown) and time.monotonic() < until:
            time.sleep(0.01)
        bar(30, 120, {"phase": "<b>", "unit": "runs"})
        while not any("30 of 120" in one["text/plain"] for one in shown) and time.monotonic() < until:
            time.sleep(0.01)
    first = next(one["text/html"] for one in shown if "compiling" in one["text/plain"])
    last = next(one["text/html"] for one in shown if "30 of 120" in one["text/plain"])
    assert "<progress></progress>" in first and '<progress value="30" max="120">' in last
    assert "&lt;b&gt;" in last and "<b>" not in last
    assert shown[-1] == {"text/plain": ""} and stream.getvalue() == "", "nothing of it stays"


def test_in_ipython_at_a_terminal_it_is_the_terminals(monkeypatch):
    package = types.SimpleNamespace(get_ipython=lambda: types.SimpleNamespace())
    monkeypatch.setitem(sys.modules, "IPython", package)
    monkeypatch.setattr(sys, "stderr", stream := io.StringIO())
    with ProgressBar(pause=0.01) as bar:
        bar(1, 2, {"phase": "run"})
        until = time.monotonic() + 20
        while "1 of 2 steps" not in stream.getvalue() and time.monotonic() < until:
            time.sleep(0.01)
    assert "mdnum: running, 1 of 2 steps" in stream.getvalue()
