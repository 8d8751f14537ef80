"""Exceptions whose messages state what was found, what was expected, and a remedy."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

# control characters, what turns or hides text, and halves of characters that no terminal can be given
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    "\ud800-\udfff\U000e0000-\U000e007f]"
)
_LONG_WORD = re.compile(r"\S{200,}")
_LONGEST = 800


def python_escape(character: str) -> str:
    """Return Python's escape sequence of a nonprintable character."""
    return character.encode("unicode_escape").decode()


def json_escape(character: str) -> str:
    """Return JSON's escape sequence of a character."""
    return json.dumps(character)[1:-1]


def printable(text: str, escape: Callable[[str], str] = python_escape) -> str:
    """Escape all characters of untrusted text that a terminal would interpret.

    Control characters are written in Python notation, such as ``\x1b``. Line ends and tabs are kept.
    Characters that reorder or hide text are also escaped.
    """
    return _CONTROL.sub(lambda found: escape(found[0]), text)


def shortened(text: str) -> str:
    """Shorten a message: the middle of long words and long texts is removed."""
    text = _LONG_WORD.sub(lambda found: _without_middle(found[0], 100), text)
    return _without_middle(text, _LONGEST)


def _without_middle(text: str, kept: int) -> str:
    half = kept // 2
    if len(text) <= kept:
        return text
    return f"{text[:half]}[{len(text) - 2 * half:,} more]{text[-half:]}"


class MdnumError(Exception):
    """Base class of all errors that mdnum raises intentionally.

    Control characters in the message are escaped, and long quoted texts are shortened.

    Example:
        >>> try:
        ...     mdnum.run("mine.toml")
        ... except mdnum.MdnumError as error:
        ...     print(error)

    Args:
        message: the observation and the expectation.
        remedy: an imperative sentence that tells the user what to do.
        where: the file, key or step at fault.
    """

    exit_code = 2

    def __init__(self, message: str, *, remedy: str | None = None, where: str | None = None):
        self.message = message = shortened(printable(message))
        self.remedy = remedy = remedy and shortened(printable(remedy))
        self.where = where = where and _without_middle(printable(where), 500)
        parts = [f"{where}: {message}" if where else message]
        if remedy:
            parts.append(remedy)
        super().__init__(" ".join(part if part.endswith((".", "?", "!")) else part + "." for part in parts))

    def __reduce__(self) -> tuple[Any, ...]:
        # by its attributes, not by a call: a pool of workers hangs where the error of one cannot be restored
        return _restored, (type(self), self.args, self.__dict__)


def _restored(kind: type[MdnumError], args: tuple[Any, ...], held: dict[str, Any]) -> MdnumError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(held)
    return error


class InputError(MdnumError):
    """Raised if a system file, an option or a structure cannot be used."""


class FolderError(InputError):
    """Raised if a run folder cannot be written, read or resumed."""


class CapacityError(MdnumError):
    """Raised if a neighbor list would exceed its maximum size."""


class NumericalError(MdnumError):
    """Raised if a number that must be finite is infinite or NaN.

    Args:
        folder: the run folder, which contains all results before this number.
    """

    def __init__(self, message: str, *, folder: Path | None = None, **more: Any):
        super().__init__(message, **more)
        self.folder = folder


def in_a_line(error: BaseException) -> str:
    """Return the type and message of another package's exception in one line."""
    words = " ".join(str(error).split())[:300]
    return f"{type(error).__name__}: {words}" if words else type(error).__name__


def expect_at_least(least: int, **numbers: int) -> None:
    """Raise an error if a number is below its minimum.

    Raises:
        InputError: a number is below its minimum; the message contains the name of the first such number.
    """
    for name, number in numbers.items():
        if number < least:
            raise InputError(f"{name} = {number}; expected at least {least}")


def expect_path(given: object, remedy: str) -> None:
    """Raise an error if an argument is not a path.

    Raises:
        InputError: the object is not a path; the message contains its type and shape, but not its contents.
    """
    if not isinstance(given, str | os.PathLike):
        shape = getattr(given, "shape", None)
        kind = type(given).__name__ + ("" if shape is None else f" of shape {shape}")
        raise InputError(f"an object of type {kind} was given; expected a path", remedy=remedy)
