"""Trajectories of any code: which reader a file gets, and atoms selected by words."""

from __future__ import annotations

import json
import warnings
import zlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from mdnum.errors import InputError
from mdnum.trajectories.topology import AtomTable, first_line, topology_universe
from mdnum.trajectories.trajectory import Trajectory, parse_slice, split_path

# MDAnalysis reads XYZ too, but neither boxes nor more than float32 of it; the others it does not know
_ASE_SUFFIXES = frozenset({".traj", ".extxyz", ".json", ".db", ".bundle", ".castep", ".xsf", ".con"})
_OWN = {
    "lammpsdump": "lammps",
    "lammpstrj": "lammps",
    "lammps-dump-text": "lammps",
    "gro": "gro",
    "xtc": "xtc",
}
# Amber's, of which MDAnalysis reads those that are whole
_NETCDF = frozenset({"nc", "ncdf", "netcdf"})
_LANGUAGE = (
    'Write it as MDAnalysis does: "name OW", "protein", "element O", "index 0:99", "resname SOL and name OW"'
)
_SHOWN = 8


def open_trajectory(
    path: str | Path, topology: str | Path | None = None, slice: str = "", format: str | None = None
) -> Trajectory:
    """Opens a file that MDAnalysis or ASE reads, or the folder of an mdnum run.

    Args:
        path: the file; may end in @START:STOP:STEP.
        topology: a file that says what the atoms are, where the trajectory does not (xtc, trr, dcd, ...):
            anything that MDAnalysis takes for one.
        slice: frames to read, as behind the @.
        format: the format in MDAnalysis's or ASE's word, where the name of the file does not tell it.

    Raises:
        InputError: no such file, nobody reads it, or it does not belong to the topology.
    """
    file, words = split_path(str(path))
    if words and slice:
        raise InputError(f"frames are named twice, by @{words} and by {slice!r}", remedy="Name them once")
    frames = parse_slice(slice or words, where=str(path))
    if file.is_dir() and (file / "trajectory.traj").exists():
        from mdnum.store import RunFolder

        RunFolder.open(file).check("trajectory.traj")
        file = file / "trajectory.traj"
    if file.is_dir() and (file / "summary.json").exists():
        raise _no_trajectory(file)
    if file.is_dir() and file.suffix != ".bundle":
        raise InputError("it is a folder", remedy="Give the trajectory itself", where=str(file))
    for one in (file, None if topology is None else Path(topology).expanduser()):
        if one is not None and not one.exists():
            raise InputError("no such file", remedy="Check the path", where=str(one))
        if one is not None and one.is_file() and not one.stat().st_size:
            raise InputError("the file is empty", remedy="Check how it was written", where=str(one))
    from mdnum.trajectories import binary, mdanalysis_source, text

    readers = {
        "lammps": text.LammpsDump, "gro": text.GroTrajectory, "extxyz": text.ExtxyzTrajectory,
        "xtc": binary.XtcTrajectory, "netcdf": binary.NetcdfTrajectory,
    }  # fmt: skip
    kind = _reader_of(file, format)
    word = format or (text.format_of(file) if kind == "ase" else "")
    if reader := readers.get("extxyz" if kind == "ase" and word == "extxyz" else kind):
        opened = reader(file, topology, frames)
    elif kind == "ase":
        opened = text.AseTrajectory(file, topology, frames, word)
    else:
        opened = mdanalysis_source.MDAnalysisTrajectory(file, topology, frames, format)
    if not opened.atoms:
        raise InputError("its frames have no atoms", remedy="Check how the file was written", where=str(file))
    return opened


def _no_trajectory(folder: Path) -> InputError:
    """Why a folder that mdnum wrote holds no trajectory."""
    try:
        world = json.loads((folder / "summary.json").read_text()).get("world", "md")
    except (ValueError, AttributeError, OSError):
        world = "md"
    message = "this run folder has no trajectory"
    remedy = "Run again with --save-every 1 (or another number of steps)"
    if world != "md":
        message = "this folder holds results, and no trajectory"
        remedy = f"Give the trajectory itself; `mdnum report {folder}` shows what the folder holds"
    return InputError(message, remedy=remedy, where=str(folder))


def _reader_of(file: Path, format: str | None) -> str:
    """Which reader a file gets: "ase", "mdanalysis", or one of mdnum's: "lammps", "gro", "xtc", "netcdf"."""
    import MDAnalysis

    from mdnum.trajectories.binary import head_of

    known: set[str] = set(MDAnalysis._READERS)
    suffix = (file.with_suffix("") if file.suffix in (".gz", ".bz2") else file).suffix.lower()
    if format is not None and format.lower() in _OWN:
        return _OWN[format.lower()]
    if (format or suffix[1:]).lower() in _NETCDF and (head := head_of(file)) is not None and head.cut:
        return "netcdf"
    if format is not None:
        return "mdanalysis" if format.upper() in known else "ase"
    if suffix in _ASE_SUFFIXES or (suffix == ".cif" and find_spec("gemmi") is None):
        return "ase"
    if suffix in (".gro", ".xtc"):
        return suffix[1:]
    head, comment = _first_lines(file)
    if suffix[1:].upper() not in known and head.startswith("item:"):
        return "lammps"
    # the comment line of an extended XYZ file says what its columns are, or its box
    extended = suffix == ".xyz" and ("lattice=" in comment or "properties=" in comment)
    return "mdanalysis" if suffix[1:].upper() in known and not extended else "ase"


def _first_lines(file: Path) -> tuple[str, str]:
    """The first two lines in small letters; empty for a file that is no text."""
    from ase.io.formats import open_with_compression

    try:
        with open_with_compression(str(file), "r") as lines:
            return lines.readline(1000).lower(), lines.readline(10_000).lower()
    except (OSError, EOFError, zlib.error, UnicodeDecodeError):
        return "", ""


# ---- atoms by words, in MDAnalysis's selection language, whoever reads the file


def select(trajectory: Trajectory, words: str) -> Int[np.ndarray, "chosen"]:
    """Indices of the atoms that words name at the first frame asked for, ascending.

    A selection that depends on where atoms are ("around 5 protein") is made once, there.

    Raises:
        InputError: the words are no selection, name no atom, or need what the file does not tell.
    """
    from MDAnalysis.exceptions import NoDataError, SelectionError

    table, where = trajectory.table, str(trajectory.path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe = _universe(trajectory)
        try:
            found = universe.select_atoms(words)
        except (NoDataError, AttributeError) as error:
            message = f"the selection {words!r} asks for what the file does not tell ({first_line(error)})"
            remedy = "Give a topology that has it with -s TOPOLOGY, or select by index"
            raise InputError(message, remedy=remedy, where=where) from error
        except (SelectionError, ValueError, TypeError) as error:
            message = f"{words!r} is no selection ({first_line(error)})"
            raise InputError(message, remedy=_LANGUAGE, where=where) from error
    if len(found) == 0:
        raise InputError(
            f"the selection {words!r} names no atom of {trajectory.atoms:,}; {_there_are(table)}",
            remedy=_LANGUAGE if table.named else "Give a topology with -s TOPOLOGY",
            where=where,
        )
    return np.asarray(found.indices, np.int64)


def _universe(trajectory: Trajectory) -> Any:
    """A Universe that stands at the first frame asked for. Distances in a selection are float32."""
    import MDAnalysis
    from MDAnalysis.lib.mdamath import triclinic_box

    first, table, universe = next(iter(trajectory.frames()), None), trajectory.table, None
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
            table.give_elements(universe)
        except InputError:
            # a topology of ASE's says no more than the table
            universe = None
    if universe is None:
        at = np.unique(table.residues, return_index=True)[1]
        universe = MDAnalysis.Universe.empty(len(table), n_residues=len(at), atom_resindex=table.residues)
        for name, values in (
            ("names", table.names), ("types", table.species), ("elements", table.species),
            ("resnames", table.residue_names[at]), ("resids", table.residue_ids[at]),
        ):  # fmt: skip
            universe.add_TopologyAttr(name, values)
    box = triclinic_box(*first.box.matrix) if first.box.pbc.all() else np.zeros(6, np.float32)
    universe.load_new(first.positions[None].astype(np.float32), order="fac", dimensions=np.asarray(box)[None])
    return universe


def _there_are(table: AtomTable) -> str:
    """What could have been named."""
    if not table.named:
        return "the file has no names of atoms"
    words = []
    for kind, values in (("names", table.names), ("residues", table.residue_names)):
        known, counts = np.unique(values.astype(str), return_counts=True)
        ordered = [str(one) for one in known[np.argsort(-counts, kind="stable")] if one]
        if ordered:
            words.append(f"{kind} {', '.join(ordered[:_SHOWN])}{', ...' if len(ordered) > _SHOWN else ''}")
    return "there are " + "; ".join(words)
