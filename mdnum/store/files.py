"""Access to files in a run folder: atomic replacement and rejection of links."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from itertools import count
from pathlib import Path
from typing import BinaryIO, Literal

from mdnum.errors import FolderError
from mdnum.reading import whole_text
from mdnum.store.layout import Layout
from mdnum.version import __version__

#: Folders inside a folder, which must not be links; the folder itself may be one.
SUBFOLDERS = ("parts", "figures", "structures")
#: Files that describe the simulation: a system file, or the description of a simulation built from objects.
SYSTEM_FILE, SIMULATION_FILE = "system.toml", "simulation.json"

_REMEDIES = {
    errno.ENOSPC: ("the disk is full", "Free some space, then {again}"),
    errno.EDQUOT: ("the disk quota is used up", "Free some space, then {again}"),
    errno.EFBIG: ("the file would pass the size limit", "Raise the limit, then {again}"),
    errno.EACCES: ("permission denied", "Choose a folder that can be written to"),
    errno.EPERM: ("permission denied", "Choose a folder that can be written to"),
    errno.EROFS: ("the file system is read-only", "Choose a folder that can be written to"),
    errno.EEXIST: ("a file of this name is there", "Choose another folder"),
    errno.ENOTDIR: ("a part of the path is a file, not a folder", "Choose another folder"),
    errno.ENOENT: ("the folder is gone", "Do not move or remove a run folder while it is written"),
}
_MODES = {"rb": os.O_RDONLY, "r+b": os.O_RDWR, "ab": os.O_WRONLY | os.O_APPEND | os.O_CREAT}
# a pipe that stands where a file should be must not be waited for
_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Convert operating-system errors at a path to a FolderError, which suggests a remedy."""
    try:
        yield
    except OSError as error:
        seen, remedy = _REMEDIES.get(error.errno or 0, (error.strerror or str(error), None))
        if remedy is not None:
            again = any(map(resumable, (path, path.parent, path.parent.parent)))
            remedy = remedy.format(again="continue with --resume" if again else "give the command again")
        raise FolderError(f"cannot write: {seen}", remedy=remedy, where=str(path)) from error


def opened(path: Path, mode: Literal["rb", "r+b", "ab"] = "rb") -> BinaryIO:
    """Open a file in a run folder. Raise an error for a link or an irregular file.

    Args:
        mode: "r+b" and "ab" write in place, so a file with a second name (a hard link) is also rejected.

    Raises:
        FolderError: the path is a link, or not a regular file. OSError: the file cannot be opened.
    """
    refuse_link(path, in_place=mode != "rb")
    try:
        handle = os.open(path, _MODES[mode] | _NO_LINK, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _linked(path) from None
        raise
    file = os.fdopen(handle, mode)
    try:
        _refuse(os.fstat(handle), path, mode != "rb")
    except FolderError:
        file.close()
        raise
    return file


def refuse_link(path: Path, in_place: bool = False) -> None:
    """Raise an error for a link or an irregular file. A missing file is allowed.

    Args:
        in_place: True if the file will be written in place.

    Raises:
        FolderError: the file or its subfolder is a link, or the file is not a regular file.
    """
    if path.parent.name in SUBFOLDERS and path.parent.is_symlink():
        raise _linked(path.parent)
    with suppress(FileNotFoundError, NotADirectoryError):
        _refuse(os.lstat(path), path, in_place)


def subfolder(root: Path, name: str) -> Path:
    """Return a subfolder of a run folder. Create the subfolder if missing.

    Raises:
        FolderError: the subfolder is a link, or cannot be created.
    """
    path = root / name
    if path.is_symlink():
        raise _linked(path)
    with disk_errors(path):
        path.mkdir(exist_ok=True)
    return path


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file that replaces the file at `path` when closed.

    A symbolic link at `path` is replaced. The file to which the link points is not changed.
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
    """Replace the contents of a file. Update the file's entry in the manifest, if any.

    Raises:
        FolderError: the disk is full, or the folder cannot be written; no partial file remains.
    """
    # first both digests, then the file: it agrees with the manifest wherever a kill falls
    foretell(path, digest_of(data))
    with replacing(path) as file:
        file.write(data)


def write_text(path: Path, text: str) -> None:
    """Replace the contents of a file by text in UTF-8. `write_bytes` describes the errors."""
    write_bytes(path, text.encode())


def read_text(path: Path) -> str:
    """Return the text of a file in a run folder. "" if the file does not exist.

    Raises:
        InputError: the file is a link, is not UTF-8, or is too large.
    """
    try:
        with opened(path) as file:
            return whole_text(file, path)
    except (FileNotFoundError, NotADirectoryError):
        return ""
    except UnicodeDecodeError as error:
        raise FolderError(
            f"the file is damaged: it is not UTF-8 ({error.reason} at byte {error.start})", where=str(path)
        ) from error
    except OSError as error:
        raise FolderError(f"the file cannot be read: {error.strerror}", where=str(path)) from error


def _refuse(seen: os.stat_result, path: Path, in_place: bool) -> None:
    if stat.S_ISLNK(seen.st_mode):
        raise _linked(path)
    if not stat.S_ISREG(seen.st_mode):
        raise FolderError("the path is not a regular file", remedy="Use another folder", where=str(path))
    if in_place and seen.st_nlink > 1:
        seen_so = "the file has a second name (a hard link), and would change there too"
        raise FolderError(seen_so, remedy="Replace the file by a copy", where=str(path))


def _linked(path: Path) -> FolderError:
    return FolderError(
        "the file is a link; expected a regular file in the result folder",
        remedy="If you trust the linked file, replace the link with a copy of the file",
        where=str(path),
    )


# --- manifest.json: what a folder is of, and a digest of every file in it that something is read from -

NAME = "manifest.json"
#: Digest of a file that may be missing.
ABSENT = ""
_INSIDE = re.compile(rf"(({'|'.join(SUBFOLDERS)})/)?(?!\.{{1,2}}$)[^/\0]+")


@dataclass
class Manifest:
    """Manifest of a run folder: layout, state and digests of files."""

    layout: Layout | None  # what the folder holds; None where an earlier mdnum wrote it, which did not say
    finished: bool = False  # whether its writing came to an end
    # digests that a file may have, by its name in the folder
    files: dict[str, list[str]] = field(default_factory=dict)
    version: str = __version__  # of the mdnum that began it


def digest_of(data: bytes | memoryview) -> str:
    """Return the hash digest of the given bytes."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def digest(path: Path) -> str:
    """Return the current digest of a file. ABSENT if the file does not exist."""
    try:
        with opened(path) as file:
            return digest_of_file(file)
    except FileNotFoundError:
        return ABSENT


def digest_of_file(file: BinaryIO) -> str:
    """Return the digest of all bytes of an open file."""
    file.seek(0)
    found = hashlib.blake2b(digest_size=16)
    while chunk := file.read(1 << 20):
        found.update(chunk)
    return found.hexdigest()


def load(root: Path) -> Manifest | None:
    """Return the manifest of a run folder. None if there is no manifest, as in older versions.

    Raises:
        FolderError: the manifest is damaged.
    """
    path = root / NAME
    text = read_text(path)
    if not text and not path.exists():
        return None
    try:
        held = json.loads(text)
        stated = held.pop("digest")
        if stated != digest_of(_canonical(held)):
            raise ValueError("the checksum in the manifest does not match the manifest's content")
        files = {str(name): [str(one) for one in allowed] for name, allowed in held["files"].items()}
        # names of files in the folder, or in one of the folders in it
        if not all(map(_INSIDE.fullmatch, files)):
            raise ValueError("the manifest lists files outside of its result folder")
        layout = None
        if "kind" in held:
            # an earlier mdnum described columns of its own alone
            layout = Layout(**{one.name: {"described": None, **held}[one.name] for one in fields(Layout)})
        return Manifest(layout, bool(held["finished"]), files, str(held.get("version", "")))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FolderError(
            "the manifest is damaged, so the other files in the folder cannot be verified",
            remedy="Restore the folder from a copy; its parquet files can still be read one at a time",
            where=str(path),
        ) from error


def save(root: Path, made: Manifest) -> None:
    """Write the manifest of a run folder, and replace the old manifest."""
    held = {**asdict(made), "files": dict(sorted(made.files.items()))}
    if made.layout is not None:
        held = {**held.pop("layout"), "tables": made.layout.spelled, **held}
    text = json.dumps({**held, "digest": digest_of(_canonical(held))}, indent=1)
    with replacing(root / NAME) as file:
        file.write(text.encode() + b"\n")


def update(
    root: Path,
    add: Mapping[str, list[str]],
    drop: Iterable[str] = (),
    finished: bool | None = None,
    layout: Layout | None = None,
) -> None:
    """Add, remove and change entries of a manifest. Do nothing if there is no manifest."""
    made = load(root)
    if made is None:
        return
    before = (dict(made.files), made.finished, made.layout)
    made.files |= add
    for name in drop:
        made.files.pop(name, None)
    made.finished = made.finished if finished is None else finished
    made.layout = layout or made.layout
    if (made.files, made.finished, made.layout) != before:
        save(root, made)


def place(path: Path) -> tuple[Path, str]:
    """Return the run folder of a file, and the file's name in this folder."""
    if path.parent.name in SUBFOLDERS and not (path.parent / NAME).exists():
        return path.parent.parent, f"{path.parent.name}/{path.name}"
    return path.parent, path.name


def foretell(path: Path, new: str) -> None:
    """Add the digest of a file's new contents to the manifest. The present digest stays."""
    root, name = place(path)
    if name == NAME or not (root / NAME).exists():
        return
    made = load(root)
    # those of its kind are listed from their first write on
    if made is None or not (name in made.files or (made.layout is not None and made.layout.keeps(name))):
        return
    known = made.files.get(name, [ABSENT])
    now = digest(path)
    allowed = [one for one in known if len(known) == 1 or one == now]
    if new not in allowed:
        made.files[name] = [*allowed, new]
        save(root, made)


def remove(path: Path) -> None:
    """Remove a file from a folder, and from the folder's manifest."""
    root, name = place(path)
    update(root, {}, [name])
    path.unlink(missing_ok=True)


def resumable(root: Path) -> bool:
    """Return True if a command can be resumed from a run folder."""
    with suppress(FolderError, OSError):
        made = load(root)
        state = "" if made is None or made.layout is None else made.layout.resumes_from
        return state != "" and (root / state).exists()
    return False


def listed_files(root: Path, names: Iterable[str]) -> dict[str, list[str]]:
    """Return the current digests of files, except for missing files."""
    return {name: [digest(root / name)] for name in names if os.path.lexists(root / name)}


def _canonical(held: Mapping[str, object]) -> bytes:
    return json.dumps(held, sort_keys=True, separators=(",", ":")).encode()


# --- where a run goes when nobody says ----------------------------------------------------------------

_RUNS = Path("runs")


def default_folder(system: str, runs: Path = _RUNS) -> Path:
    """Create the new folder runs/NAME-N with the system's name and the first unused number N.

    The folder is created at once, so that simultaneous processes get different folders.

    Args:
        system: name of a system, or the path of its file.
        runs: folder that contains all run folders.

    Raises:
        FolderError: the folder cannot be created.
    """
    path = Path(system)
    word = path.stem if path.suffix == ".toml" else system
    slug = re.sub(r"[^A-Za-z0-9._]+", "-", word).strip("-.") or "run"
    taken = re.compile(re.escape(slug) + r"-(\d+)")
    with disk_errors(runs):
        runs.mkdir(parents=True, exist_ok=True)
        numbers = [int(match[1]) for entry in runs.iterdir() if (match := taken.fullmatch(entry.name))]
        for number in count(max(numbers, default=0) + 1):
            with suppress(FileExistsError):
                (made := runs / f"{slug}-{number}").mkdir()
                return made
    raise AssertionError
