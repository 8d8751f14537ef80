"""How a file of a folder is opened: whole or not there, never through a link, a full disk in one line."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Literal

from mdnum.errors import FolderError

#: Folders inside a folder; the folder itself may be a link, for that is the choice of whoever names it.
SUBFOLDERS = ("parts", "figures", "structures")

_REMEDIES = {
    errno.ENOSPC: ("the disk is full", "Free some space, then {again}"),
    errno.EDQUOT: ("the disk quota is used up", "Free some space, then {again}"),
    errno.EFBIG: ("the file would pass the size limit", "Raise the limit, then {again}"),
    errno.EACCES: ("permission denied", "Choose a folder that can be written to"),
    errno.EPERM: ("permission denied", "Choose a folder that can be written to"),
    errno.EROFS: ("the file system is read-only", "Choose a folder that can be written to"),
    errno.ENOTDIR: ("a part of the path is a file, not a folder", "Choose another folder"),
    errno.ENOENT: ("the folder is gone", "Do not move or remove a run folder while it is written"),
}
_MODES = {"rb": os.O_RDONLY, "r+b": os.O_RDWR, "ab": os.O_WRONLY | os.O_APPEND | os.O_CREAT}
# a pipe that stands where a file should be must not be waited for
_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turns what the operating system says about path into a FolderError with a remedy."""
    from mdnum.store.manifest import resumable

    try:
        yield
    except OSError as error:
        seen, remedy = _REMEDIES.get(error.errno or 0, (error.strerror or str(error), None))
        if remedy is not None:
            again = any(map(resumable, (path, path.parent, path.parent.parent)))
            remedy = remedy.format(again="continue with --resume" if again else "give the command again")
        raise FolderError(f"cannot write: {seen}", remedy=remedy, where=str(path)) from error


def opened(path: Path, mode: Literal["rb", "r+b", "ab"] = "rb") -> BinaryIO:
    """Opens a file of a folder, which has to be a file and no link to one.

    Args:
        mode: "r+b" and "ab" write where the file is, so that a second name of it elsewhere is refused too.

    Raises:
        FolderError: it is a link, or no plain file. OSError: as `open`.
    """
    refuse_link(path, in_place=mode != "rb")
    try:
        handle = os.open(path, _MODES[mode] | _NO_LINK, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _linked(path) from None
        raise
    _refuse(os.fstat(handle), path, mode != "rb", handle)
    return os.fdopen(handle, mode)


def refuse_link(path: Path, in_place: bool = False) -> None:
    """Refuses a file of a folder that leads out of it; one that is not there is none.

    Args:
        in_place: whether it is to be written where it is.

    Raises:
        FolderError: it, or the folder inside the folder that it is in, is a link; or it is no plain file.
    """
    if path.parent.name in SUBFOLDERS and path.parent.is_symlink():
        raise _linked(path.parent)
    with suppress(FileNotFoundError, NotADirectoryError):
        _refuse(os.lstat(path), path, in_place)


def subfolder(root: Path, name: str) -> Path:
    """A folder inside a folder, made where it is missing.

    Raises:
        FolderError: it is a link, or cannot be made.
    """
    path = root / name
    if path.is_symlink():
        raise _linked(path)
    with disk_errors(path):
        path.mkdir(exist_ok=True)
    return path


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new file under a name that nobody foresees, moved to path at the end: a kill leaves old or new.

    A link at path is replaced; what it led to stays as it is.
    """
    if path.parent.name in SUBFOLDERS and path.parent.is_symlink():
        raise _linked(path.parent)
    temporary = path.with_name(f".{secrets.token_hex(8)}.part")
    with disk_errors(path):
        try:
            handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | _NO_LINK, 0o666)
            with os.fdopen(handle, "w+b") as file:
                yield file
                file.flush()
                # without it a power cut may leave the new name on an empty file
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Replaces a file of a folder by data; where the folder's manifest lists it, the manifest follows.

    Raises:
        FolderError: the disk is full, or the folder cannot be written; nothing is left behind.
    """
    from mdnum.store import manifest

    # first both digests, then the file: it agrees with the manifest wherever a kill falls
    manifest.foretell(path, manifest.digest_of(data))
    with replacing(path) as file:
        file.write(data)


def write_text(path: Path, text: str) -> None:
    """As write_bytes, UTF-8."""
    write_bytes(path, text.encode())


def read_text(path: Path) -> str:
    """The text of a file of a folder; empty where it is not there.

    Raises:
        FolderError: it is a link, or not UTF-8.
    """
    try:
        with opened(path) as file:
            return file.read().decode("utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return ""
    except UnicodeDecodeError as error:
        raise FolderError(
            f"is damaged: not UTF-8 text ({error.reason} at byte {error.start})", where=str(path)
        ) from error
    except OSError as error:
        raise FolderError(f"cannot be read: {error.strerror}", where=str(path)) from error


def _refuse(seen: os.stat_result, path: Path, in_place: bool, handle: int | None = None) -> None:
    refused = None
    if stat.S_ISLNK(seen.st_mode):
        refused = _linked(path)
    elif not stat.S_ISREG(seen.st_mode):
        refused = FolderError("is no plain file", remedy="Remove it, or use another folder", where=str(path))
    elif in_place and seen.st_nlink > 1:
        refused = FolderError(
            "has a second name (a hard link), under which it would be changed too",
            remedy="Put a copy in its place",
            where=str(path),
        )
    if refused is not None:
        if handle is not None:
            os.close(handle)
        raise refused


def _linked(path: Path) -> FolderError:
    return FolderError(
        "is a link, and a folder's files are not looked for elsewhere",
        remedy="Put a copy in its place if it is yours",
        where=str(path),
    )
