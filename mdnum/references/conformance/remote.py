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
from typing import Any, BinaryIO

from mdnum.errors import MdnumError
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.lists import Outcome, PairList, Session

#: Seconds that an answer may take, for so many atoms at most and for more; and those to import a library.
FEW, CALL, LONG, START = 1000, 45.0, 120.0, 120.0
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
        try:
            if self._process is None:
                self._process = self._started()
            return self._exchanged(
                (case, self.reuse, self.tested.limits), CALL if case.atoms <= FEW else LONG
            )
        except _Ended as ended:
            self.close()
            return [Outcome(late=str(ended)) if isinstance(ended, _Late) else Outcome(crashed=str(ended))]

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
            [sys.executable, "-m", "mdnum.references.conformance.remote", self.tested.word],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
        )
        ready = self._received(START)
        if isinstance(ready, Exception):
            raise ready
        return self._process

    def _exchanged(self, message: Any, seconds: float) -> Any:
        assert self._process is not None and self._process.stdin is not None
        try:
            _send(self._process.stdin, message)
        except OSError as error:
            raise _Ended(self._how_it_ended()) from error
        return self._received(seconds)

    def _received(self, seconds: float) -> Any:
        process = self._process
        assert process is not None and process.stdout is not None
        late = threading.Event()

        def stop() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(seconds, stop)
        timer.start()
        try:
            return _receive(process.stdout)
        except EOFError as error:
            if late.is_set():
                raise _Late(f"no answer within {seconds:.0f} s") from error
            raise _Ended(self._how_it_ended()) from error
        finally:
            timer.cancel()

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
            outcomes = session.ask(case)
        except MemoryError as error:
            outcomes = [Outcome(raised=f"MemoryError: {error}")]
        _send(answers, outcomes)


if __name__ == "__main__":
    main(sys.argv[1])
