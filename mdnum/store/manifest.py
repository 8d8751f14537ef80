"""manifest.json: what a folder is of, and a digest of every file in it that something is read from.

A file that changed since it was written, or is gone, is thereby known. Files that grow while a run goes on
(log.txt, trajectory.traj) are listed from its end on. A file that is about to be replaced has two digests,
its old and its new one, so that it agrees wherever a process is killed; "" among them: it may be missing.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mdnum.errors import FolderError
from mdnum.store.atomic import SUBFOLDERS, opened, read_text, replacing

NAME = "manifest.json"
#: May be missing.
ABSENT = ""
_CHUNK = 1 << 20
# listed from their first write on; scripts and structures among them, which a page or a person goes by
_FROM_THE_FIRST = re.compile(r"answers\.json|summary\.json|reproduce[\w.-]*\.py|structures/[^/]+\.extxyz")
# what a command goes on from, by the world of the folder
_STATE = {"md": "checkpoint.npz", "audit": "answers.json", "conform": "answers.json"}
_INSIDE = re.compile(rf"(({'|'.join(SUBFOLDERS)})/)?(?!\.{{1,2}}$)[^/\0]+")


@dataclass
class Manifest:
    """A folder's manifest.

    Attributes:
        world: which tables the folder has, a key of `TABLES`.
        finished: whether its writing came to an end.
        files: digests that a file may have, by its name in the folder.
    """

    world: str
    finished: bool = False
    files: dict[str, list[str]] = field(default_factory=dict)


def digest_of(data: bytes | memoryview) -> str:
    """Digest of the bytes of a file."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def digest(path: Path) -> str:
    """Digest of a file as it is; ABSENT where there is none."""
    try:
        with opened(path) as file:
            return digest_of_file(file)
    except FileNotFoundError:
        return ABSENT


def digest_of_file(file: BinaryIO) -> str:
    """Digest of all bytes of an open file."""
    file.seek(0)
    found = hashlib.blake2b(digest_size=16)
    while chunk := file.read(_CHUNK):
        found.update(chunk)
    return found.hexdigest()


def load(root: Path) -> Manifest | None:
    """The manifest of a folder; None where it has none (an older mdnum wrote none).

    Raises:
        FolderError: it is damaged.
    """
    path = root / NAME
    text = read_text(path)
    if not text and not path.exists():
        return None
    try:
        held = json.loads(text)
        stated = held.pop("digest")
        if stated != digest_of(_canonical(held)):
            raise ValueError("its digest is that of another text")
        files = {str(name): [str(one) for one in allowed] for name, allowed in held["files"].items()}
        # names of files in the folder, or in one of the folders in it
        if not all(map(_INSIDE.fullmatch, files)):
            raise ValueError("it lists files of elsewhere")
        return Manifest(str(held["world"]), bool(held["finished"]), files)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FolderError(
            "is damaged, so that the other files cannot be checked against it",
            remedy="Restore the folder from a copy, or remove this file to read the others unchecked",
            where=str(path),
        ) from error


def save(root: Path, made: Manifest) -> None:
    """Replaces the manifest of a folder."""
    held = {"world": made.world, "finished": made.finished, "files": dict(sorted(made.files.items()))}
    text = json.dumps({**held, "digest": digest_of(_canonical(held))}, indent=1)
    with replacing(root / NAME) as file:
        file.write(text.encode() + b"\n")


def update(
    root: Path, add: Mapping[str, list[str]], drop: Iterable[str] = (), finished: bool | None = None
) -> None:
    """Lists and forgets files; nothing where the folder has no manifest."""
    made = load(root)
    if made is None:
        return
    before = (dict(made.files), made.finished)
    made.files |= add
    for name in drop:
        made.files.pop(name, None)
    made.finished = made.finished if finished is None else finished
    if (made.files, made.finished) != before:
        save(root, made)


def place(path: Path) -> tuple[Path, str]:
    """(folder, name in it) of a file."""
    if path.parent.name in SUBFOLDERS and not (path.parent / NAME).exists():
        return path.parent.parent, f"{path.parent.name}/{path.name}"
    return path.parent, path.name


def foretell(path: Path, new: str) -> None:
    """Lets a file that the manifest lists have a new digest, beside the one it has."""
    root, name = place(path)
    if name == NAME or not (root / NAME).exists():
        return
    made = load(root)
    if made is None or (name not in made.files and not _FROM_THE_FIRST.fullmatch(name)):
        return
    known = made.files.get(name, [ABSENT])
    now = digest(path)
    allowed = [one for one in known if len(known) == 1 or one == now]
    if new not in allowed:
        made.files[name] = [*allowed, new]
        save(root, made)


def remove(path: Path) -> None:
    """Removes a file of a folder, and from its manifest."""
    root, name = place(path)
    update(root, {}, [name])
    path.unlink(missing_ok=True)


def resumable(root: Path) -> bool:
    """Whether the verb that made a folder would find something there to go on from."""
    with suppress(FolderError, OSError):
        made = load(root)
        if made is None:
            return any((root / name).exists() for name in _STATE.values())
        return made.world in _STATE and (root / _STATE[made.world]).exists()
    return False


def listed_files(root: Path, names: Iterable[str]) -> dict[str, list[str]]:
    """Digests of files as they are, those that are missing left out."""
    return {name: [digest(root / name)] for name in names if os.path.lexists(root / name)}


def _canonical(held: Mapping[str, object]) -> bytes:
    return json.dumps(held, sort_keys=True, separators=(",", ":")).encode()
