"""Files that are either whole or not there, and a full disk that says so."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mdnum.errors import FolderError

_REMEDIES = {
    errno.ENOSPC: ("the disk is full", "Free some space, then continue with --resume"),
    errno.EDQUOT: ("the disk quota is used up", "Free some space, then continue with --resume"),
    errno.EFBIG: ("the file would pass the size limit", "Raise the limit, then continue with --resume"),
    errno.EACCES: ("permission denied", "Choose a folder that can be written to"),
    errno.EPERM: ("permission denied", "Choose a folder that can be written to"),
    errno.EROFS: ("the file system is read-only", "Choose a folder that can be written to"),
    errno.ENOTDIR: ("a part of the path is a file, not a folder", "Choose another folder"),
    errno.ENOENT: ("the folder is gone", "Do not move or remove a run folder while it is written"),
}


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turns what the operating system says about path into a FolderError with a remedy."""
    try:
        yield
    except OSError as error:
        seen, remedy = _REMEDIES.get(error.errno or 0, (error.strerror or str(error), None))
        raise FolderError(f"cannot write: {seen}", remedy=remedy, where=str(path)) from error


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Writes a file under a temporary name and moves it into place, so that a kill leaves old or new.

    Raises:
        FolderError: the disk is full, or the folder cannot be written; nothing is left behind.
    """
    temporary = path.with_name(f".{path.name}.part")
    with disk_errors(path):
        try:
            with open(temporary, "wb") as file:
                file.write(data)
                file.flush()
                # without it a power cut may leave the new name on an empty file
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except OSError:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def write_text(path: Path, text: str) -> None:
    """As write_bytes, UTF-8."""
    write_bytes(path, text.encode())
