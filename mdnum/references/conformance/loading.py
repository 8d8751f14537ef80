"""From a word to a list: a library's by name, or anybody's as `module:function` or `file.py:function`."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from mdnum.errors import InputError
from mdnum.references.conformance.lists import KeptList, PairList, source_of


def known() -> tuple[PairList, ...]:
    """Every list that has a name here, installed or not."""
    from mdnum.references.conformance.kept_peers import KEPT_PEERS
    from mdnum.references.conformance.peers import PEERS

    return (*PEERS, *KEPT_PEERS)


def installed() -> tuple[PairList, ...]:
    """Those whose packages are there."""
    return tuple(one for one in known() if one.version is not None)


def load(word: str) -> PairList:
    """The list that a word names.

    Args:
        word: a name from `known()`, `package.module:function`, or `path/to/file.py:function`. The function
            takes (positions, cell, pbc, r_cut) and returns pairs as `answer.read` takes them; a class or an
            object with `allocate` and `update` is a list that is kept (`KeptList`).

    Raises:
        InputError: there is no such list, or it cannot be imported.
    """
    by_name = {one.name: one for one in known()}
    if word in by_name:
        found = by_name[word]
        if found.version is None:
            raise InputError(
                f"{word} needs {found.package}, which is not installed",
                remedy=f"Run python3 -m pip install {found.package}",
            )
        return replace(found, word=word)
    place, colon, attribute = word.rpartition(":")
    if not colon or not place:
        raise InputError(
            f"{word!r} is no list that is known here",
            remedy=f"Give {', '.join(sorted(by_name))}, package.module:function or file.py:function",
        )
    module = _module(place)
    made = module
    for part in attribute.split("."):
        if not hasattr(made, part):
            public = [name for name, value in vars(module).items() if callable(value) and name[0] != "_"]
            raise InputError(
                f"{place} has no {attribute!r}",
                remedy=f"It has {', '.join(public[:8])}" if public else "Give the name of a function in it",
            )
        made = getattr(made, part)
    shown = f"{Path(place).stem}:{attribute}" if place.endswith(".py") else word
    return replace(from_object(made, shown, source=_import_line(place, attribute)), word=word)


def from_object(made: Any, name: str | None = None, source: str | None = None) -> PairList:
    """A list from a function, from a class of lists that are kept, or from such a list.

    What it is declared to be is read from attributes of it, where it has them: `full` (bool), `unit`
    (roundoff), `superset` (bool), `limits` (`Limits`).

    Raises:
        InputError: it is none of these.
    """
    name = str(name or getattr(made, "__name__", type(made).__name__))
    kept = isinstance(made, KeptList) if not inspect.isclass(made) else _is_kept(made)
    if not kept and not callable(made):
        raise InputError(
            f"{name} is neither a function nor an object with allocate and update",
            remedy="Give a function of (positions, cell, pbc, r_cut) that returns (i, j)",
        )
    call: str = str(getattr(made, "__name__", None) or name.rpartition(":")[2])
    declared = {
        word: getattr(made, word)
        for word in ("full", "unit", "superset", "limits")
        if hasattr(made, word) and not callable(getattr(made, word))
    }
    make: Callable[[], Any] = made if kept and inspect.isclass(made) else (lambda: made)
    source = source_of(made) if source is None else source
    return PairList(name, make, kept=kept, source=source, call=call, **declared)


def _is_kept(made: type) -> bool:
    return callable(getattr(made, "allocate", None)) and callable(getattr(made, "update", None))


def _module(place: str) -> ModuleType:
    path = Path(place)
    try:
        if place.endswith(".py"):
            if not path.is_file():
                raise InputError("no such file", where=place, remedy="Give the path of a Python file")
            spec = importlib.util.spec_from_file_location(path.stem, path)
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules.setdefault(path.stem, module)
            spec.loader.exec_module(module)
            return module
        if "" not in sys.path:
            # as `python -m` does: what lies in the folder where one stands can be imported
            sys.path.insert(0, "")
        return importlib.import_module(place)
    except InputError:
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        raise InputError(
            f"cannot be imported: {type(error).__name__}: {error}",
            where=place,
            remedy="Install what it needs, or run where it can be found",
        ) from error


def _import_line(place: str, attribute: str) -> str:
    """What a script without mdnum begins with."""
    first, _, rest = attribute.partition(".")
    alias = f"\n{rest.rpartition('.')[2]} = {attribute}" if rest else ""
    if place.endswith(".py"):
        path = Path(place).resolve()
        return (
            f"import sys\nsys.path.insert(0, {str(path.parent)!r})\nfrom {path.stem} import {first}{alias}\n"
        )
    return f"from {place} import {first}{alias}\n"
