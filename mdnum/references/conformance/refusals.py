"""Whether an exception says on purpose that something cannot be done, or came about by accident.

A refusal keeps a program from computing with wrong pairs and can be relied on. A `min()` of no distances is a
ValueError as well, and says no more than that nobody thought of such input.
"""

from __future__ import annotations

import ast
import builtins
import dis
import linecache
import sys
import textwrap
from itertools import islice
from types import TracebackType
from typing import Any

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
        True where the innermost frame is the list's own and stands at a `raise`, or at a call of a library's
        compiled code that raised, of a ValueError, a RuntimeError or a class of the library's own, with
        words; False where it is not, and where that cannot be told.
    """
    own = (package or "").replace("-", "_").lower()
    made_for_it = _home(type(error).__module__, own)
    if not (isinstance(error, ValueError | RuntimeError) or made_for_it) or not str(error).strip():
        return False
    if isinstance(error, np.linalg.LinAlgError | RecursionError | UnicodeError):
        return False
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None:
        return False
    module = str(last.tb_frame.f_globals.get("__name__", ""))
    if not _home(module, own) and module != "__main__":
        return False
    if last.tb_frame.f_code.co_filename.endswith(_CYTHON):
        return bool(own) and module.partition(".")[0].lower() == own
    return _at_raise(last) or _home(_called(last), own)


def _home(module: str, own: str) -> bool:
    """Whether a module is a list's, rather than Python's or one that everybody computes with."""
    top = module.partition(".")[0]
    return bool(top) and (top.lower() == own or (top not in _BORROWED and top not in sys.stdlib_module_names))


def _called(place: TracebackType) -> str:
    """The module of the compiled function that a frame stands in a call of; empty where it is none."""
    code = place.tb_frame.f_code
    first, last, left, right = next(
        islice(code.co_positions(), max(0, place.tb_lasti // 2), None), (None, None, None, None)
    )
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
    return _module_of(_found(call.func, place)) if isinstance(call, ast.Call) else ""


def _found(name: ast.expr, place: TracebackType) -> Any:
    """What a name, or an attribute of one, stands for where an exception passed; None where unclear."""
    if isinstance(name, ast.Attribute):
        return getattr(_found(name.value, place), name.attr, None)
    if not isinstance(name, ast.Name):
        return None
    for names in (place.tb_frame.f_locals, place.tb_frame.f_globals, vars(builtins)):
        if name.id in names:
            return names[name.id]
    return None


def _module_of(function: Any) -> str:
    """Where a function comes from: its module, that of the object it belongs to, or that of its kind."""
    owner = getattr(function, "__self__", None)
    for found in (
        getattr(function, "__module__", None),
        getattr(owner, "__name__", None) if type(owner).__name__ == "module" else None,
        getattr(type(owner), "__module__", None) if owner is not None else None,
        getattr(type(function), "__module__", None),
    ):
        if isinstance(found, str) and found:
            return found
    return ""


def _at_raise(place: TracebackType) -> bool:
    """Whether a frame stands at a `raise` statement."""
    code, at = place.tb_frame.f_code.co_code, place.tb_lasti
    if 0 <= at < len(code) and dis.opname[code[at]] == "RAISE_VARARGS":
        return True
    # compiled code shows frames that name its lines and have no instructions
    line = linecache.getline(place.tb_frame.f_code.co_filename, place.tb_lineno)
    return len(code) < 16 and line.strip().startswith("raise ")
