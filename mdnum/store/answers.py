"""The file answers.json, from which a killed command can be resumed.

A command with many tests (`audit`, `conform`) keeps options and results in one dataclass. Important results
are written at once, other results about once per second. A resumed command restores all values, and runs the
remaining tests. The tables in the command's folder are created from the stored results.
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
    """Protocol of a state that can be stored, with the elapsed `seconds`."""

    seconds: float


T = TypeVar("T", bound=Timed)


class Answers(Generic[T]):
    """Writer that saves the state of a command in the command's folder.

    Args:
        folder: folder open for writing.
        state: state that is changed in place as results arrive; its `seconds` (total time) are updated.
    """

    def __init__(self, folder: RunFolder, state: T):
        self.folder, self.state = folder, state
        self._before, self._began, self._due = state.seconds, monotonic(), 0.0

    def save(self, urgent: bool = True) -> None:
        """Save the state for resuming the command. Unless `urgent`, save about once per second."""
        now = monotonic()
        self.state.seconds = self._before + now - self._began
        if urgent or now >= self._due:
            text = to_json(self.state, inf_nan_mode="constants", fallback=lambda value: value.tolist())
            write_text(self.folder.path / NAME, text.decode())
            # most of the time is for asking
            self._due = monotonic() + max(1.0, 20 * (monotonic() - now))


def take(path: str | Path, layout: Layout) -> RunFolder:
    """Open the folder of a command that is to be resumed. Other processes cannot write into this folder.

    Raises:
        FolderError: the folder has no state of this command, another process writes it, or it was changed.
    """
    folder = RunFolder.open(path)
    if folder.kind != layout.kind or not (folder.path / NAME).is_file():
        other = f"Resume it with `mdnum {folder.layout.command} --resume {path}`"
        remedy = other if manifest.resumable(folder.path) else f"Start a new `mdnum {layout.command}`"
        raise FolderError(f"no `mdnum {layout.command}` to resume here", remedy=remedy, where=str(path))
    folder.take(layout)
    return folder


def restored(folder: RunFolder, kind: type[T]) -> T:
    """Return the state of a command that is stored in a folder.

    Raises:
        FolderError: the file cannot be read, or contains another kind of state.
    """
    path = folder.path / NAME
    text = read_text(path)
    with restoring(path):
        return TypeAdapter(kind).validate_json(text, strict=True)
