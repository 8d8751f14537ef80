"""answers.json: the answers that a verb has found so far, so that a killed verb continues with the rest.

A verb with many questions (`audit`, `conform`) keeps its options and its answers as one dataclass of plain
values. The file is written at once if an answer should not be lost, and otherwise within a second. A resumed
verb restores all values with their types, and processes the questions without an answer. Tables are made from
the answers.
"""

from __future__ import annotations

from pathlib import Path
from time import monotonic
from typing import Generic, Protocol, TypeVar

from pydantic import TypeAdapter
from pydantic_core import to_json

from mdnum.errors import FolderError
from mdnum.store import files as manifest
from mdnum.store.files import read_text, write_text
from mdnum.store.folder import RunFolder, restoring
from mdnum.store.layout import Layout

NAME = "answers.json"


class Timed(Protocol):
    """Dataclass of numbers, text, lists, tuples, dictionaries and further dataclasses."""

    seconds: float


T = TypeVar("T", bound=Timed)


class Answers(Generic[T]):
    """Writer of a verb's state into its folder.

    Args:
        folder: folder open for writing.
        state: state that is changed in place as answers arrive; its `seconds`, the time spent before, are
            updated.
    """

    def __init__(self, folder: RunFolder, state: T):
        self.folder, self.state = folder, state
        self._before, self._began, self._due = state.seconds, monotonic(), 0.0

    def save(self, urgent: bool = True) -> None:
        """Save the state from which a killed verb resumes; a save that is not urgent may be skipped."""
        now = monotonic()
        self.state.seconds = self._before + now - self._began
        if urgent or now >= self._due:
            text = to_json(self.state, inf_nan_mode="constants", fallback=lambda value: value.tolist())
            write_text(self.folder.path / NAME, text.decode())
            # most of the time is for asking
            self._due = monotonic() + max(1.0, 20 * (monotonic() - now))


def take(path: str | Path, layout: Layout) -> RunFolder:
    """Open the folder of a verb to be resumed; from here on, only this process writes the folder.

    Raises:
        FolderError: the folder has nothing of that verb to resume, another process writes it, or it was
            changed.
    """
    folder = RunFolder.open(path)
    if folder.kind != layout.kind or not (folder.path / NAME).is_file():
        other = f"Resume it with `mdnum {folder.layout.command} --resume {path}`"
        remedy = other if manifest.resumable(folder.path) else f"Start a new `mdnum {layout.command}`"
        raise FolderError(f"no `mdnum {layout.command}` to resume here", remedy=remedy, where=str(path))
    folder.take(layout)
    return folder


def restored(folder: RunFolder, kind: type[T]) -> T:
    """Return the state that is stored in a folder.

    Raises:
        FolderError: the file is not readable, or holds another kind of state.
    """
    path = folder.path / NAME
    text = read_text(path)
    with restoring(path):
        return TypeAdapter(kind).validate_json(text, strict=True)
