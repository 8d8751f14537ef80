"""Protection against importing Python code from the current folder in place of installed packages.

With `-m` and `-c`, Python puts the current folder first on its import path. A file `jax.py` in an untrusted
folder would then be imported instead of the package. mdnum therefore starts every Python process with the
option `-P`. Child processes of multiprocessing inherit this option.
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
    """Return the command of a Python process that imports nothing from the current folder.

    Args:
        words: arguments of the interpreter: "-m", a module, and its arguments, or "-c" and a program.
    """
    return [sys.executable, "-P", *words]


def environment(**changes: str) -> dict[str, str]:
    """Return environment variables that make a child process import mdnum from the same location."""
    home = Path(__file__).resolve().parents[1]
    if home.name in ("site-packages", "dist-packages"):
        return {**os.environ, **changes}
    # a checkout may be found by nothing but the folder that this process was started in
    path = os.pathsep.join(filter(None, [str(home), os.environ.get("PYTHONPATH", "")]))
    return {**os.environ, "PYTHONPATH": path, **changes}


def guard(parent: int) -> None:
    """End this process when its parent process ends. Limit the process to half of the machine's memory.

    On systems other than Linux, a process ends only after a running C function has returned.

    Args:
        parent: process number of the parent process.
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
    """Execute a Python file as a module with the given name.

    Raises:
        BaseException: the code in the file raises this exception.
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
    """Append a folder to the import path. Files in the folder cannot hide installed packages.

    Args:
        folder: folder of the Python code that the user asked to run.
        module: module to be imported from the folder; if its package is installed, nothing changes.
    """
    place = str(Path(folder).resolve())
    if place not in sys.path and (module is None or not _is_installed(module.partition(".")[0])):
        sys.path.append(place)


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):
        return False
