"""Whose Python runs: that of the environment, never what lies in the folder in which one happens to stand.

Python puts the current folder first on its path for `-m` and `-c`: a `jax.py` or `numpy.py` in a stranger's
folder would be run instead of the package. Every process that mdnum starts therefore begins with `-P`, which
the processes of Python's multiprocessing inherit from it.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import signal
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import ModuleType


def python(*words: str) -> list[str]:
    """The command of a Python process that imports nothing from the current folder.

    Args:
        words: what follows the interpreter: "-m", a module, and its arguments, or "-c" and a program.
    """
    return [sys.executable, "-P", *words]


def environment(**changes: str) -> dict[str, str]:
    """The environment of a child, in which it finds mdnum where this process found it."""
    home = Path(__file__).resolve().parents[1]
    if home.name in ("site-packages", "dist-packages"):
        return {**os.environ, **changes}
    # a checkout may be found by nothing but the folder that this process was started in
    path = os.pathsep.join(filter(None, [str(home), os.environ.get("PYTHONPATH", "")]))
    return {**os.environ, "PYTHONPATH": path, **changes}


def guard(parent: int) -> None:
    """Ends this process with the one that started it, however that ends; it may use half of the memory.

    Where a foreign function loops and the system is not Linux, it ends when that function returns.

    Args:
        parent: process number of the one that started it.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    threading.Thread(target=watch, daemon=True).start()
    # control-C at a terminal reaches both, and who started it decides
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(ImportError, OSError, ValueError):
        import resource

        # a grid of cells over a huge box is a MemoryError, not a machine that swaps
        have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        resource.setrlimit(resource.RLIMIT_DATA, (have // 2, resource.getrlimit(resource.RLIMIT_DATA)[1]))


def executed(file: Path, name: str) -> ModuleType:
    """What a Python file holds once it was run, as a module that has this name unless another has it.

    Raises:
        BaseException: whatever the file raises.
    """
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None  # of every file that ends in .py
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(name, module)  # inspect, dataclasses and pickles look a module up by its name
    try:
        spec.loader.exec_module(module)
    except BaseException:
        if sys.modules.get(name) is module:
            del sys.modules[name]
        raise
    return module


def search_last(folder: str | Path, module: str | None = None) -> None:
    """Lets imports find what lies in a folder, as the last place: nothing there can hide a package.

    Args:
        folder: of the Python that a person asked to be run.
        module: what is wanted from there; where the environment has its package, nothing changes.
    """
    place = str(Path(folder).resolve())
    if place not in sys.path and (module is None or not _is_installed(module.partition(".")[0])):
        sys.path.append(place)


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):
        return False
