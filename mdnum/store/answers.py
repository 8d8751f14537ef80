"""answers.json: what a verb has found out so far, so that one that was killed goes on with the rest.

A verb that asks many questions (`audit`, `conform`) keeps its options and its answers as one dataclass of
plain values. It is written at once where an answer should not be lost and within a second otherwise; a
resumed verb gets it back, each value of the kind that it was, and asks what has no answer yet. Tables are
made from it.
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
    """A dataclass of numbers, text, lists, tuples, dictionaries and further dataclasses."""

    seconds: float


T = TypeVar("T", bound=Timed)


class Answers(Generic[T]):
    """Writes a state into its folder.

    Args:
        folder: open for writing.
        state: changed in place while answers come; its `seconds` are those spent before, and are kept up.
    """

    def __init__(self, folder: RunFolder, state: T):
        self.folder, self.state = folder, state
        self._before, self._began, self._due = state.seconds, monotonic(), 0.0

    def save(self, urgent: bool = True) -> None:
        """Makes this the point that a killed verb is resumed from; later, where that is soon enough."""
        now = monotonic()
        self.state.seconds = self._before + now - self._began
        if urgent or now >= self._due:
            text = to_json(self.state, inf_nan_mode="constants", fallback=lambda value: value.tolist())
            write_text(self.folder.path / NAME, text.decode())
            # most of the time is for asking
            self._due = monotonic() + max(1.0, 20 * (monotonic() - now))


def take(path: str | Path, layout: Layout) -> RunFolder:
    """The folder of a verb that is to be resumed, which from here on only this process writes.

    Raises:
        FolderError: nothing of that verb to resume, another process writes it, or it was changed.
    """
    folder = RunFolder.open(path)
    if folder.kind != layout.kind or not (folder.path / NAME).is_file():
        other = f"Resume it with `mdnum {folder.layout.command} --resume {path}`"
        remedy = other if manifest.resumable(folder.path) else f"Begin a new `mdnum {layout.command}`"
        raise FolderError(f"holds no `mdnum {layout.command}` to resume", remedy=remedy, where=str(path))
    folder.take(layout)
    return folder


def restored(folder: RunFolder, kind: type[T]) -> T:
    """The state that a folder was left with.

    Raises:
        FolderError: the file holds another kind of thing, or nothing that can be read.
    """
    path = folder.path / NAME
    text = read_text(path)
    with restoring(path):
        return TypeAdapter(kind).validate_json(text, strict=True)
