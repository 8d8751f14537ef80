"""Which frames of a file: `run.xtc@100:`, `run.xtc@::10`, `run.xtc@5`, as ASE writes it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from mdnum.errors import InputError

_WORD = re.compile(r"(-?\d+)?(:(-?\d+)?(:(-?\d+)?)?)?")


def split_path(text: str) -> tuple[Path, str]:
    """A path, and what stands behind its last @; a file whose own name has an @ is found as it is.

    Args:
        text: as a person writes it.

    Returns:
        the path, and the words of the slice ("" for all frames).
    """
    whole = Path(text).expanduser()
    name, at, words = text.rpartition("@")
    if not at or whole.exists():
        return whole, ""
    path = Path(name).expanduser()
    # words that name no frames are said to where the file is there without them
    return (path, words) if _WORD.fullmatch(words) or path.is_file() else (whole, "")


def parse_slice(words: str, where: str = "") -> slice:
    """The slice that words say: "100:", "::10", "-50:", "5" (that frame alone), "" (all).

    Raises:
        InputError: the words are no slice, or go backward: flips follow time.
    """
    match = _WORD.fullmatch(words.strip())
    if match is None:
        raise InputError(
            f"{words!r} names no frames",
            remedy="Write START:STOP:STEP, for example 100: or ::10 or -50:, or the number of one frame",
            where=where or None,
        )
    start, colon, stop, _, step = match.groups()
    if colon is None:
        if start is None:
            return slice(None)
        first = int(start)
        return slice(first, first + 1 or None)
    stride = 1 if step is None else int(step)
    if stride < 1:
        raise InputError(
            f"the frames {words!r} go backward or nowhere",
            remedy="Write a stride of 1 or more: flips follow time",
            where=where or None,
        )
    return slice(None if start is None else int(start), None if stop is None else int(stop), stride)


def counts_from_end(frames: slice) -> bool:
    """Whether the number of frames has to be known to say which they are."""
    return any(end is not None and end < 0 for end in (frames.start, frames.stop))


def chosen(frames: slice, count: int | None) -> Iterator[int]:
    """The numbers of the frames, upward; without an end where neither slice nor file says one.

    Args:
        frames: of `parse_slice`.
        count: frames in the file, or None where they were not counted.
    """
    if count is not None:
        yield from range(*frames.indices(count))
        return
    if counts_from_end(frames):
        raise InputError("frames are counted from the end, and this file does not say how many there are")
    number, stop, step = frames.start or 0, frames.stop, frames.step or 1
    while stop is None or number < stop:
        yield number
        number += step
