"""Interpretation of the six box numbers in a DCD file.

DCD files do not record the convention of the box. The six numbers may be lengths and cosines of the angles
(NAMD, VMD, LAMMPS, MDAnalysis since 2.10). Other programs write lengths and angles in degrees (CHARMM before
version 22, OpenMM, MDAnalysis before 2.10). CHARMM since version 22 writes a symmetric matrix of lattice
vectors. With a wrong box, atoms overlap across the boundary. If several conventions fit the positions, the
version number in the header decides. All programs except CHARMM write version 24.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.reading import reading
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.rules import CutoffRule
from mdnum.trajectories.tracker import Tracker

# how much worse than another a convention has to look, and overlaps or wrapped atoms that are too few to tell
_WORSE, _FEW = 3.0, 4
_MATRIX = "a symmetric matrix"
_SIZES, _OTHERS, _ROWS = [0, 2, 5], [1, 3, 4], [[0, 1, 3], [1, 2, 4], [3, 4, 5]]

Examined = list[tuple[int, np.ndarray, np.ndarray]]


def conventions(cell: Float[np.ndarray, "6"]) -> dict[str, Float[np.ndarray, "3 3"]]:
    """Return the lattice vectors by each valid convention. The first convention is that of MDAnalysis."""
    from MDAnalysis.lib.mdamath import triclinic_vectors

    angles, found = cell[[4, 3, 1]], {}
    if (np.abs(angles) <= 1).all():
        found["lengths and cosines of angles"] = np.degrees(np.arccos(angles))
    elif (angles > 1).all():
        found["lengths and angles in degrees"] = angles
    for name, degrees in found.items():
        found[name] = triclinic_vectors(np.concatenate([cell[_SIZES], degrees]), dtype=np.float64)
    found[_MATRIX] = cell[_ROWS] * (np.linalg.eigvalsh(cell[_ROWS])[0] > 0)
    return {name: matrix for name, matrix in found.items() if matrix.any()}


class DcdBoxes:
    """Lattice vectors of a DCD file. The box convention is the one that fits the positions.

    Attributes:
        convention: name of the chosen convention; None if no examined box depends on the choice.
        other: name of a second convention that fits equally well; None if the convention is certain.
        notes: the reason for the choice, as a sentence.
    """

    def __init__(self, path: str, trajectory: Any):
        from MDAnalysis.lib.formats.libdcd import DCDFile

        self._file, self.other, self.notes = DCDFile(path), None, ()
        frames = list(self._sample(path))
        boxes = [conventions(cell) for _, _, cell in frames]
        fit = [name for name in (boxes[0] if boxes else ()) if all(name in one for one in boxes)]
        self.convention = fit[0] if fit else None
        if len(fit) < 2 or np.allclose(boxes[0][fit[0]], boxes[0][fit[1]], rtol=1e-5, atol=1e-4):
            return
        left, why = _plausible(frames, fit), "with which its atoms neither overlap nor leap at the boundary"
        with Path(path).open("rb") as file:
            head = file.read(88)
        (version,) = struct.unpack("<i" if head[0] == 84 else ">i", head[84:])
        if len(left) > 1 and version != 24:
            left, why = fit[version >= 22 :][:1], f"as in CHARMM, whose version {version} is in the head"
        self.convention, self.other = [*left, None][:2]
        if self.other is None:
            self.notes = (f"The box in the file is read as {self.convention}, {why}.",)

    def _sample(self, path: str) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield (frame number, positions, six box numbers) of sampled frames without a rectangular box."""
        count = len(self._file)
        for number in sorted({*range(min(count, 8)), *np.linspace(0, count - 1, 4).astype(int).tolist()}):
            try:
                with reading(path, number):
                    self._file.seek(number)
                    x, cell = (np.array(one, np.float64) for one in self._file.read())
            except InputError:
                # it is reported when its turn comes
                return
            if not np.isin(cell[_OTHERS], (0, 90)).all() and np.isfinite(cell).all() and cell[_SIZES].all():
                yield number, x, cell

    def __call__(self, number: int, ts: Any) -> Float[np.ndarray, "3 3"] | None:
        """Return a frame's lattice vectors. None if MDAnalysis's vectors are correct or set by the user."""
        vectors = self._vectors(number, self.convention) if self.convention == _MATRIX else None
        if vectors is None:
            return None
        lengths = np.diag(vectors), np.linalg.norm(vectors, axis=1)
        return vectors if any(np.allclose(one, ts.dimensions[:3], rtol=1e-5) for one in lengths) else None

    def instead(self, number: int) -> Float[np.ndarray, "3 3"] | None:
        """Return the lattice vectors by the second convention that fits, or None."""
        return self._vectors(number, self.other)

    def _vectors(self, number: int, convention: str | None) -> Float[np.ndarray, "3 3"] | None:
        self._file.seek(number)
        return conventions(np.array(self._file.read().unitcell, np.float64)).get(convention or "")


def _plausible(frames: Examined, fit: list[str]) -> list[str]:
    """Return the conventions that fit the box numbers and the positions."""
    gone: dict[str, list[float]] = {name: [] for name in fit}
    for (before, start, _), (number, end, cell) in pairwise(frames):
        moved = end - start - np.median(end - start, axis=0)
        moved = moved[np.abs(moved).max(axis=1) > 0.4 * cell[_SIZES].min()]
        for name in fit if number == before + 1 else ():
            vectors = conventions(cell)[name]
            rest = moved - np.rint(moved @ np.linalg.inv(vectors)) @ vectors
            gone[name] += np.linalg.norm(rest, axis=1).tolist()
    if len(gone[fit[0]]) >= _FEW:
        median = {name: float(np.median(far)) for name, far in gone.items()}
        fit = [name for name in fit if median[name] <= _WORSE * min(median.values())]
    try:
        contacts = {name: np.concatenate([_contacts(*frames[at], name) for at in (0, -1)]) for name in fit}
    except InputError:
        # a frame that cannot be used is reported when its turn comes
        return fit
    # closer than atoms ever are with another box
    limit = 0.85 * max(float(found.min(initial=np.inf)) for found in contacts.values())
    return [name for name, found in contacts.items() if np.count_nonzero(found < limit) <= _FEW]


def _contacts(number: int, x: np.ndarray, cell: np.ndarray, name: str) -> Float[np.ndarray, "pairs"]:
    """Return the distances of all pairs closer than the mean spacing of the atoms."""
    boxes = conventions(cell)
    volume = max(abs(float(np.linalg.det(one))) for one in boxes.values())
    tracker = Tracker(CutoffRule(float(np.cbrt(volume / len(x)))))
    tracker.step(Frame(number, 0.0, x, Box(boxes[name], np.ones(3, bool))))
    return tracker.members().distance
