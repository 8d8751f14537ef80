"""Decorators that compile functions with numba, and store the compiled functions on disk if possible."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

from mdnum.errors import InputError

if numba.config.DISABLE_JIT:  # pyright: ignore
    raise InputError(
        "the environment variable NUMBA_DISABLE_JIT is set, but mdnum needs Numba to compile functions",
        remedy="Unset the variable",
    )

#: Note of the command line for a process that could not store all compiled functions.
NOT_KEPT = (
    "what was compiled cannot be kept, so that every command compiles it again: neither the installation nor "
    "a cache folder can be written. Set XDG_CACHE_HOME or NUMBA_CACHE_DIR to a folder that can be written."
)
_missed: list[Any] = []  # what could not be kept


def njit(function: Any = None, /, **options: Any) -> Any:
    """`numba.njit` that releases Python's global lock. Compiled functions are cached on disk if possible."""
    if function is None:
        return lambda function: njit(function, **options)
    return _kept(lambda keep: numba.njit(cache=keep, nogil=True, **options)(function))


def cfunc(signature: Any, function: Callable[..., Any]) -> Any:
    """`numba.cfunc` with compiled functions cached on disk if a cache folder is writable."""
    return _kept(lambda keep: numba.cfunc(signature, cache=keep)(function))


def all_kept() -> bool:
    """Return True if every function compiled so far is cached on disk."""
    # a function that was not called has not been compiled
    return not any(getattr(one, "signatures", True) for one in _missed)


def _kept(compiled: Callable[[bool], Any]) -> Any:
    try:
        made = compiled(True)
    except (OSError, RuntimeError) as error:
        # numba has no class for it
        if isinstance(error, RuntimeError) and "cannot cache" not in str(error):
            raise
        _missed.append(made := compiled(False))
        return made
    cache = getattr(made, "_cache", None)
    for name in ("load_overload", "save_overload"):
        if hasattr(cache, name):
            setattr(cache, name, _attempt(getattr(cache, name)))
    return made


def _attempt(use: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a method of numba's cache, to record errors from unreadable files or a full disk."""

    def attempt(*given: Any) -> Any:
        try:
            return use(*given)
        except OSError:
            _missed.append(None)

    return attempt
