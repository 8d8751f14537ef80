"""Selection of atoms in a trajectory, in the syntax of MDAnalysis."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from jaxtyping import Int

from mdnum.errors import InputError
from mdnum.reading import first_line
from mdnum.trajectories.topology import AtomTable
from mdnum.trajectories.trajectory import Trajectory

_LANGUAGE = (
    'Use the MDAnalysis syntax: "name OW", "protein", "element O", "index 0:99", "resname SOL and name OW"'
)
_SHOWN = 8


def select(trajectory: Trajectory, words: str) -> Int[np.ndarray, "chosen"]:
    """Return the indices of the atoms that match a selection, in ascending order.

    A selection by positions ("around 5 protein") is evaluated once, at the first frame.

    Raises:
        InputError: the text is not a selection, matches no atom, or needs data that are not in the file.
    """
    from MDAnalysis.exceptions import NoDataError, SelectionError

    table, where = trajectory.table, str(trajectory.path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe = _universe(trajectory)
        try:
            found = universe.select_atoms(words)
        except (NoDataError, AttributeError) as error:
            message = f"the selection {words!r} needs information that the file lacks ({first_line(error)})"
            remedy = "Give a topology with this information (-s TOPOLOGY), or select by index"
            raise InputError(message, remedy=remedy, where=where) from error
        except (SelectionError, ValueError, TypeError) as error:
            message = f"{words!r} is not a valid selection ({first_line(error)})"
            raise InputError(message, remedy=_LANGUAGE, where=where) from error
    if len(found) == 0:
        raise InputError(
            f"the selection {words!r} matches none of {trajectory.atoms:,} atoms; {_there_are(table)}",
            remedy=_LANGUAGE if table.named else "Give a topology with -s TOPOLOGY",
            where=where,
        )
    return np.asarray(found.indices, np.int64)


def _universe(trajectory: Trajectory) -> Any:
    """Return an MDAnalysis Universe at the first requested frame. Distances in the Universe are float32."""
    from MDAnalysis.lib.mdamath import triclinic_box

    first = next(iter(trajectory.frames()), None)
    if first is None:
        raise InputError(
            "the chosen range of frames is empty", remedy="Choose other frames", where=str(trajectory.path)
        )
    if trajectory.universe is not None:
        # `frames` has left the Universe there
        return trajectory.universe
    if trajectory.topology is not None:
        table, universe = trajectory.topology.read()
        table.give_elements(universe)
    else:
        universe = trajectory.table.universe()
    box = triclinic_box(*first.box.matrix) if first.box.pbc.all() else np.zeros(6, np.float32)
    universe.load_new(first.positions[None].astype(np.float32), order="fac", dimensions=np.asarray(box)[None])
    return universe


def _there_are(table: AtomTable) -> str:
    """List the names of atoms, residues or segments in a file, for an error message."""
    if not table.named:
        return "the file has no names of atoms"
    words = []
    for kind, values in (("names", table.names), ("residues", table.residue_names)):
        known, counts = np.unique(values.astype(str), return_counts=True)
        ordered = [str(one) for one in known[np.argsort(-counts, kind="stable")] if one]
        if ordered:
            words.append(f"{kind} {', '.join(ordered[:_SHOWN])}{', ...' if len(ordered) > _SHOWN else ''}")
    return "there are " + "; ".join(words)
