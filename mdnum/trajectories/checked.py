"""Frames that hold what no simulation writes: coordinates that are no numbers or places, or never written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Bool, Int

from mdnum.errors import InputError
from mdnum.trajectories.far import far_out
from mdnum.trajectories.frame import Frame


class FrameError(InputError):
    """A frame was read and holds what cannot be right.

    Args:
        frame: its number in the file, from 0.
    """

    def __init__(self, message: str, *, frame: int, remedy: str, where: str | None = None):
        super().__init__(message, remedy=remedy, where=where)
        self.frame = frame


def checked(
    frames: Iterable[Frame],
    atoms: Int[np.ndarray, "chosen"] | None = None,
    where: str | None = None,
    *,
    radius: float = np.inf,
    bits: int = 64,
) -> Iterator[Frame]:
    """The frames, each looked at before it is given on.

    Args:
        frames: of a trajectory.
        atoms: the atoms that matter, ascending; None for all.
        where: the file, for messages.
        radius: the shortest length that distances are compared with.
        bits: width of a coordinate as it was read.

    Raises:
        FrameError: a coordinate is not finite, an atom is further out than any gets or than floats tell
            distances of that length, more than one atom is at exactly 0, 0, 0, the box repeats along other
            axes than in the first frame (most often: there is none), or along one without a vector, or an
            atom is said to be another one than in the first frame.
    """
    pbc = labels = None
    for frame in frames:
        pbc = frame.box.pbc if pbc is None else pbc
        labels = frame.labels if labels is None else labels
        check_frame(frame, atoms, pbc, where, labels, radius=radius, bits=bits)
        yield frame


def check_frame(
    frame: Frame,
    atoms: Int[np.ndarray, "chosen"] | None = None,
    pbc: Bool[np.ndarray, "3"] | None = None,
    where: str | None = None,
    labels: np.ndarray | None = None,
    *,
    radius: float = np.inf,
    bits: int = 64,
) -> None:
    """As `checked`, for one frame.

    Args:
        pbc: axes along which the first frame repeats; None for any.
        labels: of the first frame; None for any.
    """
    if labels is not None and frame.labels is not None:
        others = np.flatnonzero(labels != frame.labels)
        others = others if atoms is None else np.intersect1d(others, atoms)
        if others.size:
            atom = int(others[0])
            raise FrameError(
                f"frame {frame.index}: atom {atom} is {frame.labels[atom]}, and {labels[atom]} in the "
                f"first one looked at{_and_others(others.size)}",
                frame=frame.index,
                remedy="Write all frames in one order of atoms, or leave out those that differ with "
                "@START:STOP: pairs are followed by the place of their atoms in the file",
                where=where,
            )
    if pbc is not None and (frame.box.pbc != pbc).any():
        raise FrameError(
            f"frame {frame.index} {_repeats(frame.box.pbc)}, and the first one looked at {_repeats(pbc)}",
            frame=frame.index,
            remedy="Leave out the frames that differ with @START:STOP: distances in the two do not compare",
            where=where,
        )
    x = frame.positions if atoms is None else frame.positions[atoms]
    for axis in np.flatnonzero(frame.box.pbc):
        if not (vector := frame.box.matrix[axis]).any() or not np.isfinite(vector).all():
            raise FrameError(
                f"frame {frame.index}: the box repeats along {'abc'[axis]}, but its vector there is "
                f"{vector.tolist()}",
                frame=frame.index,
                remedy="Give the frames a box, or say that this direction does not repeat",
                where=where,
            )
    # a sum is finite unless a term is not, or the terms are of no use anyway
    with np.errstate(over="ignore", invalid="ignore"):
        total = x.sum()
    if not np.isfinite(total) and (bad := np.flatnonzero(~np.isfinite(x).all(axis=1))).size:
        first = int(bad[0] if atoms is None else atoms[bad[0]])
        raise FrameError(
            f"frame {frame.index}: atom {first} is at {_place(frame, first)}{_and_others(bad.size)}",
            frame=frame.index,
            remedy=_failed(frame),
            where=where,
        )
    if (found := far_out(frame, atoms, radius, bits)) is not None:
        atom, many, why = found
        raise FrameError(
            f"frame {frame.index}: atom {atom} is at {_place(frame, atom)}, {why}{_and_others(many)}",
            frame=frame.index,
            remedy=f"{_failed(frame)}; an atom that did fly off is left out with --between",
            where=where,
        )
    # one atom may well be at the origin; two cannot be at one place
    zero = np.flatnonzero(~x.any(axis=1))
    if zero.size > 1:
        first = int(zero[0] if atoms is None else atoms[zero[0]])
        what = (
            "all coordinates are 0"
            if zero.size == len(x)
            else f"atom {first} is at exactly 0, 0, 0{_and_others(zero.size)}"
        )
        raise FrameError(
            f"frame {frame.index}: {what}, as where coordinates were never written",
            frame=frame.index,
            remedy="Leave the frame out with @START:STOP, or the atoms with --between",
            where=where,
        )


def _place(frame: Frame, atom: int) -> str:
    return f"({', '.join(f'{value:g}' for value in frame.positions[atom])})"


def _failed(frame: Frame) -> str:
    if not frame.index:
        return "The simulation or the writing of it failed from the first frame on"
    return f"The simulation or the writing of it failed there; stop before that frame (@:{frame.index})"


def _repeats(pbc: np.ndarray) -> str:
    if not pbc.any():
        return "has no box"
    if pbc.all():
        return "has a box"
    return (
        f"has a box that repeats along {', '.join(name for name, yes in zip('abc', pbc, strict=True) if yes)}"
    )


def _and_others(count: int) -> str:
    return "" if count == 1 else f", and {count - 1:,} other{'s' if count > 2 else ''} likewise"
