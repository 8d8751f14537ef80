"""A list called in a process of its own, so that one that crashes or hangs is a finding and not an end."""

from __future__ import annotations

import os
import pickle
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, BinaryIO

from mdnum.errors import MdnumError
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.lists import Outcome, PairList, Session
from mdnum.safe_path import environment, python

#: Seconds that an answer may take, for so many atoms at most and for more; and those to import a library.
#: They are its own processor time: by the clock nothing comes in time on a machine that has other work to do.
FEW, CALL, LONG, START = 1000, 45.0, 120.0, 120.0
#: A process that used less than this share of the time waits for something that does not come; and one that
#: has had this many times its seconds by the clock is not waited for, whatever else the machine does.
_IDLE, _MOST = 0.05, 10.0
_SIZE = struct.Struct("<Q")


class RemoteSession:
    """As `Session`, in another process; a new one after each that ended.

    Args:
        tested: a list that `load` finds by its word.
        reuse: ask one object in all cases.
    """

    def __init__(self, tested: PairList, reuse: bool = False):
        self.tested, self.reuse = tested, reuse
        self._process: subprocess.Popen[bytes] | None = None
        # what a library prints is no part of the report; its last words before a crash are
        self._said: Any = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the session)
        self._from = 0

    def ask(self, case: Case) -> list[Outcome]:
        """The outcome at every still, as far as the list goes."""
        outcomes: list[Outcome] = []
        try:
            if self._process is None:
                self._process = self._started()
            self._asked((case, self.reuse, self.tested.limits))
            # each step has its own time, which ends with its outcome
            while (outcome := self._received(CALL if case.atoms <= FEW else LONG)) is not None:
                outcomes.append(outcome)
            return outcomes
        except _Ended as ended:
            self.close()
            late = isinstance(ended, _Late)
            return [*outcomes, Outcome(late=str(ended)) if late else Outcome(crashed=str(ended))]

    def close(self) -> None:
        """Ends the process."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()

    def _started(self) -> subprocess.Popen[bytes]:
        self._from = self._said.seek(0, os.SEEK_END)
        self._process = subprocess.Popen(
            python("-m", "mdnum.references.conformance.remote", self.tested.word),
            env=environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
        )
        ready = self._received(START)
        if isinstance(ready, Exception):
            raise ready
        return self._process

    def _asked(self, message: Any) -> None:
        assert self._process is not None and self._process.stdin is not None
        try:
            _send(self._process.stdin, message)
        except OSError as error:
            raise _Ended(self._how_it_ended()) from error

    def _received(self, seconds: float) -> Any:
        process = self._process
        assert process is not None and process.stdout is not None
        done, late = threading.Event(), list[str]()
        watch = threading.Thread(target=self._watch, args=(process, seconds, done, late), daemon=True)
        watch.start()
        try:
            return _receive(process.stdout)
        except EOFError as error:
            if late:
                raise _Late(f"no answer within {seconds:.3g} s{late[0]}") from error
            raise _Ended(self._how_it_ended()) from error
        finally:
            done.set()
            watch.join()

    @staticmethod
    def _watch(process: Any, seconds: float, done: threading.Event, late: list[str]) -> None:
        """Ends a process that had its time and did not answer; `late` then has the words for it."""
        began, used = time.monotonic(), processor_seconds(process.pid)
        left = seconds
        while not done.wait(left):
            elapsed = time.monotonic() - began
            now = processor_seconds(process.pid)
            spent = elapsed if used is None or now is None else now - used
            waits = spent < _IDLE * elapsed
            if spent >= seconds or waits or elapsed >= _MOST * seconds:
                late.append(", in which it computed nothing" if waits else " of processor time")
                process.kill()
                return
            left = max(0.1, seconds - spent)

    def _how_it_ended(self) -> str:
        assert self._process is not None
        code = self._process.wait()
        if code >= 0:
            how = f"the process ended with exit code {code}"
        else:
            name = signal.Signals(-code).name if -code in {*signal.Signals} else f"signal {-code}"
            how = f"the process was ended by {name}"
        last = self._last_words()
        return f"{how}: {last}" if last else how

    def _last_words(self) -> str:
        """The last line that the process wrote to stderr since it was started."""
        self._said.seek(self._from)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        return lines[-1].strip()[:200] if lines else ""


def processor_seconds(process: int) -> float | None:
    """What a process has used of the processor so far, all threads together; None where that is not told."""
    try:
        # the second word is the name of the program in brackets, which may hold blanks
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None  # another system, or the process is gone


class _Ended(Exception):
    """The other process is gone; the message says how."""


class _Late(_Ended):
    """It was ended, because it did not answer."""


def _send(stream: BinaryIO | Any, message: Any) -> None:
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    stream.write(_SIZE.pack(len(data)))
    stream.write(data)
    stream.flush()


def _receive(stream: BinaryIO | Any) -> Any:
    head = stream.read(_SIZE.size)
    if len(head) < _SIZE.size:
        raise EOFError
    (size,) = _SIZE.unpack(head)
    data = stream.read(size)
    if len(data) < size:
        raise EOFError
    return pickle.loads(data)


def _limit_memory() -> None:
    """A grid of cells over a huge box is a MemoryError, not a machine that swaps."""
    try:
        import resource

        have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        resource.setrlimit(resource.RLIMIT_DATA, (have // 2, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    except (ImportError, OSError, ValueError):
        pass  # not on this system


def main(word: str) -> None:
    """Answers questions on stdin until there are no more."""
    from dataclasses import replace

    from mdnum.references.conformance.loading import load

    # a list may print: what it writes to stdout must not be taken for an answer
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        tested = load(word)
    except MdnumError as error:
        _send(answers, error)
        return
    _send(answers, "ready")
    _limit_memory()
    sessions: dict[bool, Session] = {}
    questions = sys.stdin.buffer
    while True:
        try:
            case, reuse, limits = _receive(questions)
        except EOFError:
            return
        session = sessions.setdefault(reuse, Session(replace(tested, limits=limits), reuse))
        try:
            for outcome in session.asked(case):
                _send(answers, outcome)
        except MemoryError as error:
            _send(answers, Outcome(raised=f"MemoryError: {error}"))
        _send(answers, None)


if __name__ == "__main__":
    main(sys.argv[1])
