"""The run folder: what a rollout writes as it goes, what a report reads, what a killed run resumes from."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
import pyarrow as pa

from mdnum.errors import FolderError
from mdnum.store import checkpoint
from mdnum.store.atomic import disk_errors, write_text
from mdnum.store.frames import FrameFile
from mdnum.store.tables import COLUMNS, TABLES, TableStream

if TYPE_CHECKING:
    from ase import Atoms

_FILES = (
    "system.toml", "structure.extxyz", "provenance.json", "summary.json", "log.txt", "checkpoint.npz",
    "trajectory.traj", "report.html", "gradients.npz", "answers.json",
    *(f"{name}.parquet" for name in COLUMNS),
)  # fmt: skip
_LOCK = ".lock"


class RunFolder:
    """One run on disk.

    Rows, frames and log lines may be appended at any time; they count once a checkpoint has been
    written after them. A run that is killed resumes from its last checkpoint: `resume()` drops
    whatever came later and returns the state, so that the run continues as if it had never stopped.

    Use `create` for a new run, `open` for one that is there (to read it, or to resume it).

    Attributes:
        path: the folder.
        world: which tables it has, a key of `TABLES`.
    """

    def __init__(self, path: Path, world: str = "md"):
        self.path = path
        self.world = world
        self._streams: dict[str, TableStream] = {}
        self._frames = FrameFile(path / "trajectory.traj")
        self._log: TextIO | None = None
        self._lock: TextIO | None = None
        self._began = time.monotonic()
        self._written = -math.inf
        # the state that came too soon after the last checkpoint, and the rows there were then
        self._pending: tuple[dict[str, Any], dict[str, int]] | None = None

    @classmethod
    def create(cls, path: str | os.PathLike[str], overwrite: bool = False, world: str = "md") -> RunFolder:
        """A new, empty run folder.

        Args:
            path: made if missing, parents included.
            overwrite: remove the run that is there. Files that are not a run's are left alone.
            world: a key of `TABLES`.

        Raises:
            FolderError: the folder holds a run or other files, is a file, or cannot be written.
        """
        folder = cls(Path(path), world)
        if folder.path.exists() and not folder.path.is_dir():
            raise FolderError("is a file, not a folder", remedy="Choose another folder", where=str(path))
        present = sorted(entry.name for entry in folder.path.iterdir()) if folder.path.is_dir() else []
        present = [name for name in present if name != _LOCK]
        if present and not overwrite:
            holds_run = any(name in (*_FILES, "parts") for name in present)
            raise FolderError(
                "already holds a run" if holds_run else f"is not empty (it holds {present[0]!r})",
                remedy="Choose another folder, resume that run or allow it to be overwritten"
                if holds_run
                else "Choose an empty or a new folder",
                where=str(path),
            )
        try:
            folder.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FolderError(
                f"cannot be made: {error.strerror}", remedy="Choose another folder", where=str(path)
            ) from error
        with disk_errors(folder.path):
            folder._take_lock()
            for name in _FILES:
                (folder.path / name).unlink(missing_ok=True)
            for pattern in ("parts/*.parquet", "figures/*.svg", ".*.part", "parts/.*.part"):
                for file in folder.path.glob(pattern):
                    file.unlink()
        return folder

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> RunFolder:
        """A run folder that is there, finished or not, for reading (or `resume`).

        Raises:
            FolderError: no such folder, or no run in it.
        """
        folder = cls(Path(path))
        if not folder.path.is_dir():
            raise FolderError("no such folder", remedy="Give the folder of a run", where=str(path))
        if not any((folder.path / name).exists() for name in (*_FILES, "parts")):
            raise FolderError("holds no run", remedy="Give the folder of a run", where=str(path))

        def share(world: str) -> float:
            there = [(folder.path / f"{name}.parquet").exists() for name in TABLES[world]]
            return sum(there) / len(there)

        # some tables are those of two worlds, and a folder from before has not all that there are now
        likeliest = max(TABLES, key=share)
        folder.world = likeliest if share(likeliest) > 0 else folder.world
        return folder

    # -- writing ---------------------------------------------------------------------------------

    def append(self, table: str, columns: Mapping[str, Any]) -> None:
        """Adds rows to a table (see `TABLES`); cheap, kept in memory until a checkpoint.

        Args:
            columns: equally long arrays by column name, at least those in `columns_of(world, table)`.

        Raises:
            ValueError: a column is missing, not expected or of another length.
        """
        self._stream(table).append(columns)

    def append_frame(self, atoms: Atoms) -> None:
        """Adds a frame to trajectory.traj, float64 bit for bit."""
        self._frames.append(atoms)

    def log(self, line: str) -> None:
        """Adds a line to log.txt, readable at once by whoever watches the run."""
        path = self.path / "log.txt"
        with disk_errors(path):
            if self._log is None:
                self._log = open(path, "a", encoding="utf-8")  # noqa: SIM115
            self._log.write(line.rstrip("\n") + "\n")
            self._log.flush()

    def checkpoint_due(self) -> bool:
        """Whether `checkpoint` would write now.

        The interval is 2 s at first and 1 % of the time the run has taken later on: a kill costs at
        most that much, and a run of days has a thousand part files, not a hundred thousand.
        """
        now = time.monotonic()
        return now - self._written >= max(2.0, 0.01 * (now - self._began))

    def checkpoint(self, state: Mapping[str, Any], force: bool = False) -> bool:
        """Makes everything appended so far, and state, the point a killed run resumes from.

        Args:
            state: arrays (numpy, jax) and plain values (numbers, text, lists, dicts); all come back
                bit for bit from `load_checkpoint`.
            force: write even if the last checkpoint is recent (the first and the last of a run).

        Returns:
            whether it was written (see `checkpoint_due`); if not, `finalize` makes up for it.

        Raises:
            FolderError: the disk is full; the checkpoint before this one remains valid.
        """
        if not force and not self.checkpoint_due():
            self._pending = (dict(state), self._rows())
            return False
        self._write_checkpoint(state)
        return True

    def finalize(self) -> None:
        """Ends the writing: one parquet file a table, no part files; the folder can still be resumed."""
        if self._pending is not None and self._pending[1] == self._rows():
            self._write_checkpoint(self._pending[0])
        for name in dict.fromkeys((*TABLES[self.world], *self._streams)):
            self._stream(name).merge()
        parts = self.path / "parts"
        if parts.is_dir() and not any(parts.iterdir()):
            parts.rmdir()
        self.close()

    def close(self) -> None:
        """Closes files and gives up the lock; rows after the last checkpoint are dropped."""
        self._frames.close()
        for file in (self._log, self._lock):
            if file is not None:
                file.close()
        self._log = self._lock = None

    def write_system(self, toml: str) -> None:
        """Writes system.toml, the fully resolved system."""
        write_text(self.path / "system.toml", toml)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Writes summary.json (NaN and infinity, which JSON does not have, become null)."""
        self._write_json("summary.json", summary)

    def write_provenance(self, provenance: Mapping[str, Any]) -> None:
        """Writes provenance.json."""
        self._write_json("provenance.json", provenance)

    # -- resuming --------------------------------------------------------------------------------

    def has_checkpoint(self) -> bool:
        """Whether there is something to resume from."""
        return (self.path / "checkpoint.npz").exists()

    def load_checkpoint(self) -> dict[str, Any]:
        """The state given to the last `checkpoint` that was written.

        Raises:
            FolderError: there is none, or it cannot be read.
        """
        return self._read_checkpoint()[0]

    def resume(self) -> dict[str, Any]:
        """Drops all rows, frames and log lines after the last checkpoint and returns its state.

        Raises:
            FolderError: no checkpoint, another process writes the folder, or files are missing.
        """
        self._take_lock()
        state, store = self._read_checkpoint()
        with disk_errors(self.path):
            for pattern in (".*.part", "parts/.*.part"):
                for file in self.path.glob(pattern):
                    file.unlink()
            for name, rows in store["rows"].items():
                self._stream(name).truncate(rows)
            self._frames.truncate(tuple(store["frames"]))
            if (log := self.path / "log.txt").exists():
                os.truncate(log, min(store["log"], log.stat().st_size))
        return state

    def take(self) -> None:
        """Makes this the only process that writes a folder which is gone on with from answers.json.

        Raises:
            FolderError: another process writes the folder.
        """
        self._take_lock()

    # -- reading ---------------------------------------------------------------------------------

    def table(self, name: str, columns: Sequence[str] | None = None, rows: int | None = None) -> pa.Table:
        """A table as far as it is on disk; of a run that was killed, the rows its checkpoint counts.

        Args:
            columns: only these.
            rows: at most the first rows.
        """
        return TableStream(self.path, name, self.world).read(
            columns, min(self.rows(name), rows or sys.maxsize)
        )

    def read(
        self, name: str, columns: Sequence[str] | None = None, rows: int | None = None
    ) -> dict[str, np.ndarray]:
        """As `table`, a numpy array by column name."""
        table = self.table(name, columns, rows)
        return {key: table[key].to_numpy() for key in table.column_names}

    def rows(self, name: str) -> int:
        """Rows of a table that `table` gives."""
        stream = TableStream(self.path, name, self.world)
        if stream.parts() and self.has_checkpoint():
            # series and flips of an unfinished run agree with one another only at a checkpoint
            return self._read_checkpoint()[1]["rows"].get(name, 0)
        return stream.flushed

    @property
    def system_toml(self) -> str:
        """The text of system.toml."""
        return self._read_text("system.toml")

    @property
    def summary(self) -> dict[str, Any]:
        """summary.json; empty if the run has not come that far."""
        return self._read_json("summary.json")

    @property
    def provenance(self) -> dict[str, Any]:
        """provenance.json; empty if it was not written."""
        return self._read_json("provenance.json")

    # -- inside ----------------------------------------------------------------------------------

    def _stream(self, name: str) -> TableStream:
        if name not in self._streams:
            self._streams[name] = TableStream(self.path, name, self.world)
        return self._streams[name]

    def _rows(self) -> dict[str, int]:
        return {name: stream.rows for name, stream in self._streams.items()}

    def _write_checkpoint(self, state: Mapping[str, Any]) -> None:
        # parts first, then the checkpoint that counts them: a kill in between only leaves rows to drop
        for stream in self._streams.values():
            stream.flush()
        log = self.path / "log.txt"
        store = {
            "rows": {**dict.fromkeys(TABLES[self.world], 0), **self._rows()},
            "frames": self._frames.mark(),
            "log": log.stat().st_size if log.exists() else 0,
        }
        checkpoint.write(self.path / "checkpoint.npz", state, store)
        self._written = time.monotonic()
        self._pending = None

    def _read_checkpoint(self) -> tuple[dict[str, Any], dict[str, Any]]:
        if not self.has_checkpoint():
            raise FolderError(
                "has no checkpoint to resume from", remedy="Run again in a new folder", where=str(self.path)
            )
        return checkpoint.read(self.path / "checkpoint.npz")

    def _take_lock(self) -> None:
        if os.name != "posix":
            return
        import fcntl

        lock = open(self.path / _LOCK, "w")  # noqa: SIM115
        try:
            # the system frees it when the process dies, however it dies
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            raise FolderError(
                "another process is writing this run", remedy="Wait for it to end", where=str(self.path)
            ) from None
        except OSError:
            # a file system without locks (some network mounts): go on without
            lock.close()
            return
        self._lock = lock

    def _write_json(self, name: str, value: Mapping[str, Any]) -> None:
        text = json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False)
        write_text(self.path / name, text + "\n")

    def _read_text(self, name: str) -> str:
        path = self.path / name
        return path.read_text(encoding="utf-8") if path.exists() else ""

    def _read_json(self, name: str) -> dict[str, Any]:
        text = self._read_text(name)
        try:
            return json.loads(text) if text else {}
        except json.JSONDecodeError as error:
            raise FolderError(f"not valid JSON ({error})", where=str(self.path / name)) from error


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "__array__"):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value
