"""Run folder: all files of a run, for reports and for resuming."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import math
import os
import re
import sys
import time
import tomllib
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
import pyarrow as pa

from mdnum import units
from mdnum.errors import FolderError, MdnumError, expect_path, printable
from mdnum.plain import plain
from mdnum.store import checkpoint
from mdnum.store import files as manifest
from mdnum.store.checkpoint import FrameFile
from mdnum.store.columns import described
from mdnum.store.files import SIMULATION_FILE, SUBFOLDERS, SYSTEM_FILE, disk_errors, opened, refuse_link
from mdnum.store.layout import Layout
from mdnum.store.tables import TableStream, as_numpy

if TYPE_CHECKING:
    from ase import Atoms

_FILES = (
    SYSTEM_FILE, SIMULATION_FILE, "structure.extxyz", "provenance.json", "summary.json", "log.txt",
    "checkpoint.npz", "trajectory.traj", "report.html", "answers.json",
)  # fmt: skip
_SYSTEM = (SYSTEM_FILE, SIMULATION_FILE)
_LOCK = ".lock"
# of those, the one from which nothing is read: each report replaces it
_REPLACED = "report.html"
# what may be in a folder whose writing came to nothing
_NOTHING_YET = (
    SYSTEM_FILE, SIMULATION_FILE, "structure.extxyz", "provenance.json", "log.txt", manifest.NAME, _LOCK,
    "parts",
)  # fmt: skip
_QUANTITIES = ("length", "energy", "mass", "time", "temperature", "pressure")
_RESTORE = "Restore it from a copy, or run again in a new folder"
_LOGGER = logging.getLogger(__name__)
# what values of another kind or form than those that were written lead to
_OF_WRONG_VALUES = (
    ArithmeticError, AssertionError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
)  # fmt: skip
# what people do with system.toml and log.txt changes no number that was recorded
_EDITED = (SYSTEM_FILE, "log.txt")


def system_tables(file: Path) -> dict[str, Any]:
    """Return the tables of a system.toml, or of another description of a simulation.

    Raises:
        FolderError: the file is not valid TOML or JSON.
    """
    return _parsed(file, manifest.read_text(file))


def _parsed(file: Path, text: str) -> Any:
    is_json = file.suffix == ".json"
    try:
        return json.loads(text) if is_json else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        kind = "JSON" if is_json else "TOML"
        raise FolderError(f"the file is damaged: it is invalid {kind} ({error})", where=str(file)) from error


class RunFolder:
    """The folder of a run on disk.

    Rows, frames and log lines become permanent with the next checkpoint. `resume` continues a killed run from
    its last checkpoint. `resume` removes data written later. A resumed run has the same results as an
    uninterrupted run. Use `create` for a new run, and `open` for an existing run.
    """

    def __init__(self, path: Path, layout: Layout | None = None):
        self.path = path
        self._layout = layout
        self._streams: dict[str, TableStream] = {}
        self._frames = FrameFile(path / "trajectory.traj")
        self._log: TextIO | None = None
        self._lock: TextIO | None = None
        # whether this object writes the folder, and not only something about it
        self._owner = False
        # names that were there before the folder was this one's
        self._foreign: frozenset[str] = frozenset()
        # what was compared with the manifest, by name: its size and time then, and what was wrong
        self._checked: dict[str, tuple[tuple[int, int], str]] = {}
        # what the manifest lists, and which file that was read from
        self._manifest: tuple[tuple[int, int], dict[str, list[str]]] | None = None
        # what writes checkpoints, and the one that is being written
        self._beside = ThreadPoolExecutor(1)
        self._writing: Future[None] | None = None
        self._began = time.monotonic()
        self._written = -math.inf
        # what the last checkpoint took (s), making its state included; and when it was found due
        self._cost = 0.0
        self._asked: float | None = None
        # the state that came too soon after the last checkpoint, and the rows there were then
        self._pending: tuple[dict[str, Any], dict[str, int]] | None = None
        # what the schemas of its tables say besides what its own files do: `system`, and further `units`
        self.told: dict[str, Any] = {}
        #: whether rows are on disk as soon as `flush` has been called, in any folder
        self.in_parts = False

    @classmethod
    def create(cls, path: str | os.PathLike[str], layout: Layout) -> RunFolder:
        """Create a new, empty run folder.

        Args:
            path: path of the folder; created if missing, parents included.
            layout: kind of the folder, with its tables.

        Raises:
            FolderError: the folder contains a run or other files, is a file, or cannot be written.
        """
        folder = cls(Path(path), layout)
        if folder.path.exists() and not folder.path.is_dir():
            raise FolderError("the path is a file", remedy="Choose another folder", where=str(path))
        folder._usable()
        try:
            folder.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FolderError(
                f"the folder cannot be created: {error.strerror}", remedy="Use another path", where=str(path)
            ) from error
        with disk_errors(folder.path):
            folder._take_lock()
            # once more: another process may have begun a run there meanwhile, and have finished it
            present = folder._usable()
            for name in SUBFOLDERS:
                # through a link, the files of somebody else would be removed
                refuse_link(folder.path / name / "any")
            made = manifest.load(folder.path) if present else None
            for name in (*_FILES, manifest.NAME, *(made.files if made is not None else ())):
                if (folder.path / name).parent == folder.path:
                    (folder.path / name).unlink(missing_ok=True)
            folder._sweep("parts/*.parquet", "figures/*.svg", "structures/*.extxyz")
            folder._foreign = frozenset(entry.name for entry in folder.path.iterdir())
            folder._owner = True
            manifest.save(folder.path, manifest.Manifest(layout))
        _LOGGER.info("%s begins in %s", layout.command, printable(str(folder.path)))
        return folder

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> RunFolder:
        """Open an existing run folder, finished or unfinished, for reading or for `resume`.

        Raises:
            FolderError: the folder does not exist, or does not contain a run.
        """
        expect_path(path, "Give the folder of a run")
        folder = cls(Path(path))
        if not folder.path.is_dir():
            raise FolderError("the folder does not exist", remedy="Give the folder of a run", where=str(path))
        names = (*_FILES, "parts", manifest.NAME)
        if not any([*((folder.path / name).exists() for name in names), *folder.path.glob("*.parquet")]):
            raise FolderError("the folder holds no run", remedy="Give the folder of a run", where=str(path))
        made = manifest.load(folder.path)
        folder._layout = None if made is None else made.layout
        return folder

    @property
    def layout(self) -> Layout:
        """Layout of the run folder: its kind and its tables.

        Raises:
            FolderError: the folder has no manifest, or a manifest of a version that did not store the layout.
        """
        if self._layout is None:
            seen = "is missing, although it must list the tables of the folder"
            if (self.path / manifest.NAME).exists():
                seen = "does not list the tables of the folder; an earlier version of mdnum wrote the file"
            remedy = "Run again in a new folder; the parquet files can be read one by one"
            raise FolderError(seen, remedy=remedy, where=str(self.path / manifest.NAME))
        return self._layout

    def read_as(self, layout: Layout) -> None:
        """Read this folder in the present format, even if it has an older format."""
        self._layout = layout

    @property
    def kind(self) -> str:
        """Kind of the run folder, set by the command that created the folder."""
        return self.layout.kind

    # -- writing ---------------------------------------------------------------------------------

    def append(self, table: str, columns: Mapping[str, Any]) -> None:
        """Append rows to a table. Rows stay in memory until the next checkpoint.

        Args:
            columns: equally long arrays by column name, at least the declared ones.

        Raises:
            ValueError: the table is not declared, or a column is missing, undeclared or of another length.
        """
        self._stream(table).append(columns)

    def look_up(self, table: str, of: str, columns: Mapping[str, Any]) -> None:
        """Add columns with values that are looked up by index; see `TableStream.look_up`."""
        self._stream(table).look_up(of, columns)

    def append_frame(self, atoms: Atoms) -> None:
        """Append a frame to trajectory.traj, with float64 values that are stored exactly."""
        self._frames.append(atoms)

    def log(self, line: str) -> None:
        """Append a line to log.txt, which can be read while the run continues."""
        path = self.path / "log.txt"
        with disk_errors(path):
            if self._log is None:
                self._log = io.TextIOWrapper(opened(path, "ab"), encoding="utf-8")
            self._log.write(line.rstrip("\n") + "\n")
            self._log.flush()
        _LOGGER.debug("%s: %s", self.path.name, printable(line))

    def checkpoint_due(self) -> bool:
        """Return True if a new checkpoint is due.

        The interval is the largest of 2 s, 1 % of the run's duration, and 50 times the duration of a
        checkpoint. A killed run loses about 1 % of its computing time.
        """
        now = time.monotonic()
        due = now - self._written >= max(2.0, 0.01 * (now - self._began), 50 * self._cost)
        self._asked = now if due else None
        return due

    def checkpoint(self, state: Mapping[str, Any], force: bool = False) -> bool:
        """Save the state and all appended data, so that a killed run can be resumed.

        Args:
            state: arrays (numpy, jax) and plain values (numbers, text, lists, dicts), which `load_checkpoint`
                returns bit for bit.
            force: True to write even if the last checkpoint is recent (the first and the last of a run).

        Returns:
            True if the checkpoint was written (see `checkpoint_due`); if not, `finalize` writes it later.

        Raises:
            FolderError: the disk is full; the checkpoint before this one remains valid.
        """
        if not force and not self.checkpoint_due():
            self._pending = (dict(state), self._rows())
            return False
        self.checkpoint_beside(lambda: state)
        self._settle()
        return True

    def checkpoint_beside(self, state: Callable[[], Mapping[str, Any]]) -> None:
        """Write a checkpoint in a background thread. The thread also calls `state`.

        An error in the thread is raised at the next checkpoint or in `finalize`.
        """
        self._settle()
        began = time.monotonic() if self._asked is None else self._asked
        self._asked = self._pending = None
        # parts first, then the checkpoint that counts them: a kill in between only leaves rows to drop
        for stream in self._streams.values():
            stream.flush()
        log = self.path / "log.txt"
        store = {
            "rows": {**dict.fromkeys(self.layout.always, 0), **self._rows()},
            "frames": self._frames.mark(),
            "log": log.stat().st_size if log.exists() else 0,
        }
        written = {}
        for stream in self._streams.values():
            written |= {name: each for name, each in stream.written.items() if name.startswith("parts/")}
            stream.written = {}

        def write() -> None:
            checkpoint.write(self.path / "checkpoint.npz", state(), store, written)
            self._written = time.monotonic()
            self._cost = self._written - began

        self._written = time.monotonic()
        self._writing = self._beside.submit(write)

    def finalize(self) -> None:
        """Finish the folder: merge part files into one parquet file per table. Resuming stays possible."""
        if self._pending is not None and self._pending[1] == self._rows():
            self.checkpoint(self._pending[0], force=True)
        for name in self.layout.always:
            self._stream(name)
        self.merge()
        self._owner = True
        self._list_files(finished=True)
        parts = self.path / "parts"
        if parts.is_dir() and not any(parts.iterdir()):
            parts.rmdir()
        self.close()

    def flush(self, *last: str) -> None:
        """Write all appended rows. The tables in `last` are written last."""
        for name in sorted(self._streams, key=last.count):
            self._streams[name].flush()

    def merge(self) -> None:
        """Merge each table into one file, which can be read while the run goes on."""
        self._settle()
        for stream in self._streams.values():
            stream.merge()

    def close(self) -> None:
        """Close all files and release the lock. Rows after the last checkpoint are lost."""
        # also for one that began as the run was interrupted
        self._beside.shutdown()
        self._frames.close()
        for stream in self._streams.values():
            stream.close()
        for file in (self._log, self._lock):
            if file is not None:
                file.close()
        self._log = self._lock = None

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json. NaN and infinity become null."""
        self._write_json("summary.json", summary)
        made = manifest.load(self.path) if self._owner else None
        if made is not None and made.finished:
            # a summary is written last, so that scripts and the like are there by now
            self._list_files()

    def write_provenance(self, provenance: Mapping[str, Any]) -> None:
        """Write provenance.json. All input files must already be in the folder."""
        self._write_json("provenance.json", provenance)
        if self._owner:
            names = {entry.name for entry in self.path.iterdir() if not entry.name.startswith(".")}
            names -= {*self._foreign, *SUBFOLDERS, "log.txt", manifest.NAME}
            manifest.update(self.path, manifest.listed_files(self.path, names))

    # -- resuming --------------------------------------------------------------------------------

    def has_checkpoint(self) -> bool:
        """Return True if the run can be resumed from a checkpoint."""
        return (self.path / "checkpoint.npz").exists()

    def load_checkpoint(self) -> dict[str, Any]:
        """Return the state that was saved by the last checkpoint.

        Raises:
            FolderError: there is no checkpoint, or the checkpoint cannot be read.
        """
        return self._read_checkpoint()[0]

    def resume(self, layout: Layout | None = None) -> dict[str, Any]:
        """Remove rows, frames and log lines after the last checkpoint. Return the saved state.

        Args:
            layout: new layout of the folder, if the command has added columns since the run began.

        Raises:
            FolderError: there is no checkpoint, another process writes the folder, or files are missing.
        """
        held = self.layout
        self._layout = layout or held
        self._take_lock()
        state, store = self._read_checkpoint()
        with disk_errors(self.path):
            # nothing is dropped from a folder that will not be resumed
            for name in ("trajectory.traj", "log.txt"):
                refuse_link(self.path / name, in_place=True)
            for name in self._listed():
                if name not in ("log.txt", "summary.json"):
                    self.check(name)
            self._owner = True
            manifest.update(self.path, {}, ["trajectory.traj", "log.txt"], False, self._layout)
            self._sweep()
            for name, rows in store["rows"].items():
                self._stream(name).truncate(rows)
            self._frames.truncate(store["frames"])
            if (log := self.path / "log.txt").exists():
                with opened(log, "r+b") as file:
                    os.ftruncate(file.fileno(), min(store["log"], log.stat().st_size))
        _LOGGER.info("%s continues in %s", self.layout.command, printable(str(self.path)))
        return state

    def take(self, layout: Layout) -> None:
        """Lock a run folder that is resumed from answers.json. No other process can then write into it.

        Raises:
            FolderError: another process writes the folder, or files that are needed to resume have changed.
        """
        self._layout = layout
        self._take_lock()
        # what its end would refuse is refused before anything is asked
        for name in ("answers.json", "provenance.json"):
            self.check(name)

    def restart(self) -> None:
        """Mark a resumed folder as unfinished. Remove its tables, which are written again at the end.

        Part files that remain because `finalize` was killed are also removed.
        """
        with disk_errors(self.path):
            refuse_link(self.path / "log.txt", in_place=True)
            refuse_link(self.path / "parts" / "any")
            self._owner = True
            manifest.update(self.path, {}, ["log.txt"], False, self._layout)
            self._sweep()
            for name in self.layout.always:
                parts = (self.path / "parts").glob(f"{name}-*.parquet")
                for file in (self.path / f"{name}.parquet", *parts):
                    manifest.remove(file)

    # -- reading ---------------------------------------------------------------------------------

    def table(self, name: str, columns: Sequence[str] | None = None, rows: int | None = None) -> pa.Table:
        """Return a table from disk. A killed run has only the rows before the last checkpoint.

        Args:
            columns: names of the columns to read; None for all.
            rows: largest number of rows to read, beginning with the first.
        """
        return self._reader(name).read(columns, min(self.rows(name), rows or sys.maxsize))

    def batches(self, name: str, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """Yield the rows of a table in batches, for tables larger than memory."""
        left = self.rows(name)
        for batch in self._reader(name).batches(columns):
            if left <= 0:
                return
            yield batch.slice(0, left)
            left -= batch.num_rows

    def read(
        self, name: str, columns: Sequence[str] | None = None, rows: int | None = None
    ) -> dict[str, np.ndarray]:
        """Return a table as numpy arrays by column name. Missing columns are omitted."""
        table = self.table(name, columns, rows)
        declared = {} if self._layout is None else self._layout.columns(name)
        gaps = {key: table[key].null_count for key in table.column_names if table[key].null_count}
        free = [key for key in gaps if declared.get(key, ("", not declared))[1]]
        unknown = set() if columns else {key for key in free if gaps[key] == len(table)}
        if odd := [key for key in gaps if key not in unknown]:
            raise FolderError(f"column {odd[0]!r} of table {name!r} has missing values", where=str(self.path))
        return {key: as_numpy(table[key]) for key in table.column_names if key not in unknown}

    def rows(self, name: str) -> int:
        """Return the number of rows of a table."""
        stream = self._reader(name)
        if stream.parts() and self.has_checkpoint():
            # series and flips of an unfinished run agree with one another only at a checkpoint
            return self._read_checkpoint()[1]["rows"].get(name, 0)
        return stream.flushed

    @property
    def system_file(self) -> Path | None:
        """File that describes the simulation. None if missing."""
        return next((self.path / name for name in _SYSTEM if (self.path / name).exists()), None)

    @property
    def system(self) -> dict[str, Any]:
        """Tables of the system file of the run. Empty if there is no system file.

        Raises:
            FolderError: the system file is not valid TOML or JSON.
        """
        file = self.system_file
        return {} if file is None else system_tables(file)

    @cached_property
    def about(self) -> dict[str, Any]:
        """Metadata of the tables: version, kind, system, digest of the run, and units.

        The metadata have no time of writing. Resumed and uninterrupted runs write equal bytes.
        """
        made, system = self._read_json("provenance.json"), self.system
        named = system.get("units") or system.get("world")
        known = vars(units.get(str(named))) if named else {}
        names = {name: known[name] for name in _QUANTITIES if name in known}
        if named and named != "ball":
            cutoffs = [one.get("cutoff") or {} for one in (system, *(system.get("terms") or {}).values())]
            squared = any(str(one.get("compare")).startswith("r2") for one in cutoffs)
            names["decision"] = f"{names['length']}²" if squared else names["length"]
        # without a system nothing says that two runs are equal: each is one of its own
        equal = [made.get("hashes"), made.get("fingerprint")]
        run = json.dumps(equal if equal[0] else [made, str(self.path.absolute())], sort_keys=True)
        return {
            "version": str(made.get("versions", {}).get("mdnum") or ""), "kind": self.kind,
            "system": str(self.told.get("system") or made.get("system") or ""),
            "run": hashlib.sha256(run.encode()).hexdigest() if made else "",
            "units": {**names, **self.told.get("units", {})},
        }  # fmt: skip

    @property
    def summary(self) -> dict[str, Any]:
        """Contents of summary.json; empty if this file was not written yet."""
        return self._read_json("summary.json")

    @property
    def again(self) -> str:
        """Imperative sentence that tells the user how to continue an unfinished folder."""
        return _again(self.path)

    @property
    def provenance(self) -> dict[str, Any]:
        """Contents of provenance.json; empty if this file was not written."""
        return self._read_json("provenance.json")

    def damaged(self) -> dict[str, str]:
        """Return the names of changed or missing files, and what is wrong with each file.

        Raises:
            FolderError: the manifest itself is damaged.
        """
        return {name: wrong for name in self._listed() if (wrong := self._wrong(name))}

    def check(self, name: str) -> None:
        """Raise an error if a file differs from its digest in the manifest. Unlisted files pass.

        Raises:
            FolderError: the file is missing, or has changed since it was written.
        """
        if wrong := self._wrong(name):
            others = self.damaged()
            tables = [each for each in self._listed() if each.endswith((".parquet", ".traj"))]
            # part files by their number only
            sound = [each for each in tables if each not in others and "/" not in each]
            rest = f"; {', '.join(sound)} can still be read" if sound else ""
            raise FolderError(f"{wrong}{rest}", remedy=_RESTORE, where=str(self.path / name))

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Convert exceptions caused by invalid contents of the folder into one-line errors.

        Raises:
            FolderError: the folder is damaged or unfinished, or has no manifest; or its digests match, but it
                has contents that mdnum does not write. In the latter case, the message names a line of
                mdnum's code. If the folder is intact and was written by this object, the exception is a bug
                and is raised unchanged.
        """
        try:
            yield
        except (MdnumError, OSError):
            raise
        except Exception as error:
            wrong = self.damaged()
            if self._owner and not wrong:
                raise
            seen = " ".join(str(error).split())[:200]
            last = traceback.extract_tb(error.__traceback__)[-1]
            place = f"in {last.name}, {Path(last.filename).name}:{last.lineno}"
            names = f"damaged: {', '.join(wrong)}" if wrong else place
            message = f"holds what mdnum does not write ({names}): {type(error).__name__} {seen}".rstrip()
            if isinstance(error, KeyError) and not wrong:
                message = (
                    f"lacks {seen}, which this version of mdnum reads ({place}): another version wrote it"
                )
            raise FolderError(message, remedy=_RESTORE, where=str(self.path)) from error

    def check_start(self) -> None:
        """Raise an error if an input file (system, structure) differs from the manifest.

        Raises:
            FolderError: the input was changed, so that a new run would differ from the recorded run.
        """
        for name in self._listed():
            written = name in _FILES or name.endswith(".parquet")
            further = not written and "/" not in name and not self.layout.keeps(name)
            if further or name in (*_SYSTEM, "structure.extxyz"):
                self.check(name)

    def noted(self) -> list[str]:
        """Return a message for each changed file, or for a folder that cannot be checked."""
        if not (self.path / manifest.NAME).exists():
            return [
                f"{self.path}: has no {manifest.NAME}, so that nothing in it could be checked for damage."
            ]
        return [f"{self.path / name}: {wrong}." for name, wrong in self.damaged().items()]

    # -- inside ----------------------------------------------------------------------------------

    def _usable(self) -> list[str]:
        """Return the names of files in a folder for a new run. Raise an error if the folder is in use."""
        there = self.path.iterdir() if self.path.is_dir() else ()
        present = sorted(entry.name for entry in there if entry.name != _LOCK)
        if present and not _came_to_nothing(self.path, present):
            _refuse_to_overwrite(self.path, present)
        return present

    def _stream(self, name: str) -> TableStream:
        if name not in self._streams:
            if not self.layout.columns(name):
                raise ValueError(f"a result folder of kind {self.kind!r} has no table {name!r}")
            own = self.layout.described
            describe = lambda schema: described(schema, name, self.about, own)  # noqa: E731
            args = (self.path, name, self.layout)
            self._streams[name] = TableStream(*args, describe=describe, in_parts=self.in_parts)
        return self._streams[name]

    def _reader(self, name: str) -> TableStream:
        merged = f"{name}.parquet"
        if not (self.path / merged).exists():
            self.check(merged)
        return TableStream(self.path, name, self._layout, lambda path: self.check(manifest.place(path)[1]))

    def _sweep(self, *patterns: str) -> None:
        """Remove temporary files of a killed process, and files that match given patterns."""
        for pattern in (*patterns, ".*.part", *(f"{name}/.*.part" for name in SUBFOLDERS)):
            for file in self.path.glob(pattern):
                if not (file.parent.is_symlink() and file.parent != self.path):
                    file.unlink()

    def _listed(self) -> dict[str, list[str]]:
        path = self.path / manifest.NAME
        try:
            seen = os.lstat(path)
        except FileNotFoundError:
            return {}
        # it is replaced, never written in place
        state = (seen.st_ino, seen.st_mtime_ns)
        if self._manifest is None or self._manifest[0] != state:
            made = manifest.load(self.path)
            self._manifest = (state, {} if made is None else made.files)
        return self._manifest[1]

    def _wrong(self, name: str) -> str:
        """Return how a file differs from the manifest. "" for intact and for unlisted files."""
        allowed = self._listed().get(name)
        if allowed is None:
            return ""
        path = self.path / name
        refuse_link(path)
        try:
            seen = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return "" if manifest.ABSENT in allowed else "is missing"
        state = (seen.st_size, seen.st_mtime_ns)
        if self._checked.get(name, ((), ""))[0] != state:
            found = manifest.digest(path)
            while found not in allowed and (now := self._listed().get(name, [found])) != allowed:
                # a run that goes on replaced the file meanwhile
                allowed, found = now, manifest.digest(path)
            edited = "was changed since it was written"
            wrong = edited if name in _EDITED else "the file is damaged: its bytes have changed"
            self._checked[name] = (state, "" if found in allowed else wrong)
        return self._checked[name][1]

    def _list_files(self, finished: bool | None = None) -> None:
        """Add unlisted files to the manifest. Update the entries of files that grew."""
        listed = self._listed()
        there = [f"structures/{entry.name}" for entry in (self.path / "structures").glob("*.extxyz")]
        there += [entry.name for entry in self.path.iterdir() if entry.name not in self._foreign]
        fixed = {*_FILES} - {_REPLACED}
        new = [name for name in there if name not in listed and (name in fixed or self.layout.keeps(name))]
        now = manifest.listed_files(self.path, {*new, *({"log.txt", "trajectory.traj"} & set(there))})
        for name, allowed in listed.items():
            # what was about to be replaced has been
            if len(allowed) > 1 and name not in now and (one := manifest.digest(self.path / name)) in allowed:
                now[name] = [one]
        manifest.update(self.path, now, finished=finished)

    def _rows(self) -> dict[str, int]:
        return {name: stream.rows for name, stream in self._streams.items()}

    def _settle(self) -> None:
        """Wait until the current checkpoint is written. Raise any error of its thread."""
        if self._writing is not None:
            written, self._writing = self._writing, None
            written.result()

    def _read_checkpoint(self) -> tuple[dict[str, Any], dict[str, Any]]:
        if not self.has_checkpoint():
            raise FolderError("the folder has no checkpoint", remedy=self.again, where=str(self.path))
        self.check("checkpoint.npz")
        path = self.path / "checkpoint.npz"
        state, store = checkpoint.read(path)
        rows, mark, log = store.get("rows"), store.get("frames"), store.get("log")
        # names of tables become names of files
        if (
            not (isinstance(rows, dict) and isinstance(mark, list) and len(mark) == 3)
            or not (self._layout is None or all(map(self._layout.columns, rows)))
            or not all(isinstance(count, int) and count >= 0 for count in (*rows.values(), *mark, log))
        ):
            raise FolderError(
                "the checkpoint refers to a table that mdnum does not write",
                remedy="Run again in a new folder",
                where=str(path),
            )
        return state, {"rows": rows, "frames": tuple(mark), "log": log}

    def _take_lock(self) -> None:
        if os.name != "posix":
            return
        import fcntl

        lock = io.TextIOWrapper(opened(self.path / _LOCK, "ab"))
        try:
            # the system frees it when the process dies, however it dies
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            raise FolderError(
                "another process is writing to this folder", remedy="Wait until it ends", where=str(self.path)
            ) from None
        except OSError:
            # a file system without locks (some network mounts): go on without
            lock.close()
            return
        self._lock = lock

    def _write_json(self, name: str, value: Mapping[str, Any]) -> None:
        text = json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False)
        manifest.write_text(self.path / name, text + "\n")

    def _read_json(self, name: str) -> dict[str, Any]:
        self.check(name)
        text = manifest.read_text(self.path / name)
        held = _parsed(self.path / name, text) if text else {}
        if not isinstance(held, dict):
            raise FolderError("the file is damaged: it is not a JSON object", where=str(self.path / name))
        return held


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Convert exceptions caused by invalid contents of a file into one-line errors.

    Raises:
        FolderError: the file has contents that mdnum does not write.
    """
    try:
        yield
    except _OF_WRONG_VALUES as error:
        seen = " ".join(str(error).split())[:200]
        raise FolderError(
            f"the file contains data that mdnum never writes into it ({type(error).__name__}: {seen})",
            remedy="Restore the file from a copy, or start again in a new folder",
            where=str(path),
        ) from error


def expect(right: object, seen: str) -> None:
    """Raise an error if a restored value is invalid. Use this function inside `restoring`.

    Raises:
        ValueError: the condition is false.
    """
    if not right:
        raise ValueError(seen)


def _came_to_nothing(path: Path, present: Sequence[str]) -> bool:
    """Return True if a folder has only files of a run that stopped before the first result."""
    made = manifest.load(path)
    if made is None or made.finished or (path / "parts").is_symlink():
        return False
    known = {*_NOTHING_YET, *made.files}
    something = {"checkpoint.npz", "answers.json", "summary.json"}
    return all(name in known or re.fullmatch(r"\.[0-9a-f]{16}\.part", name) for name in present) and not (
        something & set(present) or any((path / "parts").glob("*.parquet"))
    )


def _refuse_to_overwrite(path: Path, present: Sequence[str]) -> None:
    """Raise the error for a run folder that is not empty, with a remedy."""
    if not any(name in (*_FILES, "parts", manifest.NAME) for name in present):
        seen = f"is not empty (it holds {present[0]!r})"
        raise FolderError(seen, remedy="Choose an empty or a new folder for the results", where=str(path))
    made = manifest.load(path)
    remedy = "Choose another folder, or remove this folder"
    if manifest.resumable(path):
        remedy = f"{_again(path)}, or choose another folder"
    elif made is not None and not made.finished:
        remedy = _again(path)
    raise FolderError("the folder already holds a run", remedy=remedy, where=str(path))


def _again(path: Path) -> str:
    """Return a sentence on how to continue an unfinished run."""
    made = manifest.load(path)
    if made is None or made.layout is None:
        return "Run again in a new folder"
    verb = f"mdnum {made.layout.command}"
    if manifest.resumable(path):
        return f"Continue it with `{verb} --resume {path}`"
    if _came_to_nothing(path, [entry.name for entry in path.iterdir()]):
        return f"Nothing of it was kept: give the `{verb}` command again"
    return f"It cannot be continued: give the `{verb}` command again for another folder, or remove this one"
