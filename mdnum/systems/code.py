"""Execution of Python files that a system file names, with the user's permission."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from mdnum.errors import InputError, in_a_line
from mdnum.safe_path import executed

_ALLOWED: ContextVar[bool] = ContextVar("allowed", default=False)


@contextmanager
def allow_code(allow: bool = True) -> Iterator[None]:
    """Allow the execution of Python files to which a system file refers.

    Example:
        >>> mdnum.allow_code()
        >>> mdnum.run("mine.toml")  # its [potential] names mine.py:morse

    Args:
        allow: False keeps the current permission.
    """
    before = _ALLOWED.set(allow or _ALLOWED.get())
    try:
        yield
    finally:
        _ALLOWED.reset(before)


def is_allowed() -> bool:
    """Return True if the user allows the execution of Python files."""
    return _ALLOWED.get()


def parts(place: str, folder: Path, where: str = "potential.function") -> tuple[Path, str]:
    """Split text such as "mine.py:morse" into file path and function name.

    Raises:
        InputError: the text does not have this form.
    """
    file, _, name = place.rpartition(":")
    if not file.endswith(".py") or not name.isidentifier():
        raise InputError(f"{place!r} does not have the form FILE.py:NAME", where=where)
    return folder / file, name


def function(place: str, folder: Path, where: str = "potential.function") -> Callable[..., Any]:
    """Execute a Python file and return the named function.

    Args:
        place: text such as "mine.py:morse", relative to folder.
        where: the key or option that names it, for messages.

    Raises:
        InputError: execution is not allowed, the file cannot be executed, or the function does not exist.
    """
    file, name = parts(place, folder, where)
    if not is_allowed():
        raise InputError(
            f"{where} refers to Python code ({file}:{name}), which is not executed without permission",
            where=where,
            remedy="Read the code; if you trust it, give --allow-code, or allow_code=True in Python",
        )
    if not file.is_file():
        raise InputError("file not found", where=str(file), remedy=f"Correct the file name in {where}")
    own = f"mdnum_code_{file.stem}"
    # anew each time: inspect reads the source of what is defined there now
    sys.modules.pop(own, None)
    try:
        module = executed(file, own)
    except Exception as error:
        raise InputError(f"the file cannot be executed: {in_a_line(error)}", where=str(file)) from error
    found = getattr(module, name, None)
    if not callable(found):
        raise InputError(f"the file has no function {name!r}", where=str(file), remedy=f"Correct {where}")
    return found
