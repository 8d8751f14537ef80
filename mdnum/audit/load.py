"""From words to a calculator: a class with its arguments, a Python file, or a system of mdnum."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError
from mdnum.safe_path import search_last
from mdnum.units import METAL, Units

if TYPE_CHECKING:
    from ase import Atoms

_NAMES = ("calculator", "calc", "make")

_WAYS = (
    "Say package.module:Class(argument=value), the path of a Python file that makes a calculator, "
    "or a system such as argon/liquid-864 (`mdnum systems` lists them)"
)

_counter = itertools.count()


@dataclass(frozen=True)
class Loaded:
    """A calculator by name.

    Attributes:
        name: what the person wrote.
        stem: a short word for a folder's name.
        make: makes a calculator object that remembers nothing of another.
        atoms: the structure that comes with it (a system of mdnum has one), or None.
        kT: energy of its temperature where it has one, eV; None otherwise.
        units: of its lengths and energies: those of ASE, or reduced ones for some systems of mdnum.
    """

    name: str
    stem: str
    make: Callable[[], Any]
    atoms: Atoms | None = None
    kT: float | None = None
    units: Units = METAL


def load_calculator(words: str) -> Loaded:
    """Find what words name, and make it once so that mistakes show here.

    A file is run anew for each calculator, so that no two share a buffer.

    Args:
        words: `package.module:Class(argument=value)` with literals as arguments; a Python file in which
            `calculator`, `calc` or `make()` is a calculator, or `file.py:name` or `file.py:Class(a=1)`; or
            the name or path of a system of mdnum.

    Raises:
        InputError: nothing by that name, arguments that are not literals, or making it failed; with what to
            write instead.
    """
    text = words.strip()
    if not text:
        raise InputError("no calculator named", remedy=_WAYS)
    path, after = _file_part(text)
    if path is not None:
        if not path.is_file():
            raise InputError("no such file", where=str(path), remedy=_WAYS)
        loaded = Loaded(text, path.stem, lambda: _of_file(path, after))
    elif ":" in text:
        module, _, call = text.partition(":")
        loaded = Loaded(text, _stem(call) or module, lambda: _of_module(module.strip(), call.strip(), text))
    else:
        return _of_system(text)
    _check(loaded.make(), text)
    return loaded


def _file_part(text: str) -> tuple[Path | None, str]:
    """(the Python file, what follows its colon), or (None, "") where no file is named."""
    if text.endswith(".py"):
        return Path(text).expanduser(), ""
    head, separator, after = text.partition(".py:")
    if separator:
        return Path(head + ".py").expanduser(), after.strip()
    return None, ""


def _stem(call: str) -> str:
    return call.partition("(")[0].rpartition(".")[2].strip()


def _of_module(module: str, call: str, text: str) -> Any:
    try:
        search_last(".", module)  # a module beside the person is found, too
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing = error.name or module
        if module == missing or module.startswith(missing + "."):
            raise InputError(
                f"there is no module {missing!r} in this environment",
                where=text,
                remedy=f"Install the package that has it, or correct the name. {_WAYS}",
            ) from None
        raise InputError(
            f"importing {module} needs {missing!r}, which is not installed",
            where=text,
            remedy=f"Install {missing}",
        ) from error
    except Exception as error:  # whatever a module raises while it is imported
        raise InputError(
            f"importing {module} failed: {_told(error)}", where=text, remedy="Import it in Python to see why"
        ) from error
    return _call(call, found, module, text)


def _of_file(path: Path, after: str) -> Any:
    """Run the file as a module of its own and take the calculator that it makes."""
    name = f"_mdnum_audited_{path.stem}_{next(_counter)}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError("cannot be run as a Python file", where=str(path), remedy=_WAYS)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickles look a module up by name
    try:
        # so that it can import its neighbors; unlike with `python file.py`, none of them hides a package
        search_last(path.parent)
        spec.loader.exec_module(module)
    except Exception as error:  # whatever a file raises
        del sys.modules[name]
        raise InputError(
            f"running it failed: {_told(error)}", where=str(path), remedy=f"See that `python {path}` runs"
        ) from error
    if after:
        return _call(after, module, str(path), f"{path}:{after}")
    for word in _NAMES:
        if hasattr(module, word):
            return _made(getattr(module, word), str(path))
    raise InputError(
        "makes no `calculator`, no `calc` and has no `make()`",
        where=str(path),
        remedy="Name the calculator `calculator`, or say file.py:name",
    )


def _call(call: str, scope: Any, scope_name: str, text: str) -> Any:
    """What `Class(argument=value)` means within a module; a name alone is called where it can be."""
    try:
        node = ast.parse(call, mode="eval").body
    except SyntaxError:
        raise InputError(
            f"{call!r} is not a name with arguments", where=text, remedy="Write Class(argument=value)"
        ) from None
    if not isinstance(node, ast.Call):
        return _made(_attribute(node, scope, scope_name, text), text)
    target = _attribute(node.func, scope, scope_name, text)
    arguments = [_literal(one, text) for one in node.args]
    keywords: dict[str, Any] = {}
    for keyword in node.keywords:
        if keyword.arg is None:
            raise InputError("** cannot be used here", where=text, remedy="Write the arguments out")
        keywords[keyword.arg] = _literal(keyword.value, text)
    if not callable(target):
        raise InputError(f"{_stem(call)} cannot be called", where=text, remedy="Leave the parentheses out")
    try:
        return target(*arguments, **keywords)
    except Exception as error:  # whatever a constructor raises
        raise InputError(
            f"making it failed: {_told(error)}", where=text, remedy="Correct the arguments"
        ) from error


def _attribute(node: ast.expr, scope: Any, scope_name: str, text: str) -> Any:
    """The object a dotted name means; nothing else is looked at, and nothing is evaluated."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name):
        raise InputError(
            "only a name, with literal arguments, can stand after the colon",
            where=text,
            remedy="For anything more, write a Python file that makes `calculator`, and name the file",
        )
    found, seen = scope, scope_name
    for part in reversed([*parts, node.id]):
        if not hasattr(found, part):
            near = _nearest(part, found)
            raise InputError(
                f"{seen} has no {part!r}",
                where=text,
                remedy=f"Did you mean {near}?" if near else "Correct the name",
            )
        found, seen = getattr(found, part), f"{seen}.{part}"
    return found


def _nearest(word: str, scope: Any) -> str | None:
    from mdnum.systems.messages import nearest

    return nearest(word, [name for name in dir(scope) if not name.startswith("_")])


def _literal(node: ast.expr, text: str) -> Any:
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError, SyntaxError):
        raise InputError(
            f"the argument {ast.unparse(node)} is not a literal (a number, text, True, None, a list, ...)",
            where=text,
            remedy="For anything more, write a Python file that makes `calculator`, and name the file",
        ) from None


def _made(value: Any, text: str) -> Any:
    """A calculator as it is; a class or a function is called without arguments."""
    if isinstance(value, type) or not _is_calculator(value):
        if not callable(value):
            return value
        try:
            return value()
        except Exception as error:  # whatever a constructor raises
            raise InputError(
                f"making it failed: {_told(error)}",
                where=text,
                remedy="Give the arguments it needs: Class(argument=value)",
            ) from error
    return value


def _is_calculator(value: Any) -> bool:
    if hasattr(value, "get_positions"):  # atoms, which pass the question on to their calculator
        return False
    return hasattr(value, "get_potential_energy") and hasattr(value, "get_forces")


def _check(value: Any, text: str) -> None:
    if isinstance(value, type) or not _is_calculator(value):
        raise InputError(
            f"that is a {type(value).__name__}, not an ASE calculator (an object with get_potential_energy "
            "and get_forces)",
            where=text,
            remedy=_WAYS,
        )


def _of_system(text: str) -> Loaded:
    from mdnum import systems

    try:
        system = systems.load(text, None, world="md")
    except InputError as error:
        if "." in text and "/" not in text and not text.endswith(".toml"):
            module, _, last = text.rpartition(".")
            raise InputError(
                f"{text!r} is no system of mdnum",
                remedy=f"For a class, put a colon before its name: {module}:{last}",
            ) from error
        raise InputError(
            f"{error.message}; nor is it a class or a Python file",
            where=error.where,
            remedy=f"{error.remedy}. {_WAYS}" if error.remedy else _WAYS,
        ) from error

    def make() -> Any:
        from mdnum.references.calculator import MdnumCalculator

        return MdnumCalculator(system)

    temperature = getattr(system.spec.dynamics, "temperature", None)
    kT = float(temperature) * system.units.k_B if temperature else None
    return Loaded(text, Path(text).stem.removesuffix(".toml"), make, system.atoms.copy(), kT, system.units)


def _told(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300] or 'no more detail'}"
