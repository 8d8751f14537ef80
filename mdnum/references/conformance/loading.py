"""From a word to a list: a library's by name, or anybody's as `module:function` or `file.py:function`."""

from __future__ import annotations

import difflib
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
from mdnum.safe_path import search_last

#: What a function and the calls of a list that is kept are given, in order.
_GIVEN = ("positions", "cell", "pbc", "r_cut")
_GIVEN_TO_KEPT = {"allocate": (*_GIVEN, "skin"), "update": ("positions", "cell")}
_NO_ARGUMENTS = "Give a class that is made without arguments, or an object"
_WANTED = f"Give a function of ({', '.join(_GIVEN)}) that returns (i, j)"


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
    if not colon and word.endswith(".py"):
        place, attribute = word, ""
    elif not colon or not place:
        close = difflib.get_close_matches(word, by_name, n=1)
        raise InputError(
            f"{word!r} is no list that is known here",
            remedy=(f"Did you mean {close[0]}? " if close else "")
            + f"Give {', '.join(sorted(by_name))}, package.module:function or file.py:function",
        )
    module = _module(place)
    made = module
    for part in attribute.split("."):
        if not hasattr(made, part):
            public = [name for name, value in vars(module).items() if callable(value) and name[0] != "_"]
            close = difflib.get_close_matches(attribute, public, n=1)
            has = f"Did you mean {close[0]}?" if close else f"It has {', '.join(public[:8])}"
            raise InputError(
                f"{place} has no {attribute!r}"
                if attribute
                else f"{place} is a file, and not a function in it",
                remedy=(has if attribute else f"Give {place}:{public[0]}. {has}")
                if public
                else "It has no function: give the name of one",
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
            remedy=_WANTED,
        )
    _can_be_called(made, name, kept)
    call: str = str(getattr(made, "__name__", None) or name.rpartition(":")[2])
    declared = {
        word: getattr(made, word)
        for word in ("full", "unit", "superset", "limits")
        if hasattr(made, word) and not callable(getattr(made, word))
    }
    make: Callable[[], Any] = made if kept and inspect.isclass(made) else (lambda: made)
    source = source_of(made) if source is None else source
    return PairList(name, make, kept=kept, source=source, call=call, **declared)


def _can_be_called(made: Any, name: str, kept: bool) -> None:
    """Raises InputError where a signature cannot take what the suite gives; what has none is let pass."""
    if inspect.isclass(made) and not kept:
        has = [word for word in ("allocate", "update") if callable(getattr(made, word, None))]
        lacks = " and ".join(word for word in ("allocate", "update") if word not in has)
        raise InputError(
            f"{name} is a class without {lacks}",
            remedy="A list that is kept needs allocate and update" if has else _WANTED,
        )
    calls = {"": (made, _GIVEN)}
    if kept:
        calls = {f".{word}": (getattr(made, word), given) for word, given in _GIVEN_TO_KEPT.items()}
        if inspect.isclass(made):
            calls[""] = (made, ())
    for word, (function, given) in calls.items():
        if word and inspect.isclass(made) and inspect.isfunction(inspect.getattr_static(made, word[1:])):
            # of a class this is a function whose first argument is the object
            given = ("self", *given)
        try:
            signature = inspect.signature(function)
        except (TypeError, ValueError):
            continue
        try:
            signature.bind(*given)
        except TypeError as error:
            given = tuple(one for one in given if one != "self")
            raise InputError(
                f"{name}{word}{signature} cannot be called with ({', '.join(given)}): {error}",
                remedy=_WANTED
                if not kept
                else "Let it take these, in this order"
                if given
                else _NO_ARGUMENTS,
            ) from error


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
        # what lies in the folder where one stands can be imported, too
        search_last(".", place)
        return importlib.import_module(place)
    except InputError:
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        remedy = "Mend what it does when it is imported"
        if isinstance(error, ImportError):
            remedy = "Install what it needs, or run where it can be found"
        elif isinstance(error, SyntaxError):
            remedy = "Mend that line"
        raise InputError(f"cannot be imported: {said}", where=place, remedy=remedy) from error


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
