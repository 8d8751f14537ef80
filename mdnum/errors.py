"""Exceptions that say what was seen, what was expected and what to do."""

from __future__ import annotations

from pathlib import Path


class MdnumError(Exception):
    """Base of every error that mdnum raises on purpose.

    Args:
        message: what was seen and what was expected.
        remedy: what to do about it, an imperative sentence.
        where: the file, key or step at fault.
    """

    exit_code = 2

    def __init__(self, message: str, *, remedy: str | None = None, where: str | None = None):
        self.message = message
        self.remedy = remedy
        self.where = where
        parts = [f"{where}: {message}" if where else message]
        if remedy:
            parts.append(remedy)
        super().__init__(" ".join(part if part.endswith((".", "?", "!")) else part + "." for part in parts))


class InputError(MdnumError):
    """What a person wrote cannot be run: a system file, an option, a structure."""


class FolderError(InputError):
    """A run folder cannot be written, read or resumed."""


class CapacityError(MdnumError):
    """A neighbor list would need more room than it can have."""


class NumericalError(MdnumError):
    """A number that must be finite is not.

    Args:
        folder: the run folder that holds everything up to that number.
    """

    def __init__(
        self,
        message: str,
        *,
        remedy: str | None = None,
        where: str | None = None,
        folder: Path | None = None,
    ):
        super().__init__(message, remedy=remedy, where=where)
        self.folder = folder
