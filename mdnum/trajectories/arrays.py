"""Trajectories in memory: a program passes frames one by one.

ASE, vesin and torch-sim store lattice vectors as rows (`cell`). jax-md stores them as columns (`box`), and
often uses fractional positions.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.topology import AtomTable
from mdnum.trajectories.trajectory import SAMPLE, Trajectory

# shapes of a box of all frames
_SINGLE = ((), (1,), (3,), (6,), (3, 3))
# atoms from which on coordinates that all lie between 0 and 1 are fractions; fewer where a cutoff is longer
_MANY, _FEW = 64, 8
_BARE = "There is no box, and all coordinates lie between 0 and 1: fractions need box and fractional=True."
_UPPER = (
    "The cell is upper triangular, as boxes are in jax-md, and its rows were taken for the lattice vectors."
)


def host(values: Any, name: str, kinds: str = "fiu") -> np.ndarray:
    """Return numerical values as a numpy array, without a copy if possible.

    Raises:
        InputError: the numbers have an unexpected dtype, floats are narrower than 32 bits, or values have
            units.
    """
    if hasattr(values, "value_in_unit"):
        remedy = "Give numbers: .value_in_unit(openmm.unit.nanometer), with length='nm'"
        raise InputError(f"{name} has the unit {values.unit}", remedy=remedy, where=name)
    try:
        found = np.asarray(values.detach().cpu().numpy() if hasattr(values, "detach") else values)
    except TypeError as error:
        raise InputError(f"{name}: {error}", remedy="Give float32 or float64", where=name) from None
    if found.dtype.kind not in kinds or (found.dtype.kind == "f" and found.dtype.itemsize < 4):
        expected = "float32 or float64" if "f" in kinds else "integers"
        held = next((one for one in ("position", "positions") if hasattr(values, one)), None)
        remedy = f"Give state.{held}" if held else "Convert the array"
        raise InputError(f"{name} has dtype {found.dtype}; expected {expected}", remedy=remedy, where=name)
    return found


class ArrayFrames(Trajectory):
    """Trajectory of frames that a program passes one by one.

    Args:
        name: name of the frames on a results page.
        species, cell, box, pbc, fractional, timestep, length, time: as in `mdnum.Recorder`.
    """

    reader, in_memory, remembered = "mdnum", True, 10_000  # a loop may have any number of frames
    reach = 0.0  # of the rules, length, where it is known

    def __init__(
        self, name: str, *, species: Any = None, cell: Any = None, box: Any = None, pbc: Any = None,
        fractional: bool | None = None, timestep: float | None = None, length: str = "Å", time: str = "ps",
    ) -> None:  # fmt: skip
        super().__init__(Path(name), None, slice(None))
        self.length, self.time = length, "step" if timestep is None else time
        self.named, self._box, self._fractional = species, (cell, box, pbc), fractional
        self._timestep = timestep or 1.0
        self._waiting: deque[Frame] = deque()
        self._gone, self._first = 0, list[Frame]()

    def read(
        self, step: int, positions: Any, cell: Any = None, box: Any = None, pbc: Any = None,
        velocities: Any = None,
    ) -> Frame:  # fmt: skip
        """Return the next frame, built from the arguments of `mdnum.Recorder.see`.

        Raises:
            InputError: the shape or dtype of an array is invalid or differs from earlier frames, or both cell
                and box are given.
        """
        here, x = self._box_of(cell, box, pbc), host(positions, "positions")
        if x.ndim != 2 or x.shape[1] != 3:
            message = f"the positions have shape {x.shape}; expected (atoms, 3)"
            raise InputError(message, remedy="Pass one frame at a time, or use see_many", where="positions")
        bits, x = 32 if x.dtype == np.float32 else 64, np.array(x, np.float64)
        if not self._first:
            self._begin(x, here, bits)
        if bits != self.bits:
            message = f"positions were float{self.bits} at earlier steps, but are float{bits} at step {step}"
            raise InputError(message, remedy="Give all frames the same dtype", where="positions")
        v = None if self.time == "step" else velocities
        v = None if v is None else np.array(host(v, "velocities"), float)
        if v is not None and v.shape != x.shape:
            raise InputError(
                f"the velocities have shape {v.shape}, but the positions have shape {x.shape}",
                remedy="Give one velocity vector for each atom",
            )
        x = x @ here.matrix if self._fractional else x
        return Frame(int(step), int(step) * self._timestep, x, here, v)

    def put(self, frame: Frame) -> None:
        """Append the next frame to the trajectory."""
        self._waiting.append(frame)
        if len(self._first) < SAMPLE and len(frame.positions) == self.atoms:
            self._first.append(frame)

    def _box_of(self, cell: Any, box: Any, pbc: Any) -> Box:
        cell, box = self._box[:2] if cell is None and box is None else (cell, box)
        pbc = self._box[2] if pbc is None else pbc
        name = "cell" if box is None else "box"
        given = np.zeros(3) if cell is None and box is None else host(cell if box is None else box, name)
        if given.shape == (6,) and box is None:
            from ase.geometry import cellpar_to_cell

            given = np.asarray(cellpar_to_cell(given))
        if (cell is not None and box is not None) or given.shape not in ((), (1,), (3,), (3, 3)):
            message = f"{name} of shape {given.shape}" if cell is None or box is None else "both cell and box"
            remedy = "Give one or three lengths, or three vectors: the rows of cell, or the columns of box"
            raise InputError(message, remedy=remedy, where=name)
        matrix = np.eye(3) * given if given.ndim < 2 else np.array(given if box is None else given.T, float)
        if box is not None and np.triu(matrix, 1).any():
            message = f"box = {given.tolist()} is not upper triangular, as columns are in jax-md"
            raise InputError(message, remedy="Give the lattice vectors as the rows of cell", where="box")
        repeats = matrix.any(axis=1) if pbc is None else np.broadcast_to(np.asarray(pbc, bool), 3)
        return Box(matrix, np.array(repeats, bool))

    def _begin(self, x: np.ndarray, box: Box, bits: int) -> None:
        """Check the first frame, and store the properties that all frames share."""
        fractional, remedy = self._fractional, "Say fractional=True, or fractional=False for lengths"
        unit = len(x) >= (_FEW if self.reach > 1 else _MANY) and x.min() >= 0 and x.max() <= 1
        if fractional is None and unit and box.shortest > 2:
            message = f"all coordinates lie between 0 and 1, in a box of {box.shortest:g} and more"
            raise InputError(message, remedy=remedy, where="positions")
        if fractional and (not box.pbc.all() or (x.size and (x.min() < -1 or x.max() > 2))):
            message = f"fractions lie from {x.min():.3g} to {x.max():.3g}, box {box.matrix.tolist()}"
            remedy = "Give fractional=False for lengths; for fractions, wrap them (x % 1) and give a box"
            raise InputError(message, remedy=remedy, where="positions")
        words = ["X"] * len(x) if self.named is None else list(map(str, np.asarray(self.named).tolist()))
        if len(words) != len(x):
            raise InputError(
                f"{len(words)} species were given for {len(x)} atoms", remedy="Give one species for each atom"
            )
        self.table, self.bits = AtomTable.plain(words, self.named is not None), bits
        self.format = f"{'fractional coordinates' if fractional else 'positions'} in float{bits}"
        if self._box[1] is None and np.triu(box.matrix, 1).any() and not np.tril(box.matrix, -1).any():
            self.notes = (_UPPER,)
        if fractional is None and unit and not box.pbc.any():
            self.notes = (_BARE,)

    @classmethod
    def of(cls, frames: Any, reach: float, velocities: Any = None, **options: Any) -> ArrayFrames:
        """Make a trajectory from an array or ASE Atoms. `reach` is the longest cutoff."""
        given = {name: options.pop(name) for name in ("cell", "box") if name in options}
        found, given["velocities"] = cls("array", **options), velocities
        found.reach = reach
        for k, (x, here) in enumerate(one_by_one(frames, given)):
            if hasattr(x, "get_positions"):
                found.named = x.get_chemical_symbols() if found.named is None else found.named
                here = {"cell": x.cell.array, "pbc": x.pbc, **here}
            found.put(found.read(k, getattr(x, "positions", x), **here))
        if not found._first:
            raise InputError(
                "the array of positions contains no frame",
                remedy="Give an array of shape (frames, atoms, 3)",
                where="positions",
            )
        found.time = "frame" if found.time == "step" else found.time
        return found

    @property
    def now(self) -> Frame:
        """Frame that was examined last."""
        return self._waiting[0]

    def sample(self) -> list[Frame]:
        """Return the first frames of the trajectory, as far as available."""
        return list(self._first)

    @contextmanager
    def raw_frames(self) -> Iterator[Callable[[int], Any]]:
        """Yield a function that returns a frame by its number."""

        def get(number: int) -> Frame | None:
            while self._waiting and self._gone < number:
                self._waiting.popleft()
                self._gone += 1
            return self._waiting[0] if self._waiting else None

        yield get

    def decoded(self, number: int, raw: Any) -> Frame:
        """Return the frame unchanged, since frames in memory need no decoding."""
        return raw


def one_by_one(frames: Any, given: dict[str, Any]) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Yield each frame with its keyword arguments, taken from the arguments of `mdnum.Recorder.see_many`."""
    frames = frames if isinstance(frames, list | tuple) else host(frames, "positions")
    given = {name: one for name, one in given.items() if one is not None}
    rows = {name for name, one in given.items() if isinstance(one, list) or name in ("energy", "velocities")}
    rows |= {name for name in given if name in ("cell", "box") and np.shape(given[name]) not in _SINGLE}
    if wrong := [name for name in sorted(rows) if len(given[name]) != len(frames)]:
        message = f"{wrong[0]} has {len(given[wrong[0]])} entries for {len(frames)} frames"
        raise InputError(message, remedy="Give one entry for each frame", where=wrong[0])
    for k, frame in enumerate(frames):
        yield frame, {name: one[k] if name in rows else one for name, one in given.items()}
