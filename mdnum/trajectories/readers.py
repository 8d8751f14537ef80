"""Choice of a reader for a trajectory file, and parsing of frames such as run.xtc@100:."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

from mdnum.errors import InputError, expect_path
from mdnum.reading import check_claim, reading
from mdnum.registry import Registry
from mdnum.trajectories.topology import Topology
from mdnum.trajectories.trajectory import Trajectory

_SLICE = re.compile(r"(-?\d+)?(:(-?\d+)?(:(-?\d+)?)?)?")
# MDAnalysis reads XYZ too, but neither boxes nor more than float32 of it; the others it does not know
_ASE_SUFFIXES = frozenset({".traj", ".json", ".db", ".bundle", ".castep", ".xsf", ".con"})
# Amber's, of which MDAnalysis reads those that are whole
_NETCDF = frozenset({"nc", "ncdf", "netcdf"})
#: Remedy for frames that are not in a file.
IN_MEMORY = "Give the path of a trajectory; arrays go into mdnum.flips(array, cell=...) or a mdnum.Recorder"


def _concrete(reader: Any) -> None:
    if missing := sorted(getattr(reader, "__abstractmethods__", ())):
        raise TypeError(f"it has no {' and no '.join(missing)}")


#: Readers by the name of `--format` and by file extension; other formats are read by MDAnalysis or ASE.
READERS: Registry[Trajectory] = Registry(
    "trajectory format", "mdnum.trajectories", kind=Trajectory, check=_concrete
)
for _words, _reader in {
    "xtc": "binary:XtcTrajectory", "trr": "binary:TrrTrajectory", "gro": "text:GroTrajectory",
    "lammpstrj lammpsdump lammps-dump-text": "text:LammpsDump", "extxyz": "text:ExtxyzTrajectory",
    "vasp-xdatcar": "text:XdatcarTrajectory",
}.items():  # fmt: skip
    for _word in _words.split():
        READERS.add(_word, f"mdnum.trajectories.{_reader}")


def open_trajectory(
    path: str | Path, topology: str | Path | None = None, slice: str = "", format: str | None = None
) -> Trajectory:
    """Open a trajectory file for MDAnalysis or ASE, or the folder of an mdnum run.

    Args:
        path: the file, optionally followed by a frame selection @START:STOP:STEP.
        topology: a file that identifies the atoms, if the trajectory does not (xtc, trr, dcd, ...); any
            topology file that MDAnalysis accepts.
        slice: frames to read, in the notation used after the @.
        format: MDAnalysis's or ASE's name of the format, if the file name does not identify it.

    Raises:
        InputError: the file does not exist, no reader supports it, or it does not match the topology.
    """
    for one in (path, "" if topology is None else topology):
        expect_path(one, IN_MEMORY)
    file, words = split_path(str(path))
    if words and slice:
        raise InputError(
            f"frames are selected twice, by @{words} and by {slice!r}", remedy="Use only one selection"
        )
    frames = parse_slice(slice or words, where=str(path))
    if file.is_dir() and (file / "trajectory.traj").exists():
        from mdnum.store import RunFolder

        RunFolder.open(file).check("trajectory.traj")
        file = file / "trajectory.traj"
    if file.is_dir() and (file / "summary.json").exists():
        message = "this folder holds results, but no trajectory"
        remedy = "Give the trajectory file; a run writes one with --save-every 1 (or another number)"
        raise InputError(message, remedy=remedy, where=str(file))
    if file.is_dir() and file.suffix != ".bundle":
        raise InputError("the path is a folder", remedy="Give the trajectory file", where=str(file))
    named = [] if topology is None else [Path(topology).expanduser()]
    for one in (file, *named):
        if not one.exists():
            raise InputError("no such file", remedy="Check the path", where=str(one))
        if one.is_dir():
            continue
        if not one.is_file():
            # a reader would wait for what comes, or read without end
            raise InputError(
                "the path is not a regular file", remedy="Copy the data to a regular file", where=str(one)
            )
        if not one.stat().st_size:
            raise InputError("the file is empty", remedy="Check how it was written", where=str(one))
        check_claim(one)
    reader = _reader_of(file, format)
    atoms = Topology(named[0], lambda one: open_trajectory(one).table) if named else None
    with reading(file, by=getattr(reader, "reader", "mdnum")):
        opened = reader(file, atoms, frames)
    if not opened.atoms:
        raise InputError("the frames have no atoms", remedy="Check how the file was written", where=str(file))
    return opened


def _reader_of(file: Path, format: str | None) -> Callable[..., Trajectory]:
    """Return the function that opens a file, given path, topology and frames."""
    suffix = (file.with_suffix("") if file.suffix in (".gz", ".bz2") else file).suffix.lower()
    word = (format or suffix[1:]).lower()
    if word in READERS:
        # of xtc without what the readers of other formats import, which takes as long as reading many frames
        return cast(Any, READERS[word])
    import MDAnalysis

    from mdnum.trajectories import mdanalysis_source, text

    if word in _NETCDF and (head := mdanalysis_source.netcdf_of(file)) and head.whole < head.told:
        return mdanalysis_source.NetcdfTrajectory
    known = word.upper() in MDAnalysis._READERS
    if format is None and (suffix in _ASE_SUFFIXES or (suffix == ".cif" and find_spec("gemmi") is None)):
        known = False
    elif format is None:
        head, comment = _first_lines(file)
        if not known and head.startswith("item:"):
            return text.LammpsDump
        # the comment line of an extended XYZ file says what its columns are, or its box
        known &= not (suffix == ".xyz" and ("lattice=" in comment or "properties=" in comment))
    if known:
        return partial(mdanalysis_source.MDAnalysisTrajectory, format=format)
    word = format or text.format_of(file)
    return cast(Any, READERS[word]) if word in READERS else partial(text.AseTrajectory, format=word)


def _first_lines(file: Path) -> tuple[str, str]:
    """Return the first two lines of a text file in lower case. For a binary file, both lines are empty."""
    from ase.io.formats import open_with_compression

    try:
        with open_with_compression(str(file), "r") as lines:
            return lines.readline(1000).lower(), lines.readline(10_000).lower()
    except (OSError, EOFError, zlib.error, UnicodeDecodeError):
        return "", ""


# ---- which frames: run.xtc@100:, run.xtc@::10, run.xtc@5, as ASE writes it


def split_path(text: str) -> tuple[Path, str]:
    """Return (path, slice after the last @). The slice is empty if the whole text is a file."""
    whole = Path(text).expanduser()
    name, at, words = text.rpartition("@")
    if not at or whole.exists():
        return whole, ""
    path = Path(name).expanduser()
    # words that name no frames are told where the file is there without them
    return (path, words) if _SLICE.fullmatch(words) or path.is_file() else (whole, "")


def parse_slice(words: str, where: str = "") -> slice:
    """Parse a slice of frames: "100:", "::10", "-50:", "5" (one frame) or "" (all).

    Raises:
        InputError: the text is not a slice, or its stride is not positive (frames are read forward in time).
    """
    match = _SLICE.fullmatch(words.strip())
    if match is None:
        message = f"{words!r} is not a range of frames"
        remedy = "Write START:STOP:STEP, for example 100: or ::10 or -50:, or the number of one frame"
        raise InputError(message, remedy=remedy, where=where or None)
    colon = match[2]
    start, stop, step = (None if match[k] is None else int(match[k]) for k in (1, 3, 5))
    if colon is None:
        return slice(None) if start is None else slice(start, start + 1 or None)
    if step is not None and step < 1:
        message = f"the stride of the frames {words!r} is not positive"
        remedy = "Use a stride of 1 or more: flips need frames in order of time"
        raise InputError(message, remedy=remedy, where=where or None)
    return slice(start, stop, step or 1)
