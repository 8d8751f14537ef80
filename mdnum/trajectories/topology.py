"""What a topology says of the atoms: names, elements, residues, through MDAnalysis or ASE."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from mdnum.errors import InputError

#: what readers raise on files that end early or hold something else
READING_FAILS = (OSError, EOFError, ValueError, RuntimeError, StopIteration, IndexError, KeyError, TypeError)
#: what a reader of results from MDAnalysis's coordinates should know
NARROWED = "MDAnalysis hands every coordinate over in float32, whatever the file stores."


@dataclass(frozen=True)
class AtomTable:
    """What a topology says of every atom, one entry an atom.

    Attributes:
        names: as in the file ("OW"); the species where it has no names.
        species: chemical element where it is known or can be guessed, else the file's atom type.
        residue_names: "" where there are none.
        residue_ids: number of the residue as the file has it; 0 where there are none.
        residues: index of the atom's residue from 0, different for two residues of one number.
        named: False where the file says nothing of its atoms but their number.
        guessed: whether the species were guessed from names.
    """

    names: np.ndarray
    species: np.ndarray
    residue_names: np.ndarray
    residue_ids: Int[np.ndarray, "atoms"]
    residues: Int[np.ndarray, "atoms"]
    named: bool = True
    guessed: bool = False

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def plain(cls, species: list[str], named: bool = True) -> AtomTable:
        """Atoms that have a species and belong to no residue."""
        words, none = np.array(species, dtype=object), np.zeros(len(species), np.int64)
        return cls(words, words, np.full(len(species), "", dtype=object), none, none, named)


def first_line(error: BaseException) -> str:
    """The message of an error in a line."""
    cause: BaseException | None = error
    while cause is not None and not str(cause).strip():
        cause = cause.__context__
    text = str(error if cause is None else cause).strip().splitlines()
    if text and cause is not error and not text[0].startswith("could not convert"):
        # how a reader stumbles over an end is its own business, unless a word is no number
        text = []
    if not text and isinstance(error, StopIteration | EOFError):
        return "the file ends in it"
    return text[0].rstrip(".") if text else type(error).__name__


def notes_on(table: AtomTable) -> tuple[str, ...]:
    """What a reader of results should know of how the atoms are named."""
    if not table.named:
        return (
            "The file says how many atoms there are and nothing else; names and elements need a topology.",
        )
    return ("Elements are guessed from the names of the atoms.",) if table.guessed else ()


def topology_universe(topology: str | Path) -> Any:
    """A Universe of a topology, with or without coordinates.

    Raises:
        InputError: MDAnalysis does not read it.
    """
    import MDAnalysis

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return opened_by_mdanalysis(Path(topology), lambda: MDAnalysis.Universe(str(topology)), None)


def opened_by_mdanalysis(file: Path, act: Any, trajectory: Path | None) -> Any:
    """What opening a file gives; all that goes wrong in it is an InputError."""
    hook = sys.unraisablehook
    # readers that could not open complain once more when they are thrown away
    sys.unraisablehook = lambda _: None
    try:
        try:
            return act()
        except READING_FAILS as error:
            said, package = first_line(error), "install" in str(error)
        except ImportError as error:
            said, package = first_line(error), True
    finally:
        sys.unraisablehook = hook
    if package:
        raise InputError(
            f"reading it needs a package that is not installed ({said})",
            remedy="Install the package, or convert the file to xtc or extxyz",
            where=str(file),
        )
    hint = "Check that the file is whole and of the kind its name says"
    if file == trajectory:
        hint += "; a trajectory without names of atoms needs its topology (-s TOPOLOGY)"
    raise InputError(f"MDAnalysis cannot open it ({said})", remedy=hint, where=str(file))


def table_of(atoms: Any) -> AtomTable:
    """What a topology says of its atoms.

    Args:
        atoms: an MDAnalysis AtomGroup.
    """

    def column(name: str, otherwise: Any) -> np.ndarray:
        values = getattr(atoms, name, None)
        return np.array([otherwise] * len(atoms) if values is None else [str(one) for one in values], object)

    known = [hasattr(atoms, name) for name in ("names", "types", "elements")]
    elements, types = column("elements", ""), column("types", "X")
    names, guessed = column("names", ""), False
    if known[0] and not all(elements):
        from MDAnalysis.guesser.default_guesser import DefaultGuesser
        from MDAnalysis.guesser.tables import SYMB2Z

        # "OW1" -> "O", "CL" -> "Cl", "CA" -> "C"
        guess = {one: str(DefaultGuesser(None).guess_atom_element(one)).capitalize() for one in set(names)}
        found = {one: element if element in SYMB2Z else "" for one, element in guess.items()}
        rest = types if known[1] else names
        elements = np.array(
            [e or found[n] or t for e, n, t in zip(elements, names, rest, strict=True)], object
        )
        guessed = any(found.values())
    elif not all(elements):
        elements = types
    return AtomTable(
        names=names if known[0] else elements,
        species=elements,
        residue_names=column("resnames", ""),
        residue_ids=np.array(getattr(atoms, "resids", np.zeros(len(atoms))), np.int64),
        residues=np.array(atoms.resindices, np.int64),
        named=any(known),
        guessed=guessed,
    )


def with_elements(universe: Any, table: AtomTable) -> None:
    """Adds the elements that were guessed, for selections by element."""
    if table.guessed and not hasattr(universe.atoms, "elements"):
        universe.add_TopologyAttr("elements", table.species)


def table_of_topology(topology: str | Path) -> AtomTable:
    """The atoms of a topology file: any that MDAnalysis takes for one, or any structure that ASE reads.

    Raises:
        InputError: neither reads it.
    """
    try:
        return table_of(topology_universe(topology).atoms)
    except InputError:
        from ase import Atoms
        from ase.io import read

        try:
            atoms = read(str(topology))
        except Exception as error:
            raise InputError("neither MDAnalysis nor ASE reads this topology", where=str(topology)) from error
        assert isinstance(atoms, Atoms)
        return AtomTable.plain(atoms.get_chemical_symbols())
