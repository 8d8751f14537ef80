"""Boxes of PDB files of many models, which MDAnalysis loses unless there are as many as models.

Programs write CRYST1 once at the head (OpenMM), before each model (GROMACS), or inside of each. MDAnalysis
reads a model from its MODEL record on: what stands before the first is never read, and what stands behind a
model is taken for that one's, though it is the next one's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float

# a box of this is a word for none: CRYST1 is demanded by the format
_PLACEHOLDER = (1.0, 1.0, 1.0, 90.0, 90.0, 90.0)
_COLUMNS = ((6, 15), (15, 24), (24, 33), (33, 40), (40, 47), (47, 54))


@dataclass(frozen=True)
class ModelBoxes:
    """Lengths and angles of each model's box, None where it has none.

    Attributes:
        once: whether one record at the head is all there is.
    """

    dimensions: tuple[tuple[float, ...] | None, ...]
    once: bool

    def of(self, number: int) -> Float[np.ndarray, "6"] | None:
        """Lengths in Å and angles in degrees of a model, from 0."""
        found = self.dimensions[number] if number < len(self.dimensions) else None
        return None if found is None else np.array(found, np.float64)


def model_boxes(trajectory: Any) -> ModelBoxes | None:
    """The boxes of the file behind MDAnalysis's reader; None where it has not several models, or no box."""
    path = Path(trajectory.filename)
    if trajectory.n_frames < 2 or not path.is_file():
        return None
    told = path.stat()
    return _read(str(path), told.st_size, told.st_mtime_ns)


@lru_cache(maxsize=4)
def _read(path: str, size: int, changed: int) -> ModelBoxes | None:
    """As `model_boxes`; a file is read anew only where it has changed."""
    from MDAnalysis.lib.util import anyopen

    found: list[tuple[float, ...] | None] = []
    now, records, open_model = None, 0, False
    with anyopen(path, "rb") as file:
        for line in cast("Iterable[bytes]", file):
            if line.startswith((b"ATOM", b"HETATM")):
                if open_model:
                    found.append(now)
                    open_model = False
            elif line.startswith(b"MODEL"):
                open_model = True
            elif line.startswith(b"CRYST1"):
                now, records = _dimensions(line), records + 1
    if not any(found):
        return None
    return ModelBoxes(tuple(found), once=records == 1)


def _dimensions(line: bytes) -> tuple[float, ...] | None:
    try:
        found = tuple(float(line[begin:end]) for begin, end in _COLUMNS)
    except ValueError:
        return None
    return None if np.allclose(found, _PLACEHOLDER) or not any(found[:3]) else found
