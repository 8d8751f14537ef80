"""Atoms by words, in MDAnalysis's selection language, whoever reads the file."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from jaxtyping import Int

from mdnum.errors import InputError
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.mdanalysis_source import topology_universe, with_elements
from mdnum.trajectories.source import AtomTable, Trajectory

_LANGUAGE = (
    'Write it as MDAnalysis does: "name OW", "protein", "element O", "index 0:99", "resname SOL and name OW"'
)
_SHOWN = 8


def select(trajectory: Trajectory, words: str) -> Int[np.ndarray, "chosen"]:
    """Indices of the atoms that words name at the first frame looked at, ascending.

    A selection that depends on where atoms are ("around 5 protein") is made once, there.

    Raises:
        InputError: the words are no selection, name no atom, or need what the file does not tell.
    """
    from MDAnalysis.exceptions import NoDataError, SelectionError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe = _universe(trajectory)
        try:
            chosen = universe.select_atoms(words)
        except (NoDataError, AttributeError) as error:
            raise InputError(
                f"the selection {words!r} asks for what the file does not tell ({_said(error)})",
                remedy="Give a topology that has it with -s TOPOLOGY, or select by index",
                where=str(trajectory.path),
            ) from error
        except (SelectionError, ValueError, TypeError) as error:
            raise InputError(
                f"{words!r} is no selection ({_said(error)})", remedy=_LANGUAGE, where=str(trajectory.path)
            ) from error
    if len(chosen) == 0:
        raise InputError(
            f"the selection {words!r} names no atom of {trajectory.atoms:,}; {_there_are(trajectory.table)}",
            remedy=_LANGUAGE if trajectory.table.named else "Give a topology with -s TOPOLOGY",
            where=str(trajectory.path),
        )
    return np.asarray(chosen.indices, np.int64)


def _universe(trajectory: Trajectory) -> Any:
    """A Universe that stands at the first frame asked for."""
    first = next(iter(trajectory.frames()), None)
    if first is None:
        raise InputError(
            "no frame is left of what was asked for", remedy="Ask for others", where=str(trajectory.path)
        )
    if trajectory.universe is not None:
        # `frames` has left the Universe there
        return trajectory.universe
    if trajectory.topology is not None:
        try:
            universe = topology_universe(trajectory.topology)
        except InputError:
            # a topology of ASE's: it says no more than the table
            return universe_of(trajectory.table, first)
        with_elements(universe, trajectory.table)
        return _standing(universe, first)
    return universe_of(trajectory.table, first)


def _standing(universe: Any, frame: Frame) -> Any:
    """The Universe at this frame. Distances in a selection are float32."""
    from MDAnalysis.lib.mdamath import triclinic_box

    box = triclinic_box(*frame.box.matrix) if frame.box.pbc.all() else np.zeros(6, np.float32)
    universe.load_new(frame.positions[None].astype(np.float32), order="fac", dimensions=np.asarray(box)[None])
    return universe


def universe_of(table: AtomTable, frame: Frame) -> Any:
    """An MDAnalysis Universe with one frame, for its selection language.

    Args:
        table: of the atoms.
        frame: where they are.
    """
    import MDAnalysis

    first = np.unique(table.residues, return_index=True)[1]
    universe: Any = MDAnalysis.Universe.empty(len(table), n_residues=len(first), atom_resindex=table.residues)
    for name, values in (("names", table.names), ("types", table.species), ("elements", table.species)):
        universe.add_TopologyAttr(name, values)
    universe.add_TopologyAttr("resnames", table.residue_names[first])
    universe.add_TopologyAttr("resids", table.residue_ids[first])
    return _standing(universe, frame)


def _there_are(table: AtomTable) -> str:
    """What could have been named."""
    if not table.named:
        return "the file has no names of atoms"
    words = []
    for kind, values in (("names", table.names), ("residues", table.residue_names)):
        known, counts = np.unique(values.astype(str), return_counts=True)
        ordered = [str(one) for one in known[np.argsort(-counts, kind="stable")] if one]
        if ordered:
            more = ", ..." if len(ordered) > _SHOWN else ""
            words.append(f"{kind} {', '.join(ordered[:_SHOWN])}{more}")
    return "there are " + "; ".join(words)


def _said(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
