"""Whose Python runs: that of the environment, never what lies in the folder in which one happens to stand.

Python puts the current folder first on its path for `-m` and `-c`: a `jax.py` or `numpy.py` in a stranger's
folder would be run instead of the package. Every process that mdnum starts therefore begins with `-P`, which
the processes of Python's multiprocessing inherit from it.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path


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
