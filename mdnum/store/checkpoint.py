"""Checkpoint file of a run: exact arrays and plain values in an npz file."""

from __future__ import annotations

import io
import json
import math
import os
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from mdnum.errors import FolderError
from mdnum.store import files as manifest
from mdnum.store.files import disk_errors, opened, refuse_link, replacing

# members of the archive that are not arrays of the state
_META, _STORE = "mdnum meta", "mdnum store"


def write(
    path: Path, state: Mapping[str, Any], store: Mapping[str, Any], beside: Mapping[str, list[str]]
) -> None:
    """Write a checkpoint file. The manifest lists all files written since the previous checkpoint.

    Args:
        state: state of the run: arrays, and values that JSON can represent.
        store: lengths of the tables, frames and log.
        beside: digests of the files written since the last checkpoint.
    """
    arrays, meta = _split(state)
    arrays |= {_META: np.array(json.dumps(meta)), _STORE: np.array(json.dumps(store))}
    sink = io.BytesIO()
    np.savez(sink, allow_pickle=False, **arrays)
    data = sink.getbuffer()
    either = [manifest.digest(path), manifest.digest_of(data)]
    manifest.update(path.parent, {**beside, path.name: list(dict.fromkeys(either))})
    with replacing(path) as file:
        file.write(data)


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the state and the file lengths that a checkpoint contains.

    Raises:
        FolderError: the checkpoint is damaged, or it is compressed (mdnum does not compress checkpoints).
    """
    try:
        with opened(path) as file:
            arrays = _arrays(file)
        meta, store = (json.loads(str(arrays.pop(name))) for name in (_META, _STORE))
        if not isinstance(meta, dict) or not isinstance(store, dict):
            raise ValueError("the checkpoint does not contain the number of rows of each table")
        return arrays | meta, store
    except FolderError:
        raise
    # a flipped bit of an archive shows in as many ways as there are fields in it
    except Exception as error:
        seen = " ".join(str(error).split())[:200] or type(error).__name__
        raise FolderError(
            f"the checkpoint cannot be read ({seen})", remedy="Run again in a new folder", where=str(path)
        ) from error


def _arrays(file: BinaryIO) -> dict[str, np.ndarray]:
    size = os.fstat(file.fileno()).st_size
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        # members that are not packed and share no bytes cannot hold more than the file
        if any(one.compress_type != zipfile.ZIP_STORED for one in members):
            raise ValueError("the checkpoint is compressed, but mdnum writes checkpoint files uncompressed")
        held = sum(one.file_size for one in members)
        if held > size:
            raise ValueError(f"the header states {held:,} bytes of data, but the file has only {size:,}")
        return {one.filename.removesuffix(".npy"): _array(archive, one) for one in members}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        version = npy.read_magic(stream)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = header(stream)
        claimed = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or claimed != member.file_size - stream.tell():
            raise ValueError(f"{member.filename} has the wrong size; expected {claimed:,} bytes")
    with archive.open(member) as stream:
        return npy.read_array(stream, allow_pickle=False)


def _split(state: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays: dict[str, np.ndarray] = {}
    meta: dict[str, Any] = {}
    for key, value in state.items():
        if hasattr(value, "__array__"):
            array = np.asarray(value)
            if array.dtype.kind not in "biufcU":
                raise TypeError(
                    f"the array {key!r} has dtype {array.dtype}, which an npz file cannot restore"
                )
            arrays[key] = array
        else:
            meta[key] = value
    return arrays, meta


# --- exact float64 frames in ASE's own trajectory file, cut back to a known frame when a run resumes --

if TYPE_CHECKING:
    from ase import Atoms

# ASE's ulm format: 8 bytes magic, 16 bytes tag, then int64 version, frames, position of the offset table
_FRAMES_AT = 32
_HEADER = struct.Struct("<qq")


class FrameFile:
    """Writer of `trajectory.traj`. The file is opened when the first frame is written."""

    def __init__(self, path: Path):
        self.path = path
        self._writer: Any = None

    def append(self, atoms: Atoms) -> None:
        """Append one frame (positions, momenta, cell and results of a single-point calculator).

        Raises:
            FolderError: the disk is full; the file still contains all frames before this one.
        """
        from ase.io.trajectory import TrajectoryWriter

        refuse_link(self.path, in_place=True)
        mark = self.mark()
        with disk_errors(self.path):
            try:
                if self._writer is None:
                    self._writer = TrajectoryWriter(self.path, "a" if mark[0] else "w")
                self._writer.write(atoms)
            except OSError:
                self._writer = None
                self.truncate(mark)
                raise

    def mark(self) -> tuple[int, int, int]:
        """Return the number of frames, the position of the offset table, and the file size."""
        if not self.path.exists() or self.path.stat().st_size < _FRAMES_AT + _HEADER.size:
            return (0, 0, 0)
        with opened(self.path) as file:
            file.seek(_FRAMES_AT)
            frames, table = _HEADER.unpack(file.read(_HEADER.size))
        return (frames, table, self.path.stat().st_size)

    def truncate(self, mark: tuple[int, int, int]) -> None:
        """Restore the file to the state of `mark`. All later frames are removed, even incomplete ones.

        `mark` includes the position of ASE's offset table, because ASE moves the table.
        """
        self.close()
        frames, table, size = mark
        if frames == 0:
            self.path.unlink(missing_ok=True)
            return
        if self.mark()[2] < size:
            raise FolderError(
                f"the trajectory is shorter than its checkpoint states ({frames} frames)",
                remedy="Run again in a new folder: the old folder was changed after the checkpoint",
                where=str(self.path),
            )
        with disk_errors(self.path), opened(self.path, "r+b") as file:
            file.seek(_FRAMES_AT)
            file.write(_HEADER.pack(frames, table))
            file.flush()
            os.ftruncate(file.fileno(), size)

    def close(self) -> None:
        """Close the trajectory file; the next frame opens the file again."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
