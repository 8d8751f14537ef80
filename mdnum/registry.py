"""Registries of named objects (cutoffs, integrators, methods) from mdnum and from other packages.

A registry maps a name to a *value*: an object, or a class or function that creates it. Another package adds a
value by an entry point in the registry's group:

    [project.entry-points."mdnum.cutoffs"]
    "smooth-cubic" = "my_package.cutoffs:SmoothCubic"

The package is imported only when the name is used or described.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any, Generic, TypeVar

from mdnum.errors import InputError

T = TypeVar("T")
#: Longest name for which similar names are suggested; the search takes minutes for longer ones.
_LONGEST_WORD = 100


def meant(word: str, known: Iterable[str]) -> str:
    """Return "Did you mean ...? " with the most similar name, or ""."""
    folded = {option.lower(): option for option in known if len(word) <= _LONGEST_WORD}
    close = difflib.get_close_matches(word.lower(), folded, n=1)
    return f"Did you mean {folded[close[0]]}? " if close else ""


def unknown(noun: str, word: str, known: Iterable[str], *, where: str | None = None) -> InputError:
    """Return the error for an unknown name, with a list of known names."""
    known = list(known)
    remedy = f"{meant(word, known)}Choose from {', '.join(known)}"
    return InputError(f"unknown {noun} {word!r}", remedy=remedy, where=where)


def expect_known(noun: str, words: Iterable[str], known: Iterable[str], *, where: str | None = None) -> None:
    """Raise an error if a name is unknown.

    Raises:
        InputError: a name is unknown (see `unknown`); the message refers to the first such name.
    """
    known = list(known)
    for word in words:
        if word not in known:
            raise unknown(noun, word, known, where=where)


@functools.lru_cache
def _plugins(group: str, path: tuple[str, ...]) -> tuple[metadata.EntryPoint, ...]:
    # by the search path, which says whose entry points there are
    return tuple(sorted(metadata.entry_points(group=group), key=lambda point: point.name))


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Mapping from names to values. Values added by other packages come last."""

    noun: str  # what one of them is called, for messages
    group: str  # entry points by which other packages add theirs
    # class that a value is an instance or a subclass of; functions are taken at their word
    kind: type | None = None
    separator: str = "="  # between a name and its argument
    # called with a value of another package when it is loaded; raises where it is not what it says
    check: Callable[[Any], None] | None = None
    _own: dict[str, Any] = field(default_factory=dict, repr=False)
    _descriptions: dict[str, str] = field(default_factory=dict, repr=False)

    def add(self, name: str, value: Any = None, *, description: str | None = None) -> Any:
        """Add a value of mdnum, or decorate a class or function to add it.

        Args:
            name: name that users write.
            value: the value, or "module:attribute", or a "module", to import on first use.
            description: one line; by default the value's `description` or the first line of its docstring.
        """
        if value is None:
            return lambda decorated: self.add(name, decorated, description=description)
        if name in self._own:
            raise ValueError(f"the {self.noun} {name!r} was registered twice")
        self._own[name] = value
        if description:
            self._descriptions[name] = description
        return value

    @property
    def shipped(self) -> tuple[str, ...]:
        """Names of the values that mdnum itself provides."""
        return tuple(self._own)

    def _added(self) -> dict[str, metadata.EntryPoint]:
        added: dict[str, metadata.EntryPoint] = {}
        for point in _plugins(self.group, tuple(sys.path)):
            taken = "mdnum" if point.name in self._own else None
            if point.name in added and added[point.name].value != point.value:
                taken = _package(added[point.name])
            if taken:
                raise InputError(
                    f"the {self.noun} {point.name!r} of package {_package(point)} is already provided by "
                    f"{taken}",
                    remedy=f"Uninstall {_package(point)}, or use a version that renames the {self.noun}",
                )
            added[point.name] = point
        return added

    def __iter__(self) -> Iterator[str]:
        yield from self._own
        yield from self._added()

    def __contains__(self, name: object) -> bool:
        return name in self._own or name in self._added()

    def place(self, name: str) -> str:
        """Return the module that is registered under a name, without importing it.

        Raises:
            InputError: there is no such name.
        """
        if name in self._own:
            return self._own[name]
        if name not in self:
            raise unknown(self.noun, name, self)
        return self._added()[name].value

    def __getitem__(self, name: str) -> Any:
        """Return the value registered under a name.

        Raises:
            InputError: the name is unknown, or the package that adds this name is broken; the message lists
                the known names.
        """
        if name in self._own:
            value = self._own[name]
            if isinstance(value, str):
                module, _, attribute = value.partition(":")
                value = importlib.import_module(module)
                if attribute:
                    value = self._own[name] = getattr(value, attribute)
            return value
        point = self._added().get(name)
        if point is None:
            raise unknown(self.noun, name, self)
        try:
            loaded: Any = point.load()
            a_kind = isinstance(loaded, type) and issubclass(loaded, self.kind or object)
            if not (a_kind or inspect.isroutine(loaded) or isinstance(loaded, self.kind or object)):
                raise TypeError(f"{point.value} is not a {self.kind}")
            named = getattr(loaded, "name", None)
            if isinstance(named, str) and named != point.name:
                raise ValueError(f"it is named {named!r}")
            if self.check:
                self.check(loaded)
        except Exception as error:
            raise InputError(
                f"{self.noun} {name!r} of package {_package(point)} cannot be used: "
                f"{type(error).__name__}: {error}",
                remedy=f"Correct the package {_package(point)}, or uninstall it",
            ) from error
        return loaded

    def parse(self, text: str) -> T:
        """Return the value for a text of the form "name" or "name=argument".

        A class or function is called with the argument, if any. A class may have a method `parse` for the
        argument. Any other value is returned and cannot have an argument.

        Raises:
            InputError: the name is unknown, or an argument is unexpected or missing.
        """
        name, separator, argument = text.strip().partition(self.separator)
        found = self[name]
        value: Any = found
        makes = isinstance(value, type) or inspect.isroutine(value)
        if not makes and not separator:
            return found
        arguments = (argument,) if separator else ()
        maker: Any = getattr(value, "parse", value if makes else None) if separator else value
        try:
            inspect.signature(maker).bind(*arguments)
        except TypeError:
            wrong = "takes no argument" if separator else f"needs an argument: {name}{self.separator}..."
            raise InputError(f"the {self.noun} {name!r} {wrong}", remedy=self.description(name)) from None
        return maker(*arguments)

    def description(self, name: str) -> str:
        """Return a one-line description of the value registered under a name."""
        if name in self._descriptions:
            return self._descriptions[name]
        value = self[name]
        described = getattr(value, "description", None)
        if isinstance(described, str):
            return described
        return (inspect.getdoc(value) or "").partition("\n")[0].rstrip(".")

    def package(self, name: str) -> str:
        """Return the package that provides the value with a name."""
        return "mdnum" if name in self._own else _package(self._added()[name])


def _package(point: metadata.EntryPoint) -> str:
    return point.dist.name if point.dist else point.value.partition(".")[0].partition(":")[0]
