"""Reading of files with ASE and MDAnalysis, with one-line error messages.

The readers of ASE and MDAnalysis can raise any exception, even without a message. `reading` converts each
exception to one line with the file and the frame.
"""

from __future__ import annotations

import io
import os
import re
import sys
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from mdnum.errors import InputError, MdnumError

if TYPE_CHECKING:
    from ase import Atoms

#: Largest size in bytes of a system file or summary.
MOST_TEXT = 1 << 28
# characters of a line of a file of structures
_LONGEST_LINE = 1 << 24
#: what to do about a file that nobody can read
CHECK = "Check that the file is whole and of the kind its name says"
#: what to do about a structure that nobody can read
CHECK_STRUCTURE = "Check that `ase.io.read` opens it; extxyz is the safest format"
# what the end of the file looks like to ASE's reader of traj
_ENDS = "buffer is smaller than requested size"
# beginnings of files that their readers cannot read, with what they are and what to do
_NOT_SUPPORTED = {
    b"CDF\x05": ("CDF-5 is not supported", "Convert it with nccopy -k classic"),
    **dict.fromkeys(
        (b"T" + bytes(7) + b"CORD", bytes(7) + b"TCORD"),
        ("record markers of 64 bits are not supported in a DCD file", "Write it with those of 32 bits"),
    ),
}
# what readers say of a file that does not say how many atoms it has
_NO_ATOMS = ("cannot deduce the number of atoms", "topology can be minimally inferred")
# words for exceptions that say too little
_SAID = (
    (r"KeyError: '([A-Z][a-z]{0,2})'", r"\1 is the symbol of no element"),
    (r".*netcdf_variable.* no attribute '(\w+)'", r"a variable lacks the attribute \1, which AMBER requires"),
)
# what MDAnalysis puts around the message of one of its parsers
_WRAPPED = ("Failed to construct topology", "Failed to load from the topology")
# names of columns that are velocities or momenta
_VELOCITY = re.compile(r"(v|vel\w*|v_?[xyz]|mom|momentum|momenta\w+)", re.IGNORECASE)
# the number of atoms in the head of formats whose readers count up to it, or fill memory, at once
_LINE_ONE, _PRMTOP = r"\s*(-?\d+)", r".*?%FLAG POINTERS\s*%FORMAT[^\n]*\s*(\d+)"
_ANNOUNCED = {
    ".xyz": _LINE_ONE, ".txyz": _LINE_ONE, ".arc": _LINE_ONE, ".gro": r"[^\n]*\n\s*(-?\d+)",
    ".inpcrd": r"[^\n]*\n\s*(-?\d+)", ".psf": r".*?(\d+)\s*!NATOM", ".data": r".*?\n\s*(\d+)\s+atoms",
    ".crd": r"(?:\s*\*[^\n]*\n)*\s*(\d+)", ".prmtop": _PRMTOP, ".parm7": _PRMTOP, ".top": _PRMTOP,
}  # fmt: skip
_HEAD = 20_000
# atoms to a byte of a file
_MOST_ATOMS = 1000
# calls at the end of a file after which a reader is taken to count and not to read
_PATIENCE = 10_000


class FrameError(InputError):
    """Raised if a frame contains impossible data. `frame` is the number of the frame in the file, from 0."""

    def __init__(self, message: str, *, frame: int, remedy: str | None, where: str | None = None):
        super().__init__(message, remedy=remedy, where=where)
        self.frame = frame

    def __reduce__(self) -> tuple[Any, ...]:
        # to be sent from one process to another
        return partial(type(self), frame=self.frame, remedy=self.remedy, where=self.where), (self.message,)


class EarlierFramesError(FrameError):
    """Raised if a frame shows that all earlier frames are wrong."""


class UnreadableFrame(FrameError):
    """Raised if a frame cannot be read, but earlier frames were read."""

    def __init__(self, message: str, *, frame: int, where: str, remedy: str | None = None):
        before = f"The frames before it were read; to stop there add @:{frame} to the path"
        super().__init__(message, frame=frame, remedy=remedy or (before if frame else CHECK), where=where)


@contextmanager
def reading(
    file: str | Path, frame: int | None = None, *, by: str = "MDAnalysis", remedy: str = CHECK
) -> Iterator[None]:
    """Context manager that turns exceptions of a reader into one-line errors, and suppresses warnings.

    Args:
        file: the file that is read.
        frame: number of the current frame in the file; None while the file is opened.
        by: the package that provides the reader.
        remedy: what to do if the file cannot be opened.

    Raises:
        UnreadableFrame: the frame cannot be read.
        InputError: the file cannot be opened, or needs a package that is not installed. mdnum's own errors
            are not changed.
    """
    hook = sys.unraisablehook
    # readers that could not open complain once more when they are thrown away
    sys.unraisablehook = lambda _: None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except MdnumError:
        raise
    except Exception as error:
        said, where = first_line(error), str(file)
        if frame is not None:
            raise UnreadableFrame(
                f"frame {frame} cannot be read ({said})", frame=frame, where=where
            ) from error
        if isinstance(error, ImportError) or "install" in str(error):
            raise InputError(
                f"a package that is needed to read the file is not installed ({said})",
                remedy="Install the package, or convert the file to the format xtc or extxyz",
                where=where,
            ) from error
        if any(one in said for one in _NO_ATOMS):
            remedy = "It does not say what its atoms are: give its topology with -s TOPOLOGY"
        with suppress(OSError), open(file, "rb") as raw:
            head = raw.read(12)
            said, remedy = next(
                (_NOT_SUPPORTED[one] for one in _NOT_SUPPORTED if head.startswith(one)), (said, remedy)
            )
        raise InputError(f"{by} cannot open the file ({said})", remedy=remedy, where=where) from error
    finally:
        sys.unraisablehook = hook


def check_claim(path: str | Path, atoms: int | None = None) -> None:
    """Raise an error if a file states an impossible number of atoms.

    Args:
        path: the file.
        atoms: number of atoms in the file's header; None to read it from the header, if readers trust it.

    Raises:
        InputError: there would be at least a thousand atoms per byte, which no compression achieves.
    """
    size, found = Path(path).stat().st_size, None
    suffix = next((one for one in reversed(Path(path).suffixes) if one not in (".gz", ".bz2")), "").lower()
    if atoms is None and (announced := _ANNOUNCED.get(suffix)):
        from ase.io.formats import open_with_compression

        # opening a damaged file will say more
        with suppress(OSError, EOFError, ValueError, zlib.error), open_with_compression(str(path)) as file:
            found = re.match(announced, file.read(_HEAD), re.DOTALL)
    atoms = atoms or (int(found[1]) if found else 0)
    if atoms < 0 or atoms > _MOST_ATOMS * max(size, 1):
        said = f"it announces {atoms:,} atoms, which its {size:,} bytes cannot hold"
        raise InputError(said, remedy=CHECK, where=str(path))


def whole_text(file: str | Path | BinaryIO, where: str | Path) -> str:
    """Return the whole text of a UTF-8 file. Raise an error if the text exceeds the memory.

    Raises:
        InputError: the file is too large. OSError, UnicodeDecodeError: the file cannot be read.
    """
    if isinstance(file, str | Path):
        with open(file, "rb") as opened:
            return whole_text(opened, where)
    size = os.fstat(file.fileno()).st_size
    if size > MOST_TEXT:
        said = f"holds {size:,} bytes, where no text of its kind is larger than {MOST_TEXT:,}"
        raise InputError(said, remedy=CHECK, where=str(where))
    return file.read().decode("utf-8")


def first_line(error: BaseException) -> str:
    """Return the message of an error in one line."""
    cause: BaseException | None = error
    while cause is not None and not str(cause).strip():
        cause = cause.__context__
    text = str(error if cause is None else cause).strip().splitlines()
    if text and text[0].startswith(_WRAPPED):
        text = [line.removeprefix("Error: ") for line in text if line.startswith("Error: ")] or text
    if text and cause is not error and not text[0].startswith("could not convert"):
        # how a reader stumbles over an end is its own business, unless a word is no number
        text = []
    if (not text and isinstance(error, StopIteration | EOFError)) or (text and _ENDS in text[0]):
        return "the file ends early"
    said = text[0].rstrip(".") if text else ""
    # the message of some is no more than a key or a number
    said = said if " " in said else f"{type(error).__name__}: {said}" if said else type(error).__name__
    return next((match.expand(words) for one, words in _SAID if (match := re.fullmatch(one, said))), said)


# ---- ASE


class _Lines(io.TextIOWrapper):
    """A text file that raises an error at repeated reads beyond its end."""

    _at_end = 0

    def readline(self, size: int = -1, /) -> str:
        line = super().readline(_LONGEST_LINE if size < 0 else size)
        if len(line) == _LONGEST_LINE and size < 0:
            raise ValueError(f"the file has a line of more than {_LONGEST_LINE:,} characters")
        self._at_end = 0 if line else self._at_end + 1
        if self._at_end > _PATIENCE:
            raise ValueError("the file contains less data than its header states")
        return line


def ase_images(
    path: str | Path, index: int | slice | str = slice(None), format: str | None = None
) -> Iterator[Atoms]:
    """Yield the structures that ASE reads from a file; for use inside `reading`.

    Args:
        path: always the path of a file, even if it contains an @ or begins like the address of a database.
        index: selected structures, as a number, a slice or an ASE index string, or as a selection in a
            database.
        format: ASE's name of the format; None for automatic detection.
    """
    # its readers take half a second to import
    from ase.io.formats import filetype, get_ioformat, iread, open_with_compression, read
    from ase.utils import string2index

    if isinstance(index, str):
        with suppress(ValueError):
            index = string2index(index)
    file: Any = str(path)
    format = format or filetype(file)
    kind = get_ioformat(format)
    if kind.acceptsfd and not kind.isbinary:
        lines: Any = open_with_compression(file, "r")
        file = _Lines(lines.detach(), lines.encoding, lines.errors)
        if kind.name == "vasp":
            # a list of so many symbols is made first
            counts = [one for row in list(islice(file, 7))[5:] for one in row.split() if one.isdecimal()]
            check_claim(path, sum(map(int, counts)))
            file.seek(0)
    found: Any = read if isinstance(index, str) else iread
    yield from map(with_elements, found(file, index, format, do_not_split_by_at_sign=True))


def with_elements(atoms: Any) -> Atoms:
    """Return the atoms. Raise an error for an invalid atomic number (0 is allowed).

    Raises:
        ValueError: an atomic number is negative, or too large for ASE's table of elements.
    """
    from ase.data import chemical_symbols

    numbers = atoms.numbers
    bad = np.flatnonzero((numbers < 0) | (numbers >= len(chemical_symbols)))
    if bad.size:
        most = len(chemical_symbols) - 1
        raise ValueError(f"atom {bad[0]} has the atomic number {numbers[bad[0]]}; expected 0 to {most}")
    return atoms


def ignored_velocities(arrays: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of columns that look like velocities or momenta, but are not read.

    Extended XYZ defines only momenta, in ASE's units. Other columns have unknown units.
    """
    shapes = {name: array.shape[1:] for name, array in arrays.items() if _VELOCITY.fullmatch(name)}
    return sorted(name for name, shape in shapes.items() if shape in ((3,), ()) and name != "momenta")
