"""Trajectories of any code: which reader a file gets, what every reader gives, and atoms selected by words.

A reader gives the frames asked for, one after the other, and what is known of the atoms.

Positions are those of the file: nothing is wrapped, made whole or centered. Readers differ in what they keep:
ASE's and mdnum's own (gro, LAMMPS's text dumps) keep every digit, MDAnalysis's narrow every coordinate to
float32 (`Trajectory.bits`).
"""

from __future__ import annotations

import math
import re
import warnings
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from importlib.util import find_spec
from itertools import count, islice
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Int

from mdnum.errors import InputError, expect_path
from mdnum.reading import CHECK, FrameError, UnreadableFrame, check_claim, first_line, reading
from mdnum.registry import Registry
from mdnum.trajectories.frame import Box, Frame, FrameCheck
from mdnum.trajectories.repeats import RepeatedFrames
from mdnum.trajectories.topology import AtomTable, read_topology

#: Frames from which the resolution of a file is read.
SAMPLE = 8
_SLICE = re.compile(r"(-?\d+)?(:(-?\d+)?(:(-?\d+)?)?)?")

# MDAnalysis reads XYZ too, but neither boxes nor more than float32 of it; the others it does not know
_ASE_SUFFIXES = frozenset({".traj", ".json", ".db", ".bundle", ".castep", ".xsf", ".con"})
# Amber's, of which MDAnalysis reads those that are whole
_NETCDF = frozenset({"nc", "ncdf", "netcdf"})
_LANGUAGE = (
    'Write it as MDAnalysis does: "name OW", "protein", "element O", "index 0:99", "resname SOL and name OW"'
)
_SHOWN = 8
#: What to do with frames that are not in a file.
IN_MEMORY = (
    "Give the path of a trajectory; arrays (frames, atoms, 3) go into mdnum.trajectories.NeighborFlips("
    "MDAnalysis.Universe.empty(atoms).load_new(array), r_cut=...)"
)


class Trajectory(ABC):
    """Frames of one file, read lazily and in order, as often as wanted.

    A reader says how many atoms there are (`has_atoms`), finds frames (`raw_frames`) and decodes them
    (`decoded`). What it raises in doing so becomes an unreadable frame.

    Args:
        path: the file.
        topology: the file that says what the atoms are, where it is another one.
        slice: the frames asked for.
    """

    format: str  # the file's format in the reader's word ("XTC", "extxyz")
    reader: str = "mdnum"  # who reads it: "MDAnalysis", "ASE", "mdnum"
    bits: int = 64  # width of a coordinate as the reader gives it, 32 or 64; frames are float64 either way
    length: str = "Å"  # unit in words; "" where the file does not say
    # unit in words; "frame" where the file has no times, whose numbers then stand for them (velocities, if it
    # has any, are per ps there)
    time: str = "frame"
    table: AtomTable  # what is known of the atoms
    notes: tuple[str, ...] = ()  # what a reader of the results should know about the reading, each a sentence
    # frames in the file, where they are known
    _count: int | None = None
    # ids of the atoms in ascending order, where the file has them
    _ids: np.ndarray | None = None
    # whether frames that repeat earlier ones are left out; which did, and what was found of frames, when read
    drop_repeats = False
    repeats: RepeatedFrames
    check: FrameCheck
    universe: Any = None  # the MDAnalysis Universe behind it, where there is one
    # the time step with its bytes in the other order, over that one, where the file has one
    swapped: float = math.nan

    def __init__(self, path: Path, topology: str | Path | None, slice: slice):
        self.path, self.slice = path, slice
        self.topology = None if topology is None else Path(topology)

    def has_atoms(self, atoms: int, table: AtomTable | None = None) -> None:
        """Sets the table of atoms: the topology's, where there is one."""
        check_claim(self.path, atoms)
        if self.topology is not None:
            table, _ = read_topology(self.topology)
            self._belongs(len(table), atoms)
        self.table = AtomTable.plain(["X"] * atoms, named=False) if table is None else table

    def _belongs(self, topology: int, atoms: int) -> None:
        """Refuses a topology with another number of atoms."""
        if self.topology is not None and topology != atoms:
            seen = f"the topology {self.topology.name} has {topology:,} atoms and the trajectory {atoms:,}"
            remedy = "Give the topology that the trajectory was written with, or a selection of it"
            raise self._refused(seen, remedy)

    def _refused(self, message: str, remedy: str = CHECK) -> InputError:
        return InputError(message, remedy=remedy, where=str(self.path))

    @property
    def atoms(self) -> int:
        """Atoms in every frame."""
        return len(self.table)

    @property
    def species(self) -> np.ndarray:
        """Species of every atom, words, shape (atoms,)."""
        return self.table.species

    def other_box(self, number: int) -> tuple[str, Box] | None:
        """(code of a finding, another box that a frame may be taken to have); None without one."""
        return None

    @property
    def in_file(self) -> int | None:
        """Frames in the file; None where they are not known without reading it."""
        if self._count is None and any((end or 0) < 0 for end in (self.slice.start, self.slice.stop)):
            with self._opened() as get:
                for number in chosen(slice(None), None):
                    with self._reading(number):
                        if get(number) is None:
                            self._count = number
                            break
        return self._count

    @property
    def count(self) -> int | None:
        """Frames that `frames` gives; None where they are not known without reading the file."""
        return None if self.in_file is None else len(range(*self.slice.indices(self.in_file)))

    def frames(self) -> Iterator[Frame]:
        """The frames asked for, in order, one in memory at a time. Each call starts at the first again.

        Raises:
            UnreadableFrame: one cannot be read. Those before it have been given.
            InputError: a frame has another number of atoms.
        """
        number = None
        with self._opened() as get:
            for number in chosen(self.slice, self.in_file):
                with self._reading(number):
                    if (raw := get(number)) is None:
                        return
                    frame = self.decoded(number, raw)
                if len(frame.positions) != self.atoms:
                    seen = f"has {len(frame.positions):,} atoms and the first {self.atoms:,}"
                    remedy = "Leave out the frames with another number of atoms: a flip needs the pair before"
                    raise self._odd(number, seen, remedy)
                yield frame
        end = self.in_file or 0
        if number is None or not (self.slice.stop is None or self.slice.stop > end):
            return
        with self._reading(end):
            if rest := self._behind():
                raise self._unreadable(end, rest)

    def sample(self) -> list[Frame]:
        """The first of the frames asked for, `SAMPLE` of them; fewer where one of them cannot be read.

        Raises:
            InputError: there is none, or not even the first can be read.
        """
        sample = []
        try:
            sample.extend(islice(self.frames(), SAMPLE))
        except InputError:
            if not sample:
                raise
        if not sample:
            words, of = self.slice_words, "" if self.in_file is None else f" of {self.in_file:,}"
            raise self._refused(f"@{words} leaves no frame{of}", "Ask for others") if words else self._empty()
        return sample

    @property
    def slice_words(self) -> str:
        """The frames asked for, as behind an @; empty for all."""
        if self.slice == slice(None):
            return ""
        start, stop, step = self.slice.start, self.slice.stop, self.slice.step
        ends = [start, stop] if step in (None, 1) else [start, stop, step]
        return ":".join("" if end is None else str(end) for end in ends)

    @abstractmethod
    def raw_frames(self) -> AbstractContextManager[Callable[[int], Any]]:
        """Opens the file: gives frames by ascending number, as `decoded` takes them; None at the end."""

    @abstractmethod
    def decoded(self, number: int, raw: Any) -> Frame:
        """A frame, in the units that `length` and `time` name, from what `raw_frames` gave."""

    def _behind(self) -> str | None:
        """What is left in the file behind its last frame, in words."""
        return None

    def _by_id(self, number: int, ids: np.ndarray) -> np.ndarray:
        """The order of a frame's atoms by their ids, which are those of the first frame."""
        order = np.argsort(ids, kind="stable")
        known = self._ids = ids[order] if self._ids is None else self._ids
        if not np.array_equal(known, ids[order]):
            lost = np.setdiff1d(known, ids)
            seen = f"lacks atom {lost[0]}" if len(lost) else "has other atoms"
            seen += f" of the first frame: {len(ids):,} atoms, and {len(known):,} there"
            raise self._odd(number, seen, "Dump one group of atoms that stays the same")
        return order

    @contextmanager
    def _opened(self) -> Iterator[Callable[[int], Any]]:
        with ExitStack() as stack:
            with reading(self.path, by=self.reader):
                get = stack.enter_context(self.raw_frames())
            yield get

    def _reading(self, number: int) -> AbstractContextManager[None]:
        return reading(self.path, number, by=self.reader)

    def in_order(self, following: Callable[[], Any]) -> Callable[[int], Any]:
        """Frames by number, of a reader that goes forward only."""
        at = 0

        def get(number: int) -> Any:
            nonlocal at
            raw = None
            while at <= number:
                # the frame at fault may be one that is skipped
                with self._reading(at):
                    raw = following()
                if raw is None:
                    break
                at += 1
            return raw

        return get

    def first(self) -> Any:
        """The first frame of the file, as `decoded` takes it."""
        with self._opened() as get, self._reading(0):
            first = get(0)
        if first is None:
            raise self._empty()
        return first

    def _empty(self) -> InputError:
        return self._refused("the file holds no frame", "Check how it was written")

    def _odd(self, number: int, seen: str, remedy: str) -> FrameError:
        return FrameError(f"frame {number} {seen}", frame=number, remedy=remedy, where=str(self.path))

    def _unreadable(self, number: int, said: str) -> UnreadableFrame:
        return UnreadableFrame(f"frame {number} cannot be read ({said})", frame=number, where=str(self.path))


# ---- which reader a file gets


def open_trajectory(
    path: str | Path, topology: str | Path | None = None, slice: str = "", format: str | None = None
) -> Trajectory:
    """Opens a file that MDAnalysis or ASE reads, or the folder of an mdnum run.

    Args:
        path: the file; may end in @START:STOP:STEP.
        topology: a file that says what the atoms are, where the trajectory does not (xtc, trr, dcd, ...):
            anything that MDAnalysis takes for one.
        slice: frames to read, as behind the @.
        format: the format in MDAnalysis's or ASE's word, where the name of the file does not tell it.

    Raises:
        InputError: no such file, nobody reads it, or it does not belong to the topology.
    """
    for one in (path, "" if topology is None else topology):
        expect_path(one, IN_MEMORY)
    file, words = split_path(str(path))
    if words and slice:
        raise InputError(f"frames are named twice, by @{words} and by {slice!r}", remedy="Name them once")
    frames = parse_slice(slice or words, where=str(path))
    if file.is_dir() and (file / "trajectory.traj").exists():
        from mdnum.store import RunFolder

        RunFolder.open(file).check("trajectory.traj")
        file = file / "trajectory.traj"
    if file.is_dir() and (file / "summary.json").exists():
        message = "this folder holds results, and no trajectory"
        remedy = "Give the trajectory itself; a run keeps one with --save-every 1 (or another number)"
        raise InputError(message, remedy=remedy, where=str(file))
    if file.is_dir() and file.suffix != ".bundle":
        raise InputError("it is a folder", remedy="Give the trajectory itself", where=str(file))
    for one in (file, *([] if topology is None else [Path(topology).expanduser()])):
        if not one.exists():
            raise InputError("no such file", remedy="Check the path", where=str(one))
        if one.is_dir():
            continue
        if not one.is_file():
            # a reader would wait for what comes, or read without end
            raise InputError("it is no regular file", remedy="Copy it to a file", where=str(one))
        if not one.stat().st_size:
            raise InputError("the file is empty", remedy="Check how it was written", where=str(one))
        check_claim(one)
    reader = _reader_of(file, format)
    with reading(file, by=getattr(reader, "reader", "mdnum")):
        opened = reader(file, topology, frames)
    if not opened.atoms:
        raise InputError("its frames have no atoms", remedy="Check how the file was written", where=str(file))
    return opened


def _concrete(reader: Any) -> None:
    if missing := sorted(getattr(reader, "__abstractmethods__", ())):
        raise TypeError(f"it has no {' and no '.join(missing)}")


#: Formats in the word of `--format` and of the end of a file's name; others are MDAnalysis's or ASE's.
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


def _reader_of(file: Path, format: str | None) -> Callable[..., Trajectory]:
    """What opens a file, of its path, its topology and the frames asked for."""
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
    """The first two lines in small letters; empty for a file that is no text."""
    from ase.io.formats import open_with_compression

    try:
        with open_with_compression(str(file), "r") as lines:
            return lines.readline(1000).lower(), lines.readline(10_000).lower()
    except (OSError, EOFError, zlib.error, UnicodeDecodeError):
        return "", ""


# ---- which frames: run.xtc@100:, run.xtc@::10, run.xtc@5, as ASE writes it


def split_path(text: str) -> tuple[Path, str]:
    """(path, words of the slice behind its last @); a file whose own name has an @ is found as it is."""
    whole = Path(text).expanduser()
    name, at, words = text.rpartition("@")
    if not at or whole.exists():
        return whole, ""
    path = Path(name).expanduser()
    # words that name no frames are told where the file is there without them
    return (path, words) if _SLICE.fullmatch(words) or path.is_file() else (whole, "")


def parse_slice(words: str, where: str = "") -> slice:
    """The slice that words name: "100:", "::10", "-50:", "5" (that frame alone), "" (all).

    Raises:
        InputError: the words are no slice, or go backward: flips follow time.
    """
    match = _SLICE.fullmatch(words.strip())
    if match is None:
        message = f"{words!r} names no frames"
        remedy = "Write START:STOP:STEP, for example 100: or ::10 or -50:, or the number of one frame"
        raise InputError(message, remedy=remedy, where=where or None)
    colon = match[2]
    start, stop, step = (None if match[k] is None else int(match[k]) for k in (1, 3, 5))
    if colon is None:
        return slice(None) if start is None else slice(start, start + 1 or None)
    if step is not None and step < 1:
        message = f"the frames {words!r} go backward or nowhere"
        remedy = "Write a stride of 1 or more: flips follow time"
        raise InputError(message, remedy=remedy, where=where or None)
    return slice(start, stop, step or 1)


def chosen(frames: slice, total: int | None) -> Iterator[int]:
    """The numbers of the frames, upward; without an end where neither the slice nor a total has one."""
    if total is not None:
        return iter(range(*frames.indices(total)))
    return islice(count(), frames.start, frames.stop, frames.step)


# ---- atoms by words, in MDAnalysis's selection language, whoever reads the file


def select(trajectory: Trajectory, words: str) -> Int[np.ndarray, "chosen"]:
    """Indices of the atoms that words name at the first frame asked for, ascending.

    A selection that depends on where atoms are ("around 5 protein") is made once, there.

    Raises:
        InputError: the words are no selection, name no atom, or need what the file does not tell.
    """
    from MDAnalysis.exceptions import NoDataError, SelectionError

    table, where = trajectory.table, str(trajectory.path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe = _universe(trajectory)
        try:
            found = universe.select_atoms(words)
        except (NoDataError, AttributeError) as error:
            message = f"the selection {words!r} asks for what the file does not tell ({first_line(error)})"
            remedy = "Give a topology that has it with -s TOPOLOGY, or select by index"
            raise InputError(message, remedy=remedy, where=where) from error
        except (SelectionError, ValueError, TypeError) as error:
            message = f"{words!r} is no selection ({first_line(error)})"
            raise InputError(message, remedy=_LANGUAGE, where=where) from error
    if len(found) == 0:
        raise InputError(
            f"the selection {words!r} names no atom of {trajectory.atoms:,}; {_there_are(table)}",
            remedy=_LANGUAGE if table.named else "Give a topology with -s TOPOLOGY",
            where=where,
        )
    return np.asarray(found.indices, np.int64)


def _universe(trajectory: Trajectory) -> Any:
    """A Universe that stands at the first frame asked for. Distances in a selection are float32."""
    from MDAnalysis.lib.mdamath import triclinic_box

    first = next(iter(trajectory.frames()), None)
    if first is None:
        raise InputError(
            "no frame is left of what was asked for", remedy="Ask for others", where=str(trajectory.path)
        )
    if trajectory.universe is not None:
        # `frames` has left the Universe there
        return trajectory.universe
    if trajectory.topology is not None:
        table, universe = read_topology(trajectory.topology)
        table.give_elements(universe)
    else:
        universe = trajectory.table.universe()
    box = triclinic_box(*first.box.matrix) if first.box.pbc.all() else np.zeros(6, np.float32)
    universe.load_new(first.positions[None].astype(np.float32), order="fac", dimensions=np.asarray(box)[None])
    return universe


def _there_are(table: AtomTable) -> str:
    """What could have been named."""
    if not table.named:
        return "the file has no names of atoms"
    words = []
    for kind, values in (("names", table.names), ("residues", table.residue_names)):
        known, counts = np.unique(values.astype(str), return_counts=True)
        ordered = [str(one) for one in known[np.argsort(-counts, kind="stable")] if one]
        if ordered:
            words.append(f"{kind} {', '.join(ordered[:_SHOWN])}{', ...' if len(ordered) > _SHOWN else ''}")
    return "there are " + "; ".join(words)
