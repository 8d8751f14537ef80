"""Commands and cases that must not end in a traceback, a crash or a hang: called, examined and counted."""

from __future__ import annotations

import contextlib
import io
import json
import selectors
import subprocess
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
from _pages import markdown


def called(words: Sequence[str]) -> tuple[int | None, str, str]:
    """(exit code, stdout, stderr) of a command in this process; the code is None where nobody caught an
    exception, whose traceback stderr then is."""
    from mdnum import cli

    out, err = io.StringIO(), io.StringIO()
    code: Any = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code = cli.main(list(words))
    except SystemExit as stopped:
        code = stopped.code
    except KeyboardInterrupt:
        raise
    except BaseException:  # whatever it is, nobody caught it
        return None, out.getvalue(), traceback.format_exc()
    return code or 0, out.getvalue(), err.getvalue()


def answers(script: str, cases: Iterable[Any], patience: float, *words: str) -> Iterator[tuple[str, str]]:
    """(outcome, what was said) of each case, by a process that is replaced after a hang or a crash.

    Args:
        script: is run with --serve, and calls `serve`.
        cases: values of JSON.
        patience: seconds for a case.
        words: further options of the script.
    """
    child = None
    try:
        for case in cases:
            child = child or subprocess.Popen(
                [sys.executable, script, "--serve", *words], text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            assert child.stdin is not None and child.stdout is not None
            child.stdin.write(json.dumps(case) + "\n")
            child.stdin.flush()
            with selectors.DefaultSelector() as waiting:
                waiting.register(child.stdout, selectors.EVENT_READ)
                late = not waiting.select(patience)
            if answer := "" if late else child.stdout.readline():
                outcome, said = json.loads(answer)
            else:
                if late:
                    child.kill()
                code, child = child.wait(), None
                outcome, said = ("HANG", f"{patience:g} s") if late else ("CRASH", f"exit {code}")
            yield outcome, said
    finally:
        if child is not None:
            child.kill()
            child.wait()


def serve(examine: Callable[[Any], tuple[str, str]]) -> None:
    """The other side of `answers`: a case on each line of stdin, and its outcome on one of stdout."""
    stdout = sys.stdout
    for line in sys.stdin:
        print(json.dumps(examine(json.loads(line))), file=stdout, flush=True)


def counted(title: str, outcomes: Sequence[str], found: Sequence[tuple[str, str]], least: int = 1) -> str:
    """A Markdown table of (word, outcome): a row for each word; words with fewer cases are one row."""
    every = list(dict.fromkeys(word for word, _ in found))
    words = [word for word in every if sum(one == word for one, _ in found) >= least]
    rows = []
    for word in [*words, *(["others"] if len(words) < len(every) else []), "all"]:
        of = [
            outcome
            for one, outcome in found
            if word in (one, "all") or (word == "others" and one not in words)
        ]
        rows.append((word, len(of), *map(of.count, outcomes)))
    return markdown((title, "cases", *outcomes), rows)
