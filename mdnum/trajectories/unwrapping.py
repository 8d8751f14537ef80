"""Unwrapping of atomic paths across box boundaries, and detection of discontinuities between frames.

In each frame, wrapping must move atoms by lattice vectors of this frame. If wrapping moves atoms differently,
the unwrapped path is wrong (von Bülow, Bullerjahn and Hummer, J. Chem. Phys. 153, 021101, 2020). Lattice
vectors of the same frame remove a jump and preserve displacements (Bullerjahn, von Bülow, Heidari, Hénin and
Hummer, J. Chem. Theory Comput. 19, 3406, 2023).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mdnum.trajectories.frame import AtomIndices, Frame

# pairs of successive atoms that are followed
_PAIRS = 2_000
# frames in which pairs that keep their distance are found, and by how much they may vary, relative
_STIFF, _VARY = 8, 0.05
# how many times as much as usual is not usual; split pairs and atoms below which nothing is said
_OFF, _FEW = 5.0, 10
# relative changes below which distances are the same, whatever is usual
_LEAST = 2e-3
# motion in a frame, as a share of the box, beyond which jumps and motion are not distinguishable
_TOO_FAR = 0.15
# how many times the motion, and the jumps, of the frames around it make a frame a seam; these frames
_SEAM, _AROUND = 5.0, 3
_GROUPS = 8


@dataclass
class Unwrapping:
    """Unwrapped paths of up to `_PAIRS` pairs of adjacent atoms in fully periodic boxes."""

    atoms: AtomIndices
    _first: np.ndarray | None = None
    _last: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros(0))
    _path: np.ndarray = field(default_factory=lambda: np.zeros(0))  # positions with jumps undone
    _lengths: list[np.ndarray] = field(default_factory=list)  # distances in pairs at the first frames

    def see(self, frame: Frame) -> dict[str, Any] | None:
        """Return a frame's row in the table of atomic motion. None unless the box is fully periodic."""
        x, cell = frame.positions if self.atoms is None else frame.positions[self.atoms], frame.box.matrix
        if not frame.box.pbc.all() or len(x) < 2:
            return None
        at = np.unique(np.linspace(0, len(x) - 2, min(_PAIRS, len(x) - 1)).astype(int))
        x = x[np.concatenate([at, at + 1])]
        fractions = x @ np.linalg.inv(cell)
        if self._first is None:
            self._first, self._path, self._last = x, x, (x, fractions)
        whole = np.rint(fractions - self._last[1])
        way = x - self._last[0] - whole @ cell
        self._path, self._last = self._path + way, (x, fractions)
        moved = [one - one.mean(axis=0) for one in (x - self._first, self._path - self._first, way)]
        raw, path, step = ((one**2).sum(axis=1) for one in moved)
        groups = np.arange(len(path)) * _GROUPS // len(path)
        means = np.bincount(groups, path) / np.bincount(groups)
        # along the axis along which it is most, as a share of the box
        share = np.sqrt(((moved[2] @ np.linalg.inv(cell)) ** 2).mean(axis=0).max())
        return {
            "jumps": int(whole.any(axis=1).sum()), "step": float(np.sqrt(step.mean())), "share": float(share),
            "raw": float(raw.mean()), "undone": float(path.mean()),
            "error": float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else 0.0,
            **self._pairs(fractions[: len(at)], fractions[len(at) :], cell),
        }  # fmt: skip

    def _pairs(self, here: np.ndarray, there: np.ndarray, cell: np.ndarray) -> dict[str, Any]:
        """Return relative changes of nearly constant pair distances, across a boundary and elsewhere."""
        images = np.rint(there - here)
        split = images.any(axis=1) | (np.floor(here) != np.floor(there)).any(axis=1)
        lengths = np.linalg.norm((there - here - images) @ cell, axis=1)
        if len(self._lengths) < _STIFF:
            self._lengths.append(lengths)
            return {"split": 0, "split_off": 0.0, "others_off": 0.0}
        usual = np.mean(self._lengths, axis=0)
        stiff = (np.ptp(self._lengths, axis=0) < _VARY * usual) & (usual > 0)
        off, split = np.abs(lengths[stiff] / usual[stiff] - 1), split[stiff]
        # medians: by chance some pairs kept their distance only at first
        two = [float(np.median(off[kind])) if kind.any() else 0.0 for kind in (split, ~split)]
        return {"split": int(split.sum()), "split_off": two[0], "others_off": two[1]}


def told(rows: Mapping[str, np.ndarray], atoms: int, timed: bool) -> dict[str, Any] | None:
    """Summarize the table of atomic motion as plain values. None for fewer than three frames."""
    if len(rows["frame"]) < 3:
        return None
    # before the first frame nothing moved
    step, jumps, number = (rows[name][1:] for name in ("step", "jumps", "number"))
    far, weight = float(np.median(rows["share"][1:])) > _TOO_FAR, rows["split"]
    split = int(weight.sum())
    off, usual = (float(rows[name] @ weight) / max(split, 1) for name in ("split_off", "others_off"))
    atoms = 2 * min(_PAIRS, atoms - 1)
    found: dict[str, Any] = {
        "jumps": int(jumps.sum()), "atoms": atoms, "too_far": far, "split": split, "off": off,
        "usual": usual, "not_whole": bool(split >= _FEW and off > max(_OFF * usual, _LEAST)),
        "seams": [] if far else _seams(number, step, jumps, atoms), "diffusion": None,
    }  # fmt: skip
    half, last = len(rows["time"]) // 2, float(rows["undone"][-1])
    if timed and not far and half >= _FEW and last > 0:
        columns = np.column_stack([rows["raw"], rows["undone"]])
        raw, undone = (np.polyfit(rows["time"][half:], columns[half:], 1)[0] / 6).tolist()
        # relative to the mean square displacement at the end, by groups of atoms
        error = abs(undone) * float(rows["error"][-1]) / last
        found["diffusion"] = {"raw": raw, "undone": undone, "error": error}
    return found


def _seams(number: np.ndarray, step: np.ndarray, jumps: np.ndarray, atoms: int) -> list[dict[str, Any]]:
    """Return frames with a sudden motion of all atoms, or with unusually many jumps."""
    found = []
    for k in range(len(step)):
        around = np.r_[max(k - _AROUND, 0) : k, k + 1 : min(k + _AROUND, len(step) - 1) + 1]
        # at an end of the file there are not enough on both sides
        if not _AROUND <= k < len(step) - _AROUND:
            continue
        far, wrapped = step[k] > _SEAM * step[around].max(), jumps[k] > _SEAM * max(jumps[around].max(), 1)
        if far or (wrapped and jumps[k] > max(_FEW, 0.02 * atoms)):
            times = float(step[k] / max(step[around].mean(), np.finfo(float).tiny))
            found.append(
                {
                    "number": int(number[k]),
                    "moved": bool(far),
                    "times": times,
                    "jumps": float(jumps[k] / atoms),
                }
            )
    return found
