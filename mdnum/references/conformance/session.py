"""Call a neighbor list, in this process or another one. Return its pairs or errors."""

from __future__ import annotations

import ast
import builtins
import dis
import linecache
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from numpy import ndarray

from mdnum.deadline import Deadline, TimeUp
from mdnum.errors import MdnumError
from mdnum.references.conformance.answer import ListAnswer, Malformed, parts, read
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.judge import Failure
from mdnum.references.conformance.lists import PairList
from mdnum.safe_path import environment, guard, python

#: Time limits of a call for at most a given number of atoms and for more atoms, and of importing a library,
#: in seconds of processor time of the process, because elapsed time depends on the load of the machine.
FEW, CALL, LONG, START = 1000, 45.0, 120.0, 120.0
#: A process that used less than this share of the time is considered to be blocked; a process is ended after
#: this multiple of the limit in elapsed time.
_IDLE, _MOST = 0.05, 10.0
#: Modules, in addition to those of Python, whose exceptions concern a call made by the list, not its input.
_BORROWED = frozenset({"numpy", "scipy", "numba", "pandas", "torch", "jax", "jaxlib", "cupy", "ctypes"})


@dataclass(frozen=True)
class CallOutcome:
    """The pairs or the error from one call of a neighbor list."""

    answer: ListAnswer | None = None  # the pairs, or None
    # why there is no answer, or None: it crashed, came too late, raised or returned no pairs
    failure: Failure | None = None
    # the exception, in words, where it states on purpose that this cannot be done (`meant`)
    refused: str | None = None
    changed: str | None = None  # the input that the call wrote to, or None
    aliased: bool = False  # the rows of the answer before this one were other ones after this call
    # the padding that a list that is kept states, length; None where it states none
    skin: float | None = None


class Session:
    """Calls a neighbor list. If `reuse` is True, all test cases use one object of the neighbor list."""

    starts, deadline = 0, Deadline()  # of a process; calls in this one have none

    def __init__(self, tested: PairList, reuse: bool = False):
        self.tested, self.reuse = tested, reuse
        self._made: Any = None
        self._returned: list[ndarray] = []

    def ask(self, case: Case) -> list[CallOutcome]:
        """Return the pairs or error of each call, up to the first error."""
        return list(self.outcomes(case))

    def outcomes(self, case: Case) -> Iterator[CallOutcome]:
        """Yield the pairs or error of each call, up to the first error."""
        if self._made is None or (self.tested.kept and not self.reuse):
            try:
                self._made = self.tested.make()
            except (Exception, SystemExit) as error:
                yield _failed(error, case, None)
                return
        positions, cell = np.zeros((0, 3)), np.zeros((3, 3))
        for step, still in enumerate(case.stills):
            pbc, count, before = np.array(case.pbc), len(still.positions), len(positions)
            fresh = not step or still.fresh or (self.tested.limits.fixed_atoms and count != before)
            if self.tested.kept and not fresh and count == before:
                # a program moves its atoms where they are: a list that kept the array and not its numbers
                # sees no motion
                positions[...], cell[...] = still.positions, still.cell
            else:
                positions, cell = np.array(still.positions), np.array(still.cell)
            skin = case.skin if still.skin is None else still.skin
            outcome = self._call(case, positions, cell, pbc, skin if fresh else None)
            yield outcome
            if outcome.answer is None:
                return

    def close(self) -> None:
        """Release the object that represents the neighbor list."""
        self._made, self._returned = None, []

    def _call(
        self, case: Case, positions: ndarray, cell: ndarray, pbc: ndarray, skin: float | None
    ) -> CallOutcome:
        """Call the neighbor list once. If `skin` is given, allocate an updatable list."""
        inputs = {"positions": positions, "cell": cell, "pbc": pbc}
        before = {name: array.copy() for name, array in inputs.items()}
        returned, self._returned = self._returned, []
        held = [part.copy() for part in returned]
        try:
            if not self.tested.kept:
                given = self._made(positions, cell, pbc, case.r_cut)
            elif skin is not None:
                given = self._made.allocate(positions, cell, pbc, case.r_cut, skin)
            else:
                given = self._made.update(positions, cell)
        except (Exception, SystemExit) as error:
            return _failed(error, case, self.tested.package)
        try:
            answer = read(given)
            # np.asarray of a tensor on the same device is a view of it, and of a list of numbers none
            self._returned = [
                np.asarray(part) for part in parts(given).values() if hasattr(part, "__array__")
            ]
        except Malformed as error:
            return CallOutcome(failure=Failure("MALFORMED", str(error)))
        same = (
            a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in zip(returned, held, strict=True)
        )
        changed = [name for name, array in inputs.items() if not np.array_equal(before[name], array)]
        return CallOutcome(
            answer, changed=changed[0] if changed else None, aliased=not all(same), skin=self._stated_skin()
        )

    def _stated_skin(self) -> float | None:
        try:
            skin = float(self._made.skin) if self.tested.kept else -1.0
        except (AttributeError, TypeError, ValueError):
            return None
        return skin if np.isfinite(skin) and skin >= 0 else None


def _failed(error: Exception | SystemExit, case: Case, package: str | None) -> CallOutcome:
    if isinstance(error, SystemExit):  # it would have ended the process of whoever called it
        return CallOutcome(failure=Failure("CRASHED", f"it ends the process: SystemExit: {error}"))
    # what follows the first lines is where it was raised, in some libraries with the frames of compiled code
    text = str(error).partition("Exception raised from ")[0].strip()
    first, frames, rest = text.partition("Traceback of ")
    # TorchScript says what happened in the last line of a traceback
    text = " ".join((f"{first} {rest.splitlines()[-1]}" if frames else text).split())
    words = f"{type(error).__name__}: {text[:300]}"
    # without atoms there is nothing that could not be done
    refused = case.atoms > 0 and meant(error, package)
    return CallOutcome(refused=words) if refused else CallOutcome(failure=Failure("RAISED", words))


def meant(error: Exception, package: str | None = None) -> bool:
    """Return whether an exception was raised deliberately because the input is not supported.

    A deliberate exception prevents a calculation with wrong pairs. An accidental exception shows that the
    input was not anticipated.

    Args:
        error: the exception, with its traceback.
        package: distribution of the neighbor list; exceptions raised in its compiled code are deliberate.

    Returns:
        True if the innermost stack frame belongs to the neighbor list and is at a `raise`, or at a call of a
        library's compiled code that raised; and if the exception is a ValueError, a RuntimeError or of a
        class of the library, with a message. False otherwise, or if this cannot be determined.
    """
    own = (package or "").replace("-", "_").lower()
    usual = isinstance(error, ValueError | RuntimeError) or _is_own(type(error).__module__, own)
    if not usual or isinstance(error, np.linalg.LinAlgError | RecursionError | UnicodeError):
        return False
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None or not str(error).strip():
        return False
    module = str(last.tb_frame.f_globals.get("__name__", ""))
    if not _is_own(module, own) and module != "__main__":
        return False
    if last.tb_frame.f_code.co_filename.endswith((".pyx", ".pxd", ".pxi")):
        return bool(own) and module.partition(".")[0].lower() == own
    return _at_raise(last) or _is_own(_called_module(last), own)


def _is_own(module: str, own: str) -> bool:
    """Return whether a module belongs to the neighbor list's own code."""
    top = module.partition(".")[0]
    return bool(top) and (top.lower() == own or (top not in _BORROWED and top not in sys.stdlib_module_names))


def _at_raise(place: TracebackType) -> bool:
    """Return whether a stack frame is currently at a `raise` statement."""
    code, at = place.tb_frame.f_code.co_code, place.tb_lasti
    if 0 <= at < len(code) and dis.opname[code[at]] == "RAISE_VARARGS":
        return True
    # compiled code shows frames that name its lines and have no instructions
    line = linecache.getline(place.tb_frame.f_code.co_filename, place.tb_lineno)
    return len(code) < 16 and line.strip().startswith("raise ")


def _called_module(place: TracebackType) -> str:
    """Return the module whose compiled function a stack frame calls, or ""."""
    code = place.tb_frame.f_code
    where = next(islice(code.co_positions(), max(0, place.tb_lasti // 2), None), (None,) * 4)
    first, last, left, right = where
    if first is None or last is None or left is None or right is None:
        return ""
    lines = [linecache.getline(code.co_filename, number).encode() for number in range(first, last + 1)]
    # columns count bytes
    lines[-1] = lines[-1][:right]
    lines[0] = lines[0][left:]
    try:
        call = ast.parse(textwrap.dedent(b"".join(lines).decode()).strip(), mode="eval").body
    except (SyntaxError, ValueError):
        return ""
    if not isinstance(call, ast.Call):
        return ""
    function = _value(call.func, place)
    owner = getattr(function, "__self__", None)
    modules = (
        getattr(function, "__module__", None),
        getattr(owner, "__name__", None) if type(owner).__name__ == "module" else None,
        getattr(type(owner), "__module__", None) if owner is not None else None,
        getattr(type(function), "__module__", None),
    )
    return next((module for module in modules if isinstance(module, str) and module), "")


def _value(name: ast.expr, place: TracebackType) -> Any:
    """Return the value of a variable in an exception's stack frame, or None."""
    if isinstance(name, ast.Attribute):
        return getattr(_value(name.value, place), name.attr, None)
    if not isinstance(name, ast.Name):
        return None
    frame = place.tb_frame
    scopes = (frame.f_locals, frame.f_globals, vars(builtins))
    return next((scope[name.id] for scope in scopes if name.id in scope), None)


class RemoteSession:
    """Calls of one named neighbor list in a separate process.

    A crash of the process is a finding. After a crash, a new process is started.
    """

    most = np.inf  # seconds that an answer may take, where that is less than usual
    starts = 0  # how many were started

    def __init__(self, tested: PairList, reuse: bool = False, deadline: Deadline | None = None):
        self.tested, self.reuse = tested, reuse
        self.deadline = deadline or Deadline()
        self._process: subprocess.Popen[bytes] | None = None
        # what a library prints is no part of the report; its last words before a crash are
        self._printed: Any = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the session)
        self._from = 0

    def ask(self, case: Case) -> list[CallOutcome]:
        """Return the pairs or error of each call, up to the first error.

        Raises:
            TimeUp: the deadline passed during the call; the separate process is terminated.
        """
        outcomes: list[CallOutcome] = []
        try:
            process = self._process or self._start()
            try:
                _send(process.stdin, (case, self.reuse, self.tested.limits))
            except OSError as error:
                raise _Ended(self._how_it_ended(process)) from error
            # each step has its own time, which ends with its outcome
            seconds = min(CALL if case.atoms <= FEW else LONG, self.most)
            while (outcome := self._receive(process, seconds)) is not None:
                outcomes.append(outcome)
            return outcomes
        except _Ended as ended:
            self.close()
            return [*outcomes, CallOutcome(failure=ended.failure)]

    def close(self) -> None:
        """Terminate the separate process."""
        process, self._process = self._process, None
        if process is not None:
            with process:  # which closes its streams and waits for its end
                process.kill()

    def _start(self) -> subprocess.Popen[bytes]:
        self._from = self._printed.seek(0, os.SEEK_END)
        self.starts += 1
        self._process = subprocess.Popen(
            python("-m", __name__, self.tested.word, str(os.getpid())),
            env=environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._printed,
        )
        ready = self._receive(self._process, START)
        if isinstance(ready, Exception):
            raise ready
        return self._process

    def _receive(self, process: subprocess.Popen[bytes], seconds: float) -> Any:
        done, late = threading.Event(), list[str]()
        limits = process, seconds, self.deadline, done, late
        watch = threading.Thread(target=_watch, args=limits, daemon=True)
        watch.start()
        try:
            return _received(process.stdout)
        except EOFError as error:
            if self.deadline.passed:
                self.close()
                raise TimeUp from error
            if late:
                raise _Ended(Failure("NO_ANSWER", f"no answer within {seconds:.3g} s{late[0]}")) from error
            raise _Ended(self._how_it_ended(process)) from error
        finally:
            done.set()
            watch.join()

    def _how_it_ended(self, process: subprocess.Popen[bytes]) -> Failure:
        code = process.wait()
        if code >= 0:
            how = f"the process ended with exit code {code}"
        else:
            name = signal.Signals(-code).name if -code in {*signal.Signals} else f"signal {-code}"
            how = f"the process was ended by {name}"
        self._printed.seek(self._from)
        lines = self._printed.read().decode(errors="replace").strip().splitlines()
        return Failure("CRASHED", f"{how}: {lines[-1].strip()[:200]}" if lines else how)


class _Ended(Exception):
    """Raised when the separate process has ended; `failure` describes how it ended."""

    def __init__(self, failure: Failure):
        super().__init__(failure.text)
        self.failure = failure


def _watch(process: Any, seconds: float, deadline: Deadline, done: threading.Event, late: list[str]) -> None:
    """Kill a process after its time limit. Append to `late` whether the process computed or waited."""
    began, used = time.monotonic(), _processor_seconds(process.pid)
    left = seconds
    while not done.wait(min(left, deadline.left)):
        elapsed = time.monotonic() - began
        now = _processor_seconds(process.pid)
        spent = elapsed if used is None or now is None else now - used
        waits = elapsed >= seconds and spent < _IDLE * elapsed
        if spent >= seconds or waits or elapsed >= _MOST * seconds or deadline.passed:
            late.append(", in which it computed nothing" if waits else " of processor time")
            process.kill()
            return
        left = max(0.1, seconds - spent)


def _processor_seconds(process: int) -> float | None:
    """Return the processor time (s) of a process. None if unknown."""
    try:
        # the second word is the name of the program in brackets, which may hold blanks
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None  # another system, or the process is gone


def _send(stream: BinaryIO | Any, message: Any) -> None:
    pickle.dump(message, stream, protocol=pickle.HIGHEST_PROTOCOL)
    stream.flush()


def _received(stream: BinaryIO | Any) -> Any:
    try:
        return pickle.load(stream)
    except pickle.UnpicklingError as error:  # cut short
        raise EOFError from error


def serve(word: str, parent: int) -> None:
    """Run test cases from stdin on a neighbor list, in a separate process."""
    from mdnum.references.conformance.peers import load

    # a list may print: what it writes to stdout must not be taken for an answer
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    guard(parent)
    try:
        tested = load(word)
    except MdnumError as error:
        _send(answers, error)
        return
    _send(answers, "ready")
    sessions: dict[bool, Session] = {}
    while True:
        try:
            case, reuse, limits = _received(sys.stdin.buffer)
        except EOFError:
            return
        session = sessions.setdefault(reuse, Session(replace(tested, limits=limits), reuse))
        try:
            for outcome in session.outcomes(case):
                _send(answers, outcome)
        except MemoryError as error:
            _send(answers, CallOutcome(failure=Failure("RAISED", f"MemoryError: {error}")))
        _send(answers, None)


if __name__ == "__main__":
    # by its real name, under which outcomes are pickled
    from mdnum.references.conformance import session

    session.serve(sys.argv[1], int(sys.argv[2]))
