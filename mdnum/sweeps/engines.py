"""Who computes: any `concurrent.futures.Executor`; here processes that are started anew, one for each core.

An engine is only a way to start processes. What it says of a task is not believed: whether a point was
computed is asked of its folder, so that a worker that dies takes nothing with it but its own point.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from tempfile import TemporaryDirectory
from time import sleep
from typing import Any

from mdnum.errors import InputError
from mdnum.provenance import cores

#: Times that a point may take its process with it before it counts as failed.
_TRIES = 2
#: Times in a row that an engine may fail without an answer before it is given up.
_IDLE = 10
#: Tasks that an executor is given at a time, for each worker: a scheduler need not hold all of a sweep.
_AHEAD = 3


def _pinned(turns: str, width: int) -> None:
    """Gives a worker cores of its own: XLA takes all that it sees, and heeds no OMP_NUM_THREADS.

    Args:
        turns: a folder in which each worker takes the next number.
    """
    own = 0
    while True:
        try:
            os.close(os.open(f"{turns}/{own}", os.O_CREAT | os.O_EXCL))
            break
        except FileExistsError:
            own += 1
    with suppress(AttributeError, OSError):
        all_of_them = sorted(os.sched_getaffinity(0))
        first = own * width % len(all_of_them)
        os.sched_setaffinity(0, (all_of_them * 2)[first : first + width])


@contextmanager
def local(workers: int | None = None) -> Iterator[Callable[[], Executor]]:
    """Processes of this machine, which import no main program: a script needs no guard, a notebook nothing.

    Args:
        workers: default one for each core.

    Yields:
        what makes a pool, once more after one has broken.
    """
    from loky import get_reusable_executor  # noqa: F401 (its pool starts processes by fork and exec)
    from loky.backend.context import get_context
    from loky.process_executor import ProcessPoolExecutor

    count, width = workers or cores(), max(1, cores() // (workers or cores()))
    context = get_context("loky")
    with ExitStack() as stack:
        turns = stack.enter_context(TemporaryDirectory())
        made: list[Executor] = []

        def pool() -> Executor:
            for old in made:
                old.shutdown(wait=False, kill_workers=True)  # type: ignore[call-arg]
            made.clear()
            started = ProcessPoolExecutor(
                count, context=context, initializer=_pinned, initargs=(turns, width)
            )
            made.append(started)
            return started

        def ended() -> None:
            for old in made:
                old.shutdown(wait=False, kill_workers=True)  # type: ignore[call-arg]

        stack.callback(ended)
        yield pool


@contextmanager
def opened(on: str | Executor | None, workers: int | None) -> Iterator[tuple[Callable[[], Executor], int]]:
    """An engine: None, tcp://host:port of a dask scheduler, or an executor of one's own; with its workers.

    Raises:
        InputError: no such engine, or its package is missing.
    """
    if on is None:
        with local(workers) as pool:
            yield pool, workers or cores()
    elif not isinstance(on, str):
        yield lambda: on, workers or getattr(on, "_max_workers", cores())
    elif on.startswith(("tcp://", "tls://", "ucx://")):
        with _dask(on) as (pool, count):
            yield pool, workers or count
    else:
        raise InputError(f"--on {on!r}", remedy="Give tcp://host:port of a dask scheduler")


@contextmanager
def _dask(address: str) -> Iterator[tuple[Callable[[], Executor], int]]:
    try:
        from dask.distributed import Client
    except ImportError:
        remedy = "Run python3 -m pip install distributed"
        raise InputError("dask.distributed is not installed", where=address, remedy=remedy) from None
    try:
        client = Client(address, timeout="20s", set_as_default=False)
    except OSError as error:
        remedy = "Start it: dask scheduler; dask worker tcp://host:port"
        raise InputError(f"no dask scheduler answers: {error}", where=address, remedy=remedy) from None
    with client:
        # equal tasks are one to dask unless they are not pure, and what fails is retried by us
        made = client.get_executor(pure=False, retries=0)
        yield (lambda: made), max(sum(client.nthreads().values()), 1)


def computed(
    work: Callable[[Any], Any],
    tasks: Sequence[Any],
    *,
    on: str | Executor | None = None,
    workers: int | None = None,
    lost: Callable[[Any, str], bool] = lambda task, why: True,
) -> Iterator[tuple[Any, Any]]:
    """Tasks with what came of each, as they end.

    Args:
        work: of a task, in another process.
        lost: called with a task whose process ended without an answer, and why: whether it was at work on it.
            One that was twice is given up, with an exception as its answer; one that was not is begun again.

    Yields:
        (task, answer), the answer an exception where there is none.
    """
    waiting, tries, idle = deque(range(len(tasks))), [0] * len(tasks), 0
    with opened(on, workers) as (pool, width):
        executor = pool()
        running: dict[Future[Any], int] = {}
        try:
            while waiting or running:
                broken = ""
                while waiting and len(running) < _AHEAD * width and not broken:
                    k = waiting.popleft()
                    try:
                        running[executor.submit(work, tasks[k])] = k
                    except Exception as error:
                        waiting.appendleft(k)
                        broken = f"{type(error).__name__}: {error}"
                done = wait(running, return_when=FIRST_COMPLETED).done if running else ()
                for future in done:
                    k = running.pop(future)
                    error = _error(future)
                    if error is None:
                        idle = 0
                        yield tasks[k], future.result()
                        continue
                    broken = f"{type(error).__name__}: {error}".splitlines()[0]
                    tries[k] += lost(tasks[k], broken)
                    if tries[k] >= _TRIES:
                        idle = 0
                        yield tasks[k], error
                    else:
                        waiting.append(k)
                if not broken:
                    continue
                idle += 1
                if idle > _IDLE:
                    remedy = "Is it running, and does its environment have mdnum?"
                    raise InputError(f"no worker answers: {broken[:300]}", where="the engine", remedy=remedy)
                if on is None:
                    # whatever else the pool was given ends with it, and is begun again
                    for future, k in running.items():
                        if future.done() and _error(future) is None:
                            yield tasks[k], future.result()
                        else:
                            waiting.append(k)
                    running.clear()
                    executor = pool()
                else:
                    sleep(min(idle, 10))
        finally:
            for future in running:
                future.cancel()


def _error(future: Future[Any]) -> BaseException | None:
    """What a future that is done ended with, in place of an answer."""
    try:
        return future.exception()
    except CancelledError as cancelled:
        return cancelled
