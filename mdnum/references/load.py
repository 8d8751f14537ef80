"""Load a Python object named by `package.module:thing(argument=value)` or `file.py:thing(argument=value)`.

The module is imported, or the file is executed. If arguments are given, the object is called. Arguments must
be literals; nothing else is evaluated.
"""

from __future__ import annotations

import ast
import importlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from mdnum.errors import InputError, in_a_line
from mdnum.registry import meant
from mdnum.safe_path import executed, search_last

_counter = itertools.count()


@dataclass(frozen=True)
class NamedObject:
    """Location of a Python object, as written by the user."""

    text: str  # the words
    home: str  # a module, or the path of a Python file
    # what stands after the colon: a dotted name, with literal arguments or without; may be empty for a file
    call: str

    @property
    def is_file(self) -> bool:
        """True if `home` is the path of a Python file."""
        return self.home.endswith(".py")

    @property
    def name(self) -> str:
        """Last part of the dotted name, or the file's stem."""
        return self.call.partition("(")[0].rpartition(".")[2].strip() or Path(self.home).stem

    def find(self, defaults: Sequence[str] = (), anew: bool = False) -> Any:
        """Return the object.

        Args:
            defaults: names to look for in a file given without a name.
            anew: execute a file again, so that two of its objects share no data.

        Raises:
            InputError: the module, file or name does not exist, an argument is not a literal, or importing or
                calling failed; the message gives the correct form.
        """
        module = self._module(anew)
        if not self.call:
            return self._default(module, defaults)
        try:
            node = ast.parse(self.call, mode="eval").body
        except SyntaxError:
            message = f"{self.call!r} is not the name of a function or class, with or without arguments"
            raise self._wrong(message, "Write thing(argument=value)") from None
        if not isinstance(node, ast.Call):
            return self._attribute(node, module)
        target = self._attribute(node.func, module)
        arguments = [self._literal(argument) for argument in node.args]
        if any(keyword.arg is None for keyword in node.keywords):
            raise self._wrong("** cannot be used here", "Write the arguments out")
        keywords: Any = {keyword.arg: self._literal(keyword.value) for keyword in node.keywords}
        if not callable(target):
            raise self._wrong(f"{self.name} cannot be called", "Leave the parentheses out")
        try:
            return target(*arguments, **keywords)
        except Exception as error:
            raise self._wrong(
                f"it could not be constructed: {in_a_line(error)}", "Correct the arguments"
            ) from error

    def source(self) -> tuple[str, str]:
        """Return Python code that creates the object without mdnum."""
        first = self.call.partition("(")[0].partition(".")[0].strip()
        if not self.is_file:
            return f"from {self.home} import {first}\n", self.call
        path = Path(self.home).expanduser().resolve()
        lines = f"import sys\nsys.path.insert(0, {str(path.parent)!r})\nfrom {path.stem} import {first}\n"
        return lines, self.call

    def _wrong(self, message: str, remedy: str) -> InputError:
        return InputError(message, where=self.text, remedy=remedy)

    def _module(self, anew: bool) -> ModuleType:
        path = Path(self.home).expanduser()
        if self.is_file and not path.is_file():
            raise InputError("the file is missing", where=self.home, remedy="Give the path of a Python file")
        try:
            if not self.is_file:
                search_last(".", self.home)  # a module beside the person is found, too
                return importlib.import_module(self.home)
            # it can import its neighbors; unlike with `python file.py`, none of them hides a package
            search_last(path.parent)
            return executed(path, f"_mdnum_{path.stem}_{next(_counter)}" if anew else path.stem)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # whatever a module raises while it is imported, SystemExit too
            remedy = "Correct the code that runs when the module is imported"
            if isinstance(error, ImportError):
                missing = getattr(error, "name", None)
                remedy = f"Install {missing}, or correct the name" if missing else "Install its dependencies"
            elif isinstance(error, SyntaxError):
                remedy = "Correct this line"
            message = f"cannot be imported: {in_a_line(error)}"
            raise InputError(message, where=self.home, remedy=remedy) from error

    def _default(self, module: ModuleType, defaults: Sequence[str]) -> Any:
        for name in defaults:
            if hasattr(module, name):
                return getattr(module, name)
        values, names = vars(module), public(module)
        # what a file imports is not suggested, unless it has nothing else
        own = [name for name in names if getattr(values[name], "__module__", None) == module.__name__]
        names = own or names
        lacks = f", which has no {' or '.join(defaults)}" if defaults else ", not an object in it"
        has = f"Give {self.home}:{names[0]}. It has {', '.join(names[:8])}" if names else "It has no function"
        raise InputError(f"{self.home} is a file{lacks}", remedy=has)

    def _attribute(self, node: ast.expr, module: ModuleType) -> Any:
        """Return the object with the given dotted name in a module."""
        parts: list[str] = []
        while isinstance(node, ast.Attribute):
            parts.append(node.attr)
            node = node.value
        if not isinstance(node, ast.Name):
            raise self._wrong(
                "only a name, with literal arguments, can stand after the colon",
                "Write a Python file, and name it",
            )
        value, where = module, self.home
        for part in reversed([*parts, node.id]):
            if not hasattr(value, part):
                names = public(value)
                has = ", ".join(names[:8]) or "no function: give the name of one"
                remedy = meant(part, names).rstrip() or f"It has {has}"
                raise InputError(f"{where} has no attribute {part!r}", remedy=remedy)
            value, where = getattr(value, part), f"{where}.{part}"
        return value

    def _literal(self, node: ast.expr) -> Any:
        try:
            return ast.literal_eval(node)
        except (ValueError, TypeError, SyntaxError):
            raise self._wrong(
                f"the argument {ast.unparse(node)} is not a literal (a number, text, True, a list, ...)",
                "For anything more, write a Python file that makes it, and name the file",
            ) from None


def place(text: str) -> NamedObject | None:
    """Parse the location of an object. Return None if the text has no file or `module:`."""
    text = text.strip()
    head, separator, call = text.partition(".py:")
    if separator:
        return NamedObject(text, f"{head}.py", call.strip())
    if text.endswith(".py"):
        return NamedObject(text, text, "")
    home, colon, call = text.partition(":")
    return NamedObject(text, home.strip(), call.strip()) if colon and home and call else None


def public(scope: Any) -> list[str]:
    """Return the names of the public callables of a module or a class."""
    scope = scope if isinstance(scope, ModuleType | type) else type(scope)
    return [name for name in vars(scope) if name[0] != "_" and callable(getattr(scope, name, None))]
