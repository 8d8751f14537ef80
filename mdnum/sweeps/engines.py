"""Execution of tasks by a `concurrent.futures.Executor`, by default in processes on all cores.

An engine (executor) only starts worker processes. The folder of a sweep point shows whether the point was
computed. If a worker process dies, only the point in progress is therefore lost.
"""

from __future__ import annotations

import os
import pickle
import secrets
import socket
import subprocess
import sys
import tempfile
import threading
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager, suppress
from copy import deepcopy
from functools import cache, partial
from pathlib import Path
from time import sleep
from typing import Any

from mdnum.errors import InputError, MdnumError
from mdnum.provenance import cores
from mdnum.reading import whole_text
from mdnum.safe_path import guard
from mdnum.sweeps.points import code
from mdnum.systems import toml
from mdnum.systems.code import allow_code, is_allowed

#: Number of times that the process of a task may die before the task counts as failed; the last time the task
#: runs alone.
TRIES = 3
#: Number of consecutive failures of an engine without a result after which the sweep ends.
_IDLE = 10
#: Number of tasks per worker that are submitted to an executor at a time, so that a scheduler need not hold
#: all tasks of a sweep.
_AHEAD = 3
#: Seconds between checks whether an engine that returns no results still exists.
_LOOK = 5.0


@cache
def _pinned(width: int) -> None:
    """Restrict this process to reserved cores. XLA uses all visible cores despite OMP_NUM_THREADS.

    A file lock reserves a core. The file lock is released when the process ends. Sweeps on the same machine
    therefore use different cores. If no core is free, two processes use the same core.
    """
    with suppress(ImportError, AttributeError, OSError):
        import fcntl

        locks = Path(tempfile.gettempdir(), f"mdnum-cores-{os.getuid()}")
        locks.mkdir(mode=0o700, exist_ok=True)
        seen, mine = sorted(os.sched_getaffinity(0)), []
        for core in seen:
            lock = os.open(locks / str(core), os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                mine.append(core)
            except BlockingIOError:
                os.close(lock)
            if len(mine) == width:
                break
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), mine or [seen[os.getpid() % len(seen)]])


def _answered(
    work: Callable[[Any], Any], task: Any, caller: tuple[str, int, str, bool], width: int
) -> tuple[Any, Exception | None]:
    """Return the result of a task, or the exception that the task raised."""
    host, pid, versions, allowed = caller
    if (socket.gethostname(), os.getpid()) != (host, pid):
        _pinned(width)
    try:
        if code(everywhere=True) != versions:
            raise InputError(
                "a worker uses a different version of mdnum, jax or numpy than the process that started it",
                where=f"{sys.prefix} on {socket.gethostname()}",
                remedy="Use the same environment in all processes: results depend on package versions",
            )
        with allow_code(allowed):
            return work(task), None
    except Exception as error:
        with suppress(Exception):
            pickle.loads(pickle.dumps(error))
            return None, error
        return None, RuntimeError(f"{type(error).__name__}: {error}")


class TaskEngine:
    """An executor of tasks. A broken executor can be replaced."""

    def __init__(
        self, make: Callable[[], Executor], width: int, threads: int,
        end: Callable[[Executor], Any] | None = None, breaks: type[BaseException] = BrokenExecutor,
        lives: Callable[[], bool] = lambda: True,
    ):  # fmt: skip
        self.make, self.end = make, end
        self.width = width  # tasks at a time
        self.threads = threads  # cores of each
        self.breaks = breaks  # what its futures end with when none of them will have an answer
        self.lives = lives  # false: none of its futures ends any more
        self.executor = make()

    def again(self) -> None:
        """Replace the executor by a new one if possible. Tasks of the previous executor are lost."""
        self.close()
        with suppress(Exception):
            self.executor = self.make()

    def close(self) -> None:
        if self.end is not None:
            with suppress(Exception):
                self.end(self.executor)


def _local(workers: int | None) -> TaskEngine:
    """Return an engine of local processes. Worker processes do not import the user's main script."""
    from loky import get_reusable_executor  # noqa: F401 (its pool starts processes by fork and exec)
    from loky.backend import resource_tracker
    from loky.backend.context import get_context
    from loky.process_executor import ProcessPoolExecutor

    count = workers or cores()
    context, of = get_context("loky"), (os.getpid(),)
    # loky replaces a worker that has grown by 300 MB, which compiled programs take soon; guard limits memory
    env = {"LOKY_MAX_MEMORY_LEAK_SIZE": "1e15", "PYTHONSAFEPATH": "1"}
    # a file of the current folder must not take the place of a module in the processes that loky starts
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        resource_tracker.ensure_running()
    finally:
        os.environ.pop("PYTHONSAFEPATH")
        os.environ.update({} if before is None else {"PYTHONSAFEPATH": before})
    return TaskEngine(
        lambda: ProcessPoolExecutor(count, context=context, initializer=guard, initargs=of, env=env), count,
        max(1, cores() // count), lambda pool: pool.shutdown(wait=False, kill_workers=True),  # type: ignore[call-arg]
    )  # fmt: skip


def _dask(address: str, workers: int | None) -> TaskEngine:
    try:
        from dask.distributed import Client
    except ImportError:
        remedy = "Run python3 -m pip install distributed"
        raise InputError("dask.distributed is not installed", where=address, remedy=remedy) from None
    clients: list[Client] = []

    def make() -> Executor:
        clients[:] = [Client(address, timeout="20s", set_as_default=False)]
        # equal tasks are one to dask unless they are not pure, and what fails is tried again here
        return clients[0].get_executor(pure=False, retries=0)

    try:
        engine = TaskEngine(make, 1, 1, lambda _: clients[0].close(timeout=5))
    except OSError as error:
        remedy = "Start the scheduler and a worker: dask scheduler; dask worker tcp://host:port"
        raise InputError(f"cannot connect to the scheduler: {error}", where=address, remedy=remedy) from None
    of_each: Any = clients[0].nthreads()
    threads = list(of_each.values())
    engine.width, engine.threads = workers or max(sum(threads), 1), max(threads, default=1)
    return engine


def _executorlib(file: str, workers: int | None) -> TaskEngine:
    """Return an executorlib engine. A TOML file gives its class (default: SLURM jobs) and keywords."""
    try:
        import executorlib  # pyright: ignore[reportMissingImports]
        from executorlib.api import ExecutorlibSocketError  # pyright: ignore[reportMissingImports]
    except ImportError:
        remedy = "Run python3 -m pip install 'mdnum[slurm]'"
        raise InputError("executorlib is not installed", where=file, remedy=remedy) from None
    given = toml.parse(whole_text(Path(file), file), file)
    name, resources = given.pop("executor", "SlurmClusterExecutor"), given.pop("resource_dict", {})
    resources = {"cwd": str(Path(file).resolve().with_suffix("")), **resources}
    job = f"mdnum-{secrets.token_hex(4)}"
    if name == "SlurmClusterExecutor":
        resources["job_name"] = job
    # without blocks each task has a process of its own, and one that equals an earlier one has its answer
    keywords = {**given, "block_allocation": True, "init_function": partial(_ends_with, os.getpid()),
                "resource_dict": resources, **({"max_workers": workers} if workers else {})}  # fmt: skip

    feeders: list[threading.Thread] = []

    def make() -> Executor:
        before, made = set(threading.enumerate()), list[Any]()

        def begin() -> None:
            try:
                with warnings.catch_warnings(action="ignore"):
                    # it knows no keys of a queue's own, and takes them
                    made.append(getattr(executorlib, name)(**deepcopy(keywords)))
            except Exception as error:
                made.append(error)

        # its threads are daemons as this one is: what waits for a job does not keep Python from its end
        maker = threading.Thread(target=begin, daemon=True)
        maker.start()
        maker.join()
        if isinstance(made[0], Exception):
            remedy = "Give executor, max_workers and a table resource_dict, as executorlib describes them"
            raise InputError(f"{name}: {made[0]}", where=file, remedy=remedy)
        feeders[:] = set(threading.enumerate()) - before
        return made[0]

    def end(executor: Executor) -> None:
        executor.shutdown(wait=False, cancel_futures=True)
        for thread in feeders:
            thread.join(2)
        if "job_name" in resources:
            # of those at work: the others have ended their jobs
            subprocess.run(["scancel", f"--name={job}"], capture_output=True)

    return TaskEngine(
        make, int(keywords.get("max_workers", 1)), int(resources.get("threads_per_core", 1)), end,
        ExecutorlibSocketError, lambda: all(thread.is_alive() for thread in feeders),
    )  # fmt: skip


def _ends_with(parent: int) -> dict[str, Any]:
    """End this worker process when its parent process on the same machine ends."""
    if os.getppid() == parent:
        guard(parent)
    return {}


@contextmanager
def opened(on: str | Executor | TaskEngine | None, workers: int | None) -> Iterator[TaskEngine]:
    """Context manager: yield the engine for a dask address, a file or an executor. None: local processes.

    An executor that the caller passes remains open.

    Raises:
        InputError: the engine is unknown, or its package is not installed.
    """
    if isinstance(on, TaskEngine):
        yield on
        return
    if on is None:
        engine = _local(workers)
    elif not isinstance(on, str):
        width = workers or getattr(on, "_max_workers", cores())
        engine = TaskEngine(lambda: on, width, max(1, cores() // width))
    elif on.startswith(("tcp://", "tls://", "ucx://")):
        engine = _dask(on, workers)
    elif on.endswith(".toml"):
        engine = _executorlib(on, workers)
    else:
        raise InputError(f"unknown scheduler {on!r}", remedy="Give a dask address (tcp://...) or .toml file")
    try:
        yield engine
    finally:
        engine.close()


def computed(
    work: Callable[[Any], Any],
    tasks: Sequence[Any],
    *,
    on: str | Executor | TaskEngine | None = None,
    workers: int | None = None,
    lost: Callable[[Any, str], bool] = lambda task, why: True,
) -> Iterator[tuple[Any, Any]]:
    """Run tasks in worker processes. Yield each task with its result when the task has finished.

    Args:
        work: function that processes a task, in another process.
        lost: called with a task whose process ended without a result, and the reason; returns whether the
            process was working on the task. A task that fails three times in this way, the last time alone,
            is abandoned; other tasks are restarted.

    Yields:
        (task, result), where the result is an exception if there is none.

    Raises:
        InputError: no such engine, or an engine that fails repeatedly.
    """
    waiting, alone, tries, idle = deque(range(len(tasks))), deque[int](), [0] * len(tasks), 0
    caller = socket.gethostname(), os.getpid(), code(everywhere=True), is_allowed()
    with opened(on, workers) as engine:
        running: dict[Future[Any], int] = {}
        try:
            while waiting or alone or running:
                failed, broken = "", False
                # what may have been lost by a neighbor's fault shows whose it is when it has none
                some, room = (waiting, _AHEAD * engine.width) if waiting or not alone else (alone, 1)
                while some and len(running) < room and not broken:
                    try:
                        future = engine.executor.submit(
                            _answered, work, tasks[some[0]], caller, engine.threads
                        )
                        running[future] = some.popleft()
                    except Exception as error:
                        failed, broken = f"{type(error).__name__}: {error}", True
                ended = set[Future[Any]]()
                if running:
                    ended = wait(running, _LOOK, FIRST_COMPLETED).done
                    if not ended and not engine.lives():
                        # such as jobs that a queue refuses: not for longer than it may have been down
                        failed, broken, idle = "its workers were not started", True, idle + _IDLE // 3
                if any(isinstance(_error(future), engine.breaks) for future in ended):
                    # all of its futures end
                    ended = wait(running).done
                for future in ended:
                    k = running.pop(future)
                    error = _error(future)
                    if error is None:
                        idle, (answer, wrong) = 0, future.result()
                        yield tasks[k], answer if wrong is None else wrong
                        continue
                    failed = f"{type(error).__name__}: {error}".splitlines()[0]
                    broken = broken or isinstance(error, (engine.breaks, CancelledError))
                    tries[k] += lost(tasks[k], failed)
                    if tries[k] >= TRIES:
                        yield tasks[k], error
                    else:
                        (alone if tries[k] == TRIES - 1 else waiting).append(k)
                if not failed:
                    continue
                idle += 1
                if idle > _IDLE or (broken and engine.end is None):
                    remedy = "Check that the engine is running and that mdnum is installed in its environment"
                    raise InputError(f"no worker responds: {failed[:300]}", where="the engine", remedy=remedy)
                sleep(min(idle - 1, 10))
                if broken:
                    waiting.extend(running.values())
                    running.clear()
                    engine.again()
        finally:
            for future in running:
                future.cancel()


@contextmanager
def requested(on: str | Executor | None, workers: int | None) -> Iterator[TaskEngine | None]:
    """Yield the requested engine, or None (this process) if none was requested."""
    if on is None and workers is None:
        yield None
        return
    with opened(on, workers) as engine:
        yield engine


def in_order(
    work: Callable[[Any], Any], tasks: Iterable[Any], engine: TaskEngine | None, *, keep: bool = False
) -> Generator[Any, None, None]:
    """Yield the results of tasks in the order of the tasks.

    Args:
        work: function that processes a task; the result must not depend on the process.
        tasks: with None as engine, a task is taken and processed only when its result is requested.
        keep: whether to yield the error of a task instead of raising it.

    Raises:
        MdnumError: a task failed, or three processes that were working on it ended without a result.
    """
    if engine is None:
        for task in tasks:
            try:
                result = work(task)
            except Exception as error:
                if not keep:
                    raise
                result = _as_error(error)
            yield result
        return
    found, next_one = dict[int, Any](), 0
    for (k, _), result in computed(partial(_numbered, work), list(enumerate(tasks)), on=engine):
        found[k] = result
        if isinstance(result, BaseException):
            found[k] = _as_error(result)
        while next_one in found:
            result, next_one = found.pop(next_one), next_one + 1
            if isinstance(result, MdnumError) and not keep:
                raise result
            yield result


def _as_error(error: BaseException) -> MdnumError:
    if isinstance(error, MdnumError):
        return error
    return MdnumError(f"a task failed: {type(error).__name__}: {error}")


def _numbered(work: Callable[[Any], Any], task: tuple[int, Any]) -> Any:
    return work(task[1])


def _error(future: Future[Any]) -> BaseException | None:
    """Return the exception of a finished future, or None."""
    try:
        return future.exception()
    except CancelledError as cancelled:
        return cancelled
