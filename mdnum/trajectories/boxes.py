"""Boxes of MDAnalysis's trajectories as the files have them.

MDAnalysis keeps three lengths and three angles, from which a box has its first vector along x and its second
in the xy plane. Most programs turn their boxes like that; where one does not, its coordinates are turned
otherwise too, and images would be put into wrong places without a word:

- CHARMM's are symmetric matrices (since version 22, in dcd files);
- HOOMD's have tilt factors, which MDAnalysis takes for the cosines of angles (in gsd files);
- those of H5MD and of DL_POLY's HISTORY are vectors in any direction.

Of PDB files with many models it loses boxes unless there are as many as models. Programs write CRYST1 once at
the head (OpenMM), before each model (GROMACS), or inside of each. MDAnalysis reads a model from its MODEL
record on: what stands before the first is never read, and what stands behind a model is taken for that
one's, though it is the next one's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from mdnum.trajectories.frame import Box

Matrix = Float[np.ndarray, "3 3"]
Dimensions = tuple[float, ...] | None

_PDB = frozenset({"PDB", "ENT", "XPDB"})
_ONCE = "The file gives a box once, before its first model: it is taken for all frames."
# a box of this is a word for none: CRYST1 is demanded by the format
_PLACEHOLDER = (1.0, 1.0, 1.0, 90.0, 90.0, 90.0)
_COLUMNS = ((6, 15), (15, 24), (24, 33), (33, 40), (40, 47), (47, 54))


def formats_of(trajectory: Any) -> list[str]:
    """MDAnalysis's words for the format of one of its readers."""
    return [trajectory.format] if isinstance(trajectory.format, str) else list(trajectory.format)


class Boxes:
    """The boxes of an MDAnalysis trajectory, turned as its coordinates are.

    Args:
        trajectory: MDAnalysis's reader.

    Attributes:
        notes: what somebody who relies on the boxes should know, in sentences.
        own: whether boxes are read from the file itself, and may be others than MDAnalysis's.
    """

    def __init__(self, trajectory: Any):
        self._matrix: Callable[[int, Any], Matrix | None] | None = None
        self._models: tuple[Dimensions, ...] = ()
        self.notes: tuple[str, ...] = ()
        path = getattr(trajectory, "filename", None)
        if isinstance(path, str | Path):
            words = formats_of(trajectory)
            makers = {"DCD": _charmm, "GSD": _hoomd, "H5MD": _h5md, "HISTORY": _dlpoly}
            make = next((makers[word] for word in words if word in makers), None)
            self._matrix = make(str(path), trajectory) if make else None
            if _PDB & set(words) and trajectory.n_frames > 1 and Path(path).is_file():
                stat = Path(path).stat()
                self._models, records = _models(str(path), stat.st_size, stat.st_mtime_ns)
                self.notes = (_ONCE,) if self._models and records == 1 else ()
        self._changed = bool(getattr(trajectory, "transformations", ()))
        self.own = self._matrix is not None or bool(self._models)

    def box(self, ts: Any, number: int) -> Box:
        """The box of a timestep that is this frame of the file."""
        dimensions = ts.dimensions
        # transformations may have set another
        if self._models and (dimensions is None or not self._changed):
            found = self._models[number] if number < len(self._models) else None
            dimensions = None if found is None else np.array(found, np.float64)
        box = box_of(dimensions)
        if self._matrix is None or not box.periodic:
            return box
        matrix = self._matrix(number, ts)
        return box if matrix is None else Box(matrix, box.pbc)


def box_of(dimensions: Float[np.ndarray, "6"] | None) -> Box:
    """The box with these lengths and angles: a along x, b in the xy plane, as MDAnalysis has it.

    Args:
        dimensions: lengths in Å and angles in degrees; None where the frame has no box. An axis of length 0
            with right angles does not repeat.

    Error: MDAnalysis keeps lengths and angles in float32: lattice vectors are off by 1e-7 of themselves.
    """
    from MDAnalysis.lib.mdamath import triclinic_vectors

    if dimensions is None or not np.any(dimensions):
        return Box()
    lengths, angles = np.asarray(dimensions[:3], np.float64), np.asarray(dimensions[3:], np.float64)
    if (lengths == 0).any() and (angles == 90).all():
        return Box(np.diag(lengths), lengths > 0)
    with np.errstate(invalid="ignore"):
        matrix = np.asarray(triclinic_vectors(dimensions, dtype=np.float64), np.float64)
    if not matrix.any():
        # lengths and angles that no box has: left for whoever needs the box to refuse
        matrix = np.full((3, 3), np.nan)
    return Box(matrix, np.ones(3, bool))


def _charmm(path: str, trajectory: Any) -> Callable[[int, Any], Matrix | None]:
    from MDAnalysis.lib.formats.libdcd import DCDFile

    file = DCDFile(path)

    def matrix(number: int, ts: Any) -> Matrix | None:
        if (np.asarray(ts.dimensions[3:]) == 90).all():
            return None
        file.seek(number)
        xx, xy, yy, xz, yz, zz = np.array(file.read().unitcell, np.float64)
        symmetric = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        # in these places stand cosines otherwise, or angles, which give other lengths
        lengths = np.sqrt((symmetric**2).sum(axis=1))
        cosines = max(abs(xy), abs(xz), abs(yz)) <= 1
        known = not cosines and np.allclose(lengths, ts.dimensions[:3], rtol=1e-5)
        return symmetric if known else None

    return matrix


def _hoomd(path: str, trajectory: Any) -> Callable[[int, Any], Matrix | None]:
    import gsd.fl  # pyright: ignore[reportMissingImports] -- MDAnalysis needs it for the format

    file = gsd.fl.open(path, "r")
    chunk = "configuration/box"

    def matrix(number: int, ts: Any) -> Matrix | None:
        # what does not change is written with the first frame alone
        at = number if file.chunk_exists(number, chunk) else 0
        if not file.chunk_exists(at, chunk):
            return None
        x, y, z, xy, xz, yz = np.asarray(file.read_chunk(at, chunk), np.float64)
        return np.array([[x, 0, 0], [xy * y, y, 0], [xz * z, yz * z, z]])

    return matrix


def _h5md(path: str, trajectory: Any) -> Callable[[int, Any], Matrix | None]:
    import h5py  # pyright: ignore[reportMissingImports] -- MDAnalysis needs it for the format

    file = h5py.File(path, "r")

    def matrix(number: int, ts: Any) -> Matrix | None:
        group: Any = file["particles"]
        box = next(iter(group.values()))["box"]
        if "edges" not in box or "value" not in box["edges"]:
            return None
        edges = np.asarray(box["edges/value"][number], np.float64)
        if edges.shape != (3, 3):
            return None
        # MDAnalysis has converted its lengths to Å
        scale = ts.dimensions[0] / np.linalg.norm(edges[0])
        return edges * float(scale)

    return matrix


def _dlpoly(path: str, trajectory: Any) -> Callable[[int, Any], Matrix | None]:
    # where each frame begins is known once they have been counted
    offsets = getattr(trajectory, "_offsets", None) if trajectory.n_frames else None
    file = open(path)  # noqa: SIM115 -- as long as frames are read

    def matrix(number: int, ts: Any) -> Matrix | None:
        if offsets is None:
            # another release of MDAnalysis keeps them elsewhere
            return None
        file.seek(offsets[number])
        file.readline()
        rows = [file.readline().split() for _ in range(3)]
        return np.array(rows, np.float64)

    return matrix


@lru_cache(maxsize=4)
def _models(path: str, size: int, changed: int) -> tuple[tuple[Dimensions, ...], int]:
    """(lengths and angles of each model's box, records); read again if the file has changed."""
    from MDAnalysis.lib.util import anyopen

    found: list[Dimensions] = []
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
    return tuple(found) if any(found) else (), records


def _dimensions(line: bytes) -> Dimensions:
    try:
        found = tuple(float(line[begin:end]) for begin, end in _COLUMNS)
    except ValueError:
        return None
    return None if np.allclose(found, _PLACEHOLDER) or not any(found[:3]) else found
