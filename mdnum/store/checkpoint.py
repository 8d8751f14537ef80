"""The state a killed run resumes from: arrays and plain values in one npz, bit for bit."""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from mdnum.errors import FolderError
from mdnum.store import manifest
from mdnum.store.atomic import opened, replacing

# members of the archive that are not arrays of the state
_META, _STORE = "mdnum meta", "mdnum store"


def write(
    path: Path, state: Mapping[str, Any], store: Mapping[str, Any], beside: Mapping[str, list[str]]
) -> None:
    """Replaces the checkpoint at path, and lists it in the manifest together with what it counts.

    Args:
        state: what the rollout wants back; arrays, and anything JSON has.
        store: how far the tables, frames and log had come.
        beside: digests of the files that came since the last checkpoint.
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
    """(state, store) as given to `write`.

    Raises:
        FolderError: it is damaged, or would unpack to more than its own size: a checkpoint is not packed.
    """
    try:
        with opened(path) as file:
            arrays = _arrays(file)
        meta, store = (json.loads(str(arrays.pop(name))) for name in (_META, _STORE))
        if not isinstance(meta, dict) or not isinstance(store, dict):
            raise ValueError("what it counts is no table")
        return arrays | meta, store
    except FolderError:
        raise
    # a flipped bit of an archive is told in as many ways as there are fields in it
    except Exception as error:
        seen = " ".join(str(error).split())[:200] or type(error).__name__
        raise FolderError(
            f"not a readable checkpoint ({seen})", remedy="Run again in a new folder", where=str(path)
        ) from error


def _arrays(file: BinaryIO) -> dict[str, np.ndarray]:
    size = os.fstat(file.fileno()).st_size
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        # members that are not packed and share no bytes cannot hold more than the file
        if any(one.compress_type != zipfile.ZIP_STORED for one in members):
            raise ValueError("it is packed, which no checkpoint of mdnum is")
        held = sum(one.file_size for one in members)
        if held > size:
            raise ValueError(f"it claims to hold {held:,} bytes in a file of {size:,}")
        return {one.filename.removesuffix(".npy"): _array(archive, one) for one in members}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        version = npy.read_magic(stream)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = header(stream)
        claimed = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or claimed != member.file_size - stream.tell():
            raise ValueError(f"{member.filename} claims {claimed:,} bytes that are not there")
    with archive.open(member) as stream:
        return npy.read_array(stream, allow_pickle=False)


def _split(state: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays: dict[str, np.ndarray] = {}
    meta: dict[str, Any] = {}
    for key, value in state.items():
        if hasattr(value, "__array__"):
            array = np.asarray(value)
            if array.dtype.kind not in "biufcU":
                raise TypeError(f"checkpoint: {key!r} has dtype {array.dtype}, which npz would not give back")
            arrays[key] = array
        else:
            meta[key] = value
    return arrays, meta
