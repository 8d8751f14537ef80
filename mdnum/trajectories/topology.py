"""Atoms and boxes from MDAnalysis and ASE.

MDAnalysis stores three lengths and three angles of a box. MDAnalysis assumes that the first vector is along x
and the second in the xy plane. For boxes in other orientations, the periodic images from MDAnalysis are
silently wrong:

- CHARMM (since version 22) writes symmetric box matrices to dcd files, without an orientation.
- MDAnalysis takes the tilt factors of HOOMD's boxes for cosines of angles (gsd files).
- Boxes in H5MD and DL_POLY HISTORY files may have vectors in any direction.

MDAnalysis also ignores or misassigns CRYST1 records outside the models of a PDB file. Programs write CRYST1
in the header (OpenMM), before each model (GROMACS), or inside each model. MDAnalysis reads a model from its
MODEL record to the next MODEL record. MDAnalysis therefore never reads a box before the first model. A box
between two models is assigned to the first of the two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.reading import check_claim, reading
from mdnum.trajectories.frame import Box

#: Note on results that are read from coordinates by MDAnalysis.
NARROWED = "MDAnalysis hands every coordinate over in float32, whatever the file stores."

_UNNAMED = "The file says how many atoms there are and nothing else; names and elements need a topology."
# MDAnalysis's name for the one segment of a file that names none
_NO_SEGMENT = "SYSTEM"
# names of columns in files that ASE reads, its own first
_ARRAYS = {
    "names": "atomtypes atom_names atom_name names name", "resnames": "residuenames resnames resname",
    "resids": "residuenumbers resids resid", "segids": "segids segid chainids chainid chain",
}  # fmt: skip
_GUESSED = "Elements are guessed from the names of the atoms."
_ONCE = "The file gives a box once, before its first model: it is taken for all frames."
_PDB = frozenset({"PDB", "ENT", "XPDB"})
# a box of this is a word for none: CRYST1 is demanded by the format
_PLACEHOLDER = (1.0, 1.0, 1.0, 90.0, 90.0, 90.0)
_COLUMNS = ((6, 15), (15, 24), (24, 33), (33, 40), (40, 47), (47, 54))

Dimensions = tuple[float, ...] | None
# the matrix of a frame's box, of its number and MDAnalysis's timestep; None for MDAnalysis's own
Matrices = Callable[[int, Any], Float[np.ndarray, "3 3"] | None]


@dataclass(frozen=True)
class AtomTable:
    """Properties of every atom according to a topology, one entry per atom."""

    names: np.ndarray  # as in the file ("OW"); the species where it has no names
    species: np.ndarray  # chemical element where it is known or can be guessed, else the file's atom type
    residue_names: np.ndarray  # "" where there are none
    residue_ids: Int[np.ndarray, "atoms"]  # number as the file has it; 0 where there are none
    residues: Int[np.ndarray, "atoms"]  # index from 0, different for two residues of one number
    segments: np.ndarray  # names of segments, else of chains; "" where there are none
    named: bool = True  # False where the file says nothing of its atoms but their number
    guessed: bool = False  # whether the species were guessed from names

    def __len__(self) -> int:
        return len(self.names)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user on missing or guessed atom names."""
        return (_UNNAMED,) if not self.named else (_GUESSED,) if self.guessed else ()

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Names and numbers of atoms, residues and segments by column. Empty columns are omitted."""
        numbered = any(self.residue_names) or self.residues.any()
        every = {
            "atom_name": self.names if self.named else (), "residue_name": self.residue_names,
            "residue_number": self.residue_ids if numbered else (), "segment": self.segments,
        }  # fmt: skip
        return {name: np.asarray(values) for name, values in every.items() if any(values)}

    @classmethod
    def plain(
        cls, species: list[str], named: bool = True, arrays: Mapping[str, np.ndarray] = MappingProxyType({})
    ) -> AtomTable:
        """Build a table of atoms from their species.

        Args:
            named: True if the file contains the species.
            arrays: further columns of a file, by their names in ASE or other programs; only names of atoms,
                residues and segments, and residue numbers, are used.
        """
        words, none = np.array(species, dtype=object), np.zeros(len(species), np.int64)

        def column(part: str, otherwise: np.ndarray, kinds: str = "UOSiu") -> np.ndarray:
            found = (np.asarray(arrays[name]) for name in _ARRAYS[part].split() if name in arrays)
            values = next((one for one in found if one.ndim == 1 and one.dtype.kind in kinds), otherwise)
            return values.astype(np.int64) if kinds == "iu" else np.array(list(map(str, values)), object)

        blank = np.full(len(species), "", dtype=object)
        names, residues, segments = (column(kind, blank) for kind in ("names", "resnames", "segids"))
        numbers = column("resids", none, "iu")
        # a residue ends where the next atom is of another name, number or segment, as MDAnalysis has it
        parts = [values[1:] != values[:-1] for values in (residues, numbers, segments)]
        index = np.cumsum([0, *np.any(parts, axis=0)])[: len(words)]
        return cls(names if any(names) else words, words, residues, numbers, index, segments, named)

    @classmethod
    def of(cls, atoms: Any) -> AtomTable:
        """Build an atom table from an MDAnalysis AtomGroup."""

        def column(name: str, otherwise: Any) -> np.ndarray:
            values = getattr(atoms, name, None)
            return np.array([otherwise] * len(atoms) if values is None else list(map(str, values)), object)

        known = [hasattr(atoms, name) for name in ("names", "types", "elements")]
        elements, types = column("elements", ""), column("types", "X")
        names, guessed = column("names", ""), False
        if known[0] and not all(elements):
            from MDAnalysis.guesser.default_guesser import DefaultGuesser
            from MDAnalysis.guesser.tables import SYMB2Z

            # "OW1" -> "O", "CL" -> "Cl", "CA" -> "C"
            guess = DefaultGuesser(None).guess_atom_element
            found = {one: str(guess(one)).capitalize() for one in set(names)}
            found = {one: element if element in SYMB2Z else "" for one, element in found.items()}
            rows = zip(elements, names, types if known[1] else names, strict=True)
            elements = np.array([e or found[n] or t for e, n, t in rows], object)
            guessed = any(found.values())
        elif not all(elements):
            elements = types
        segments, blank = column("segids", ""), np.full(len(atoms), "", object)
        return cls(
            names=names if known[0] else elements, species=elements, residue_names=column("resnames", ""),
            residue_ids=np.array(getattr(atoms, "resids", np.zeros(len(atoms))), np.int64),
            residues=np.array(atoms.resindices, np.int64), named=any(known), guessed=guessed,
            segments=blank if set(segments) == {_NO_SEGMENT} else segments,
        )  # fmt: skip

    def universe(self) -> Any:
        """Return an MDAnalysis Universe of the atoms in this table, without coordinates."""
        from MDAnalysis import Universe

        at = np.unique(self.residues, return_index=True)[1]
        segments, of = np.unique(self.segments[at].astype(str), return_inverse=True)
        universe = Universe.empty(
            len(self), n_residues=len(at), atom_resindex=self.residues, n_segments=len(segments),
            residue_segindex=of,
        )  # fmt: skip
        for name, values in (
            ("names", self.names), ("types", self.species), ("elements", self.species),
            ("resnames", self.residue_names[at]), ("resids", self.residue_ids[at]), ("segids", segments),
        ):  # fmt: skip
            universe.add_TopologyAttr(name, values)
        return universe

    def give_elements(self, universe: Any) -> None:
        """Add guessed elements to an MDAnalysis Universe, for selections by element."""
        if self.guessed and not hasattr(universe.atoms, "elements"):
            universe.add_TopologyAttr("elements", self.species)


@dataclass(frozen=True)
class Topology:
    """A file that identifies the atoms, in a format of MDAnalysis or ASE."""

    path: Path
    otherwise: Callable[[Path], AtomTable]  # the atoms of a file that MDAnalysis does not read

    def read(self) -> tuple[AtomTable, Any]:
        """Return the atom table of the file, and a Universe without coordinates.

        Raises:
            InputError: no reader supports the file.
        """
        try:
            universe = topology_universe(self.path)
            return AtomTable.of(universe.atoms), universe
        except InputError as refused:
            try:
                table = self.otherwise(self.path)
            except InputError:
                # MDAnalysis knows most of the formats, and says more of them
                raise refused from None
            return table, table.universe()


def topology_universe(topology: str | Path) -> Any:
    """Return a Universe of a topology file, without coordinates. No index file is written.

    Raises:
        InputError: MDAnalysis cannot read the file.
    """
    from MDAnalysis import Universe
    from MDAnalysis.core._get_readers import get_parser_for

    check_claim(topology, atoms_in(topology) or 0)
    with reading(topology), get_parser_for(str(topology))(str(topology)) as parser:
        return Universe(parser.parse())


def atoms_in(path: str | Path, topology: int | None = None, format: str | None = None) -> int | None:
    """Return the number of atoms in a trajectory. None if the number is not known."""
    from MDAnalysis.core._get_readers import get_reader_for

    for known in ({}, {"n_atoms": topology}):
        try:
            reader: Any = get_reader_for(str(path), format=format)
            return int(reader.parse_n_atoms(str(path), **known))
        except Exception:
            # a format without that question, or a file that opening will say more about
            continue
    return None


# ---- boxes


def formats_of(trajectory: Any) -> list[str]:
    """Return the list of format names of an MDAnalysis reader."""
    return [trajectory.format] if isinstance(trajectory.format, str) else list(trajectory.format)


def file_of(trajectory: Any) -> Path | None:
    """Return the path of the file of an MDAnalysis reader. None if there is no single file."""
    path = getattr(trajectory, "filename", None)
    return Path(path) if isinstance(path, str | Path) else None


class Boxes:
    """Boxes of an MDAnalysis reader, in the orientation of the file.

    Attributes:
        notes: sentences for the user on the interpretation of the boxes.
        own: whether boxes are read directly from the file, and may differ from MDAnalysis's boxes.
    """

    def __init__(self, trajectory: Any):
        self._matrix: Matrices | None = None
        self._models: tuple[Dimensions, ...] = ()
        self.notes: tuple[str, ...] = ()
        if (path := file_of(trajectory)) is not None:
            words = formats_of(trajectory)
            if make := next((_MATRICES[word] for word in words if word in _MATRICES), None):
                self._matrix = make(str(path), trajectory)
                self.notes = getattr(self._matrix, "notes", ())
            if _PDB & set(words) and trajectory.n_frames > 1 and path.is_file():
                stat = path.stat()
                self._models, records = _models(str(path), stat.st_size, stat.st_mtime_ns)
                self.notes = (_ONCE,) if self._models and records == 1 else ()
        self._changed = bool(getattr(trajectory, "transformations", ()))
        self.own = self._matrix is not None or bool(self._models)

    def other(self, ts: Any, number: int) -> tuple[str, Box] | None:
        """Return another possible box of a frame (an MDAnalysis Timestep); see `Trajectory.other_box`."""
        instead = getattr(self._matrix, "instead", None)
        if instead is not None and (matrix := instead(number)) is not None:
            return "BOX_UNDECIDED", Box(matrix, np.ones(3, bool))
        ours, theirs = self.box(ts, number), box_of(ts.dimensions)
        apart = float(np.abs(ours.matrix - theirs.matrix)[ours.pbc].max(initial=0.0))
        # float32, and angles from cosines
        differs = self.own and apart > 1e-4 * float(np.abs(ours.matrix).max())
        return ("BOX_NOT_MDANALYSIS", theirs) if differs else None

    def box(self, ts: Any, number: int) -> Box:
        """Return the box of a frame, from its MDAnalysis Timestep and its number."""
        dimensions = ts.dimensions
        # transformations may have set another
        if self._models and (dimensions is None or not self._changed):
            found = self._models[number] if number < len(self._models) else None
            dimensions = None if found is None else np.array(found, np.float64)
        box = box_of(dimensions)
        matrix = self._matrix(number, ts) if self._matrix is not None and box.periodic else None
        return box if matrix is None else Box(matrix, box.pbc)


def box_of(dimensions: Float[np.ndarray, "6"] | None) -> Box:
    """Return the box of given lengths (Å) and angles (degrees). a is along x, b in the xy plane.

    `None` means no box. An axis of length 0 is not periodic if all angles are 90°.

    Error: the relative error of lattice vectors is 1e-7, since MDAnalysis stores float32.
    """
    from MDAnalysis.lib.mdamath import triclinic_vectors

    if dimensions is None or not np.any(dimensions):
        return Box()
    lengths, angles = np.asarray(dimensions[:3], np.float64), np.asarray(dimensions[3:], np.float64)
    if (lengths == 0).any() and (angles == 90).all():
        return Box(np.diag(lengths), lengths > 0)
    with np.errstate(invalid="ignore"):
        matrix = np.asarray(triclinic_vectors(dimensions, dtype=np.float64), np.float64)
    # lengths and angles that no box has are left for whoever needs the box to refuse
    return Box(matrix if matrix.any() else np.full((3, 3), np.nan), np.ones(3, bool))


def _dcd(path: str, trajectory: Any) -> Matrices:
    # it looks for pairs of atoms, which needs what is above this module
    from mdnum.trajectories.dcd_boxes import DcdBoxes

    return DcdBoxes(path, trajectory)


def _hoomd(path: str, trajectory: Any) -> Matrices:
    import gsd.fl  # pyright: ignore[reportMissingImports] -- MDAnalysis needs it for the format

    file, chunk = gsd.fl.open(path, "r"), "configuration/box"

    def matrix(number: int, ts: Any) -> Float[np.ndarray, "3 3"] | None:
        # what does not change is written with the first frame alone
        at = number if file.chunk_exists(number, chunk) else 0
        if not file.chunk_exists(at, chunk):
            return None
        x, y, z, xy, xz, yz = np.asarray(file.read_chunk(at, chunk), np.float64)
        return np.array([[x, 0, 0], [xy * y, y, 0], [xz * z, yz * z, z]])

    return matrix


def _h5md(path: str, trajectory: Any) -> Matrices:
    import h5py  # pyright: ignore[reportMissingImports] -- MDAnalysis needs it for the format

    file = h5py.File(path, "r")

    def matrix(number: int, ts: Any) -> Float[np.ndarray, "3 3"] | None:
        group: Any = file["particles"]
        box = next(iter(group.values()))["box"]
        if "edges" not in box or "value" not in box["edges"]:
            return None
        edges = np.asarray(box["edges/value"][number], np.float64)
        # MDAnalysis has converted its lengths to Å
        return None if edges.shape != (3, 3) else edges * float(ts.dimensions[0] / np.linalg.norm(edges[0]))

    return matrix


def _dlpoly(path: str, trajectory: Any) -> Matrices:
    # where each frame begins is known once they have been counted; another release keeps it elsewhere
    offsets = getattr(trajectory, "_offsets", None) if trajectory.n_frames else None
    file = open(path)  # noqa: SIM115 -- as long as frames are read

    def matrix(number: int, ts: Any) -> Float[np.ndarray, "3 3"] | None:
        if offsets is None:
            return None
        file.seek(offsets[number])
        file.readline()
        return np.array([file.readline().split() for _ in range(3)], np.float64)

    return matrix


_MATRICES = {"DCD": _dcd, "GSD": _hoomd, "H5MD": _h5md, "HISTORY": _dlpoly}


@lru_cache(maxsize=4)
def _models(path: str, size: int, changed: int) -> tuple[tuple[Dimensions, ...], int]:
    """Return lengths and angles of each model's box, and the number of CRYST1 records. Cached."""
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
