"""Whether an exception says on purpose that something cannot be done, or came about by accident.

A refusal keeps a program from computing with wrong pairs and can be relied on. A `min()` of no distances is a
ValueError as well, and says no more than that nobody thought of such input.
"""

from __future__ import annotations

import dis
import linecache
import sys
from types import TracebackType

import numpy as np

#: Modules, beside Python's own, whose exceptions are about a call that the list made, not about its input.
_BORROWED = frozenset({"numpy", "scipy", "numba", "pandas", "torch", "jax", "jaxlib", "cupy", "ctypes"})
_CYTHON = (".pyx", ".pxd", ".pxi")


def meant(error: Exception, package: str | None = None) -> bool:
    """Whether an exception was raised on purpose by the list, as far as its traceback tells.

    Args:
        error: with its traceback.
        package: distribution of the list; what it raises itself in compiled code counts as meant.

    Returns:
        True where the innermost frame is the list's own and stands at a `raise`, of a ValueError or a
        RuntimeError with words; False where it is not, and where that cannot be told.
    """
    if not isinstance(error, ValueError | RuntimeError) or not str(error).strip():
        return False
    if isinstance(error, np.linalg.LinAlgError | RecursionError | UnicodeError):
        return False
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None:
        return False
    own = (package or "").replace("-", "_").lower()
    module = str(last.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
    if module.lower() != own and (module in _BORROWED or module in sys.stdlib_module_names - {"__main__"}):
        return False
    if last.tb_frame.f_code.co_filename.endswith(_CYTHON):
        return bool(own) and module.lower() == own
    return _at_raise(last)


def _at_raise(place: TracebackType) -> bool:
    """Whether a frame stands at a `raise` statement."""
    code, at = place.tb_frame.f_code.co_code, place.tb_lasti
    if 0 <= at < len(code) and dis.opname[code[at]] == "RAISE_VARARGS":
        return True
    # compiled code shows frames that name its lines and have no instructions
    line = linecache.getline(place.tb_frame.f_code.co_filename, place.tb_lineno)
    return len(code) < 16 and line.strip().startswith("raise ")
