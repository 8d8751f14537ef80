"""The state a killed run resumes from: arrays and plain values in one npz, bit for bit."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import FolderError
from mdnum.store.atomic import write_bytes

# members of the archive that are not arrays of the state
_META, _STORE = "mdnum meta", "mdnum store"


def write(path: Path, state: Mapping[str, Any], store: Mapping[str, Any]) -> None:
    """Replaces the checkpoint at path.

    Args:
        state: what the rollout wants back; arrays, and anything JSON has.
        store: how far the tables, frames and log had come.
    """
    arrays, meta = _split(state)
    arrays |= {_META: np.array(json.dumps(meta)), _STORE: np.array(json.dumps(store))}
    sink = io.BytesIO()
    np.savez(sink, allow_pickle=False, **arrays)
    write_bytes(path, sink.getbuffer())


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """(state, store) as given to `write`."""
    try:
        with np.load(path, allow_pickle=False) as file:
            state: dict[str, Any] = {key: file[key] for key in file.files if key not in (_META, _STORE)}
            return state | json.loads(str(file[_META])), json.loads(str(file[_STORE]))
    except (OSError, ValueError, KeyError) as error:
        raise FolderError(
            f"not a readable checkpoint ({error})", remedy="Run again in a new folder", where=str(path)
        ) from error


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
