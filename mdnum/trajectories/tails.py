"""What stands behind the last whole frame of a file, which readers leave out without a word.

A run that was killed, a copy that was cut and a frame whose head is damaged all look like the end of the file
to MDAnalysis's readers of dcd, trr and some text formats. A number cut in the middle is read as another one.
"""

from __future__ import annotations

import bz2
import gzip
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from mdnum.trajectories.boxes import formats_of
from mdnum.trajectories.netcdf import head_of

# magic, length of the word with its end, length of the word, the word; then thirteen numbers
_TRR = struct.Struct(">3i12s13i")
_TRR_MAGIC = 1993
# readers of text by lines, and where each has its open file
_LINES = {"XYZ": "xyzfile", "TXYZ": "xyzfile", "ARC": "xyzfile", "TRJ": "trjfile", "MDCRD": "trjfile"}
# enough of a file's end for some lines
_LAST_BYTES = 20_000
_COMPRESSED: dict[str, Any] = {".gz": gzip.open, ".bz2": bz2.open}
_PART = 1 << 22
_NUMBER = re.compile(r"[-+]?(\d*)(?:\.(\d*))?(?:[eEdD]([-+]?\d*))?")


def left_over(trajectory: Any) -> str | None:
    """What is left behind the last frame of an MDAnalysis trajectory, in words; None where nothing is.

    Args:
        trajectory: MDAnalysis's reader; moved to its last frame where it reads text by lines.
    """
    path = getattr(trajectory, "filename", None)
    if not isinstance(path, str | Path) or not Path(path).is_file():
        return None
    words = formats_of(trajectory)
    if "DCD" in words:
        rest, frame = _behind_dcd(Path(path), int(trajectory.n_frames))
    elif "TRR" in words:
        rest, frame = _behind_trr(Path(path), trajectory)
    elif "NCDF" in words:
        # a run that was killed has not always come to saying in the head what it wrote
        head = head_of(path)
        rest, frame = (head.rest, head.record) if head is not None else (0, 0)
    elif found := _text(trajectory):
        if trajectory.ts.frame != trajectory.n_frames - 1:
            trajectory[trajectory.n_frames - 1]
        return _behind_text(getattr(trajectory, _LINES[found[1]], None))
    else:
        return None
    if rest <= 0:
        return None
    if rest < frame:
        return f"the file ends after {rest:,} bytes of it"
    if "NCDF" in words:
        return f"the file goes on for {rest // frame:,} frames more than its head tells of"
    return f"the {rest:,} bytes behind the frame before are no frame"


def _behind_dcd(path: Path, frames: int) -> tuple[int, int]:
    """Bytes behind the last frame, and those of a frame."""
    from MDAnalysis.lib.formats.libdcd import DCDFile

    with DCDFile(str(path)) as file:
        sizes = [getattr(file, name, None) for name in ("_header_size", "_firstframesize", "_framesize")]
    if None in sizes:
        # another release of MDAnalysis keeps them elsewhere
        return 0, 0
    head, first, other = (int(one) for one in sizes if one is not None)
    return path.stat().st_size - head - first - (frames - 1) * other, other


def _behind_trr(path: Path, trajectory: Any) -> tuple[int, int]:
    """As `_behind_dcd`: the last frame's head says how long it is."""
    offsets = getattr(getattr(trajectory, "_xdr", None), "offsets", None)
    if offsets is None or not len(offsets):
        return 0, 0
    begin = int(offsets[-1])
    with path.open("rb") as file:
        file.seek(begin)
        head = file.read(_TRR.size)
    if len(head) < _TRR.size:
        return 0, 0
    magic, _, _, _, *numbers = _TRR.unpack(head)
    sizes, atoms = numbers[:10], numbers[10]
    # nine numbers of a box, or three an atom, are of one width, and so are the time and lambda
    width = sizes[2] // 9 if sizes[2] else max(sizes[7:]) // max(3 * atoms, 1)
    if magic != _TRR_MAGIC or width not in (4, 8):
        return 0, 0
    size = _TRR.size + 2 * width + sum(sizes)
    return path.stat().st_size - begin - size, size


def _behind_text(file: Any) -> str | None:
    """Lines behind the last frame, without blank ones at the end."""
    if file is None or file.closed:
        return None
    lines = 0
    try:
        for number, line in enumerate(file):
            lines = number + 1 if line.strip() else lines
    except (OSError, EOFError, ValueError):
        return None
    return f"the file ends after {lines:,} lines of it" if lines else None


def refuse_cut_text(trajectory: Any, number: int) -> None:
    """Refuses the last frame of an MDAnalysis trajectory whose last number was cut, where that is text.

    Args:
        trajectory: MDAnalysis's reader.
        number: of the frame that is about to be read; only the last can be cut.

    Raises:
        ValueError: it was cut.
    """
    if number != trajectory.n_frames - 1 or (found := _text(trajectory)) is None:
        return
    path, word = found
    end, size = _last_bytes(path)
    offsets = getattr(trajectory, "_offsets", ())
    if len(offsets) > number + 1 and offsets[number + 1] < size:
        # what was cut are lines behind this frame, too few for another: left_over tells of them
        return
    last = end.decode("latin-1").splitlines(keepends=True)
    if word == "XYZ":
        refuse_cut_line(last[-int(trajectory.n_atoms) :])
    elif word in ("TRJ", "MDCRD") and last:
        # a line of it holds several numbers
        refuse_cut_line(last[-1:], last[-1].split()[:-1])


def _last_bytes(path: Path) -> tuple[bytes, int]:
    """The end of a file, and how many bytes it has; of a compressed one, what is in it, which is all read."""
    if path.suffix not in _COMPRESSED:
        size = path.stat().st_size
        with path.open("rb") as raw:
            raw.seek(max(size - _LAST_BYTES, 0))
            return raw.read(), size
    last, size = b"", 0
    with _COMPRESSED[path.suffix](path, "rb") as packed:
        while part := packed.read(_PART):
            last, size = (last + part)[-_LAST_BYTES:], size + len(part)
    return last, size


def _text(trajectory: Any) -> tuple[Path, str] | None:
    """(file, format) behind MDAnalysis's reader where it reads text by lines."""
    path = getattr(trajectory, "filename", None)
    word = next((one for one in formats_of(trajectory) if one in _LINES), None)
    return (Path(path), word) if word is not None and isinstance(path, str | Path) else None


def refuse_cut_line(lines: Sequence[str], like: Sequence[str] = ()) -> None:
    """Refuses a last line that was cut in its last number: what is left of it is another number.

    That the line has no end proves nothing by itself, since some programs leave it out. The number was cut
    where it has fewer digits than those that stand in its place in the lines before.

    Args:
        lines: of a frame, all with one number in the last place.
        like: words to compare with instead.

    Raises:
        ValueError: it was cut.
    """
    if not lines or lines[-1].endswith(("\n", "\r")):
        return
    words = lines[-1].split()
    if not words or lines[-1][-1].isspace():
        # more was written behind the number
        return
    others = list(like) or [line.split()[-1] for line in lines[:-1] if line.strip()]
    if not others:
        # one atom: its other coordinates are written alike
        others = [word for word in words[:-1] if "." in word]
    if _is_cut(words[-1], others):
        raise ValueError(
            f"the file ends in the middle of a number, {words[-1]!r}: it has fewer digits than those before, "
            "and its line no end; if it is whole, end the line"
        )


def _is_cut(word: str, others: Sequence[str]) -> bool:
    mine, rest = _digits(word), [one for one in map(_digits, others) if one is not None]
    # a mass or a charge stands in other rows too
    if mine is None or not rest or word in others:
        return False
    decimals, significant, exponent = mine
    if 0 <= exponent < 2:
        # C, Fortran and Python write two digits at least
        return True
    if exponent < 0 and all(one[2] >= 0 for one in rest):
        return True
    if len({one[0] for one in rest}) == 1:
        return decimals < rest[0][0]
    # so many digits in all, and zeros at the end left out
    return significant < median(one[1] for one in rest)


def _digits(word: str) -> tuple[int, int, int] | None:
    """(decimals, significant digits, digits of the exponent or -1); None for what is no number."""
    match = _NUMBER.fullmatch(word)
    if match is None:
        return None
    before, after, exponent = match.groups()
    digits = ((before or "") + (after or "")).lstrip("0")
    return len(after or ""), len(digits), -1 if exponent is None else len(exponent.lstrip("+-"))
