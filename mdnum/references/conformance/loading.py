"""From a word to a list: a library's by name, or anybody's as `module:function` or `file.py:function`."""

from __future__ import annotations

import functools
import inspect
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from mdnum.errors import InputError
from mdnum.references.conformance.lists import KeptList, PairList, source_of
from mdnum.references.conformance.peers import LISTS
from mdnum.references.conformance.session import serve
from mdnum.references.load import place
from mdnum.registry import nearest

#: What a function, and the calls of a list that is kept, are given, in order.
_GIVEN = ("positions", "cell", "pbc", "r_cut")
_GIVEN_TO_KEPT = {"allocate": (*_GIVEN, "skin"), "update": ("positions", "cell")}
_WANTED = f"Give a function of ({', '.join(_GIVEN)}) that returns (i, j)"


def known() -> tuple[PairList, ...]:
    """Every list that has a name here, installed or not."""
    return tuple(_named(name) for name in LISTS)


def _named(name: str) -> PairList:
    listed = LISTS[name]
    if not isinstance(listed, PairList):
        package = LISTS.package(name)
        listed = replace(from_object(listed, name), package=package, description=LISTS.description(name))
    return replace(listed, word=name)


def installed() -> tuple[PairList, ...]:
    """Those whose packages are there."""
    return tuple(listed for listed in known() if listed.version is not None)


def load(word: str) -> PairList:
    """The list that a word names.

    Args:
        word: a name from `known()`, `package.module:function`, or `path/to/file.py:function`; see
            `mdnum.references.load`. The function takes (positions, cell, pbc, r_cut) and returns pairs as
            `answer.read` takes them; a class or an object with `allocate` and `update` is a list that is kept
            (`KeptList`).

    Raises:
        InputError: there is no such list, or it cannot be imported.
    """
    by_name = {listed.name: listed for listed in known()}
    if word in by_name:
        listed = by_name[word]
        if listed.version is None:
            raise InputError(
                f"{word} needs {listed.package}, which is not installed",
                remedy=f"Run python3 -m pip install {listed.package}",
            )
        return listed
    where = place(word)
    if where is None:
        close = nearest(word, by_name)
        raise InputError(
            f"{word!r} is no list that is known here",
            remedy=(f"Did you mean {close}? " if close else "")
            + f"Give {', '.join(sorted(by_name))}, package.module:function or file.py:function",
        )
    made = where.find()
    lines, call = where.source()
    listed = from_object(made, f"{Path(where.home).stem}:{where.call}" if where.is_file else word, lines)
    if "(" in call:
        # an object, or a function that another made: made anew for each life
        call = f"(lambda: {call})" if listed.kept else call
        return replace(listed, word=word, call=call, make=where.find)
    return replace(listed, word=word, call=call)


def from_object(made: Any, name: str | None = None, source: str | None = None) -> PairList:
    """A list from a function, from a class of lists that are kept, or from such a list.

    What it is declared to be is read from attributes of it, where it has them: `full` (bool), `unit`
    (roundoff), `superset` (bool), `limits` (`ListLimits`).

    Raises:
        InputError: it is none of these.
    """
    if isinstance(made, PairList):
        return made
    name = str(name or getattr(made, "__name__", type(made).__name__))
    kept = isinstance(made, KeptList) if not inspect.isclass(made) else _is_kept(made)
    if not kept and not callable(made):
        raise InputError(
            f"{name} is neither a function nor an object with allocate and update", remedy=_WANTED
        )
    _check_signatures(made, name, kept)
    declared = {
        word: getattr(made, word)
        for word in ("full", "unit", "superset", "limits")
        if hasattr(made, word) and not callable(getattr(made, word))
    }
    return PairList(
        name,
        made if kept and inspect.isclass(made) else lambda: made,
        kept,
        source=source_of(made) if source is None else source,
        call=str(getattr(made, "__name__", None) or name.rpartition(":")[2]),
        **declared,
    )


def _is_kept(made: type) -> bool:
    return callable(getattr(made, "allocate", None)) and callable(getattr(made, "update", None))


def _check_signatures(made: Any, name: str, kept: bool) -> None:
    """Raises InputError where a signature cannot take what the suite gives; what has none is let pass."""
    is_class = inspect.isclass(made)
    if is_class and not kept:
        lacks = [word for word in _GIVEN_TO_KEPT if not callable(getattr(made, word, None))]
        raise InputError(
            f"{name} is a class without {' and '.join(lacks)}",
            remedy="A list that is kept needs allocate and update" if len(lacks) < 2 else _WANTED,
        )
    calls: list[tuple[str, Any, tuple[str, ...]]] = [("", made, () if kept else _GIVEN)]
    if kept:
        calls = calls if is_class else []
        for word, given in _GIVEN_TO_KEPT.items():
            # of a class this is a function whose first argument is the object
            plain = is_class and inspect.isfunction(inspect.getattr_static(made, word))
            function = functools.partial(getattr(made, word), None) if plain else getattr(made, word)
            calls.append((f".{word}", function, given))
    for word, function, given in calls:
        try:
            signature = inspect.signature(function)
        except (TypeError, ValueError):
            continue
        try:
            signature.bind(*given)
        except TypeError as error:
            arguments = (
                "Let it take these, in this order" if given else "Give a class that is made without arguments"
            )
            raise InputError(
                f"{name}{word}{signature} cannot be called with ({', '.join(given)}): {error}",
                remedy=arguments if kept else _WANTED,
            ) from error


if __name__ == "__main__":
    serve(load, sys.argv[1])
