"""Structures for an audit: a structure from a file, or two particles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any, Literal

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import CalculatorError, Skipped
from mdnum.audit.curve import Curve
from mdnum.audit.subject import CalculatorSubject
from mdnum.errors import InputError, expect_path
from mdnum.reading import CHECK_STRUCTURE, ase_images, reading

_SURROUNDINGS = ((False, False), (True, False), (True, True))  # (a cell, periodic), simplest first
FARTHEST = 30.0  # a scan does not go further apart than this, in the unit of length
_NEAREST = 0.3  # distances are walked from the first


def read_structure(words: str | Path) -> Atoms:
    """Read a structure with ASE. `file@5` is the sixth structure of a file, and `file` the last structure.

    The text after @ is an index or a database selection (`file.db@id=3`). The text must select exactly one
    structure.

    Raises:
        InputError: the file is missing, ASE cannot read it, it has no atoms, or a number is not finite.
    """
    expect_path(words, "Give ASE's Atoms or the path of a file that ASE reads")
    text = str(words)
    head, separator, index = text.rpartition("@")
    path, which = (Path(head), index) if separator and not Path(text).exists() else (Path(text), "-1")
    if not path.is_file():
        raise InputError(
            "the structure file does not exist",
            where=str(path),
            remedy="Correct the path given to --structure, or omit --structure",
        )
    with reading(text, by="ASE", remedy=CHECK_STRUCTURE):
        chosen = list(ase_images(path, which))
        count = 1 if chosen else sum(1 for _ in ase_images(path))
    if len(chosen) != 1:
        several = f"selects {len(chosen)} structures, but an audit tests only one"
        raise InputError(
            several if chosen else f"the file has no structure {which} (it has {count})",
            where=text,
            remedy="Add the index of one structure to the path: file@0 selects the first, file@-1 the last",
        )
    atoms = chosen[0]
    if not len(atoms):
        raise InputError(
            "the structure contains no atoms", where=text, remedy="Give another file or another structure"
        )
    bad = ~np.isfinite(atoms.positions).all(axis=1)
    if bad.any() or not np.isfinite(np.asarray(atoms.cell)).all():
        what = f"atom {int(np.argmax(bad))}" if bad.any() else "the cell"
        raise InputError(
            f"{what} contains a number that is not finite", where=text, remedy="Correct the structure"
        )
    atoms.info["origin"] = f"{len(atoms)} atoms, {atoms.get_chemical_formula()}, from {text}"
    return atoms


# -- two particles on a line, in which a calculator shows where its pair interaction changes -------


@dataclass(frozen=True)
class Pair:
    """Two particles (atoms or molecules) at any distance from each other."""

    species: tuple[str, str]  # symbols of the two reference atoms; molecules by the heaviest of their atoms
    first: Atoms  # the particle that stays, its reference atom at the origin
    second: Atoms  # the particle that moves along x, its reference atom at the origin
    box: float  # edge of the cubic cell around them, 0 for none
    periodic: bool  # whether the cell repeats
    name: str  # formulas of the two
    # what such a particle is in the structure, an atom or a molecule
    moves: Literal["atom", "molecule"] = "atom"

    def at(self, distance: float) -> Atoms:
        """Return the two particles with their reference atoms at exactly the given distance."""
        both = self._together.copy()
        both.positions[len(self.first) :, 0] += distance
        return both

    @cached_property
    def _together(self) -> Atoms:
        return self.surrounded(self.first + self.second)

    def surrounded(self, atoms: Atoms, middle: bool = False) -> Atoms:
        """Put atoms into the cell of the particles. If `middle`, center the particles."""
        if self.box:
            atoms.set_cell([self.box] * 3)
            if middle:
                atoms.positions += self.box / 2
        atoms.pbc = self.periodic
        return atoms

    def others(self, distance: float) -> Float[np.ndarray, "pairs"]:
        """Return the distances between the particles' other atoms."""
        moved = self.second.positions[None] + [distance, 0.0, 0.0]
        return np.linalg.norm(moved - self.first.positions[:, None], axis=2).ravel()[1:]

    def curve(self, subject: CalculatorSubject) -> Curve:
        """Return a function for energy and force on the second particle. A repulsive force is positive."""

        def at(distance: float) -> tuple[float, float]:
            energy, forces = subject.both(self.at(distance))
            return energy, float(forces[len(self.first) :, 0].sum())

        return Curve(at)


def pairs(subject: CalculatorSubject, most: int = 6) -> tuple[list[Pair], list[Skipped]]:
    """Return a pair of particles for every two species, frequent species first.

    A particle is a single atom if the calculator supports single atoms. If not, each atom gets two
    companions: some potentials divide by the number of neighbors. Where companions fail, as for rigid water,
    particles are molecules.

    Returns:
        (pairs, omitted pairs with the reason).
    """
    symbols = subject.atoms.get_chemical_symbols()
    species = sorted(set(symbols), key=lambda one: (-symbols.count(one), one))
    wanted = list(combinations_with_replacement(species, 2))
    wanted.sort(key=lambda two: -symbols.count(two[0]) * symbols.count(two[1]))
    nearest = nearest_distance(subject.atoms)
    found: list[Pair] = []
    skipped: list[Skipped] = []
    for one, other in wanted[:most]:
        single, another = (Atoms(symbol, [(0, 0, 0)]) for symbol in (one, other))
        pair, why = _answered(subject, (one, other), single, another, nearest)
        if pair is None:
            skipped.append((f"two atoms {one}-{other} by themselves", why))
            if nearest:
                trios = trio(one, nearest, -1.0), trio(other, nearest, 1.0)
                pair, _ = _answered(subject, (one, other), *trios, nearest)
        if pair is not None:
            found.append(pair)
    why = f"the {most} most frequent pairs were walked"
    skipped += [(f"pair {one}-{other}", why) for one, other in wanted[most:]]
    return found or _molecules(subject), skipped


def modified(atoms: Atoms, scaled: bool = False, **values: Any) -> Atoms:
    """Return a modified copy of a structure. If `scaled` is True, positions are scaled with the cell."""
    there = atoms.copy()
    if "cell" in values:
        there.set_cell(values.pop("cell"), scale_atoms=scaled)
    for name, value in values.items():
        setattr(there, name, value)
    return there


def exchanged(before: Atoms, after: Atoms) -> tuple[tuple[int, int], ...]:
    """Return (atom, k) if the k-th and the next neighbor of an atom have swapped order."""
    orders = []
    for atoms in (before, after):
        distances = atoms.get_all_distances(mic=bool(atoms.pbc.any()))
        np.fill_diagonal(distances, -1.0)
        orders.append(np.argsort(distances, axis=1, kind="stable"))
    found = []
    for center, (one, other) in enumerate(zip(*orders, strict=True)):
        # two that change places differ at two ranks, of which the first is k
        ranks = np.flatnonzero(one != other)
        found += [(center, int(k)) for k in ranks if k + 1 < len(one) and one[k] == other[k + 1]]
    return tuple(found)


def nearest_distance(atoms: Atoms) -> float:
    """Smallest distance among the first 500 atoms. 0 for a single atom."""
    if len(atoms) < 2:
        return 0.0
    distances = atoms[: min(len(atoms), 500)].get_all_distances(mic=bool(atoms.pbc.any()))
    return float(distances[~np.eye(len(distances), dtype=bool)].min())


def trio(symbol: str, side: float, way: float) -> Atoms:
    """Return an atom at the origin, with two companion atoms behind it."""
    depth = way * side * np.sqrt(0.75)
    return Atoms([symbol] * 3, [(0, 0, 0), (depth, side / 2, 0), (depth, -side / 2, 0)])


def molecules(atoms: Atoms) -> list[np.ndarray]:
    """Return the atoms of each molecule. Atoms are bonded if their covalent radii nearly touch."""
    from ase.neighborlist import natural_cutoffs, neighbor_list
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first, second = neighbor_list("ij", atoms, [1.1 * radius for radius in natural_cutoffs(atoms)])
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(atoms), len(atoms)))
    count, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.searchsorted(label[order], np.arange(1, count)))


def whole(atoms: Atoms, indices: np.ndarray) -> Atoms:
    """Return one unwrapped molecule with its heaviest atom at the origin."""
    part = _part(atoms, indices)
    lead = int(np.argmax(part.get_masses()))
    offsets = part.get_distances(lead, np.arange(len(part)), mic=bool(atoms.pbc.any()), vector=True)
    return Atoms(part.get_chemical_symbols(), offsets)


def _part(atoms: Atoms, indices: np.ndarray) -> Atoms:
    part = atoms[indices]
    assert isinstance(part, Atoms)
    return part


def _molecules(subject: CalculatorSubject) -> list[Pair]:
    """Return a pair of molecules, identical if possible. No pair is returned for a single molecule."""
    atoms, groups = subject.atoms, molecules(subject.atoms)
    if not 2 <= len(groups) <= len(atoms) / 2:
        return []
    formulas = [_part(atoms, group).get_chemical_formula() for group in groups]
    second = next((k for k in range(1, len(groups)) if formulas[k] == formulas[0]), 1)
    one, other = whole(atoms, groups[0]), whole(atoms, groups[second])
    leads = [part.get_chemical_symbols()[int(np.argmax(part.get_masses()))] for part in (one, other)]
    pair, _ = _answered(subject, (leads[0], leads[1]), one, other, 0.0)
    return [replace(pair, moves="molecule")] if pair else []


def _answered(
    subject: CalculatorSubject, species: tuple[str, str], first: Atoms, second: Atoms, nearest: float
) -> tuple[Pair | None, str]:
    """Return particles in the simplest cell that works, or None and the error message."""
    why = ""
    for cell, periodic in _SURROUNDINGS:
        name = "-".join(part.get_chemical_formula() for part in (first, second))
        pair = Pair(species, first, second, 2.5 * FARTHEST if cell else 0.0, periodic, name)
        for distance in filter(None, (nearest, 3.0, 6.0)):
            if isinstance(answer := subject.try_both(pair.at(distance)), CalculatorError):
                why = why or answer.message
                break
        else:
            return pair, ""
    return None, why


def coarse_scan(subject: CalculatorSubject, curve: Curve) -> tuple[Float[np.ndarray, "points"], float]:
    """Return the distances at which the calculator works, and the largest of them."""
    places = np.concatenate([np.arange(_NEAREST, 3.0, 0.1), np.arange(3.0, FARTHEST + 0.1, 0.25)])
    first = len(places)
    for k in range(len(places) - 1, -1, -1):
        try:
            with subject.trying():
                curve(float(places[k]))
        except CalculatorError:
            break
        first = k
    if first > len(places) - 4:
        curve(float(places[-4]))  # says why
    return places[first:], float(places[-1])


def group(atoms: Atoms) -> int | None:
    """Return the number of atoms per molecule. None if molecules differ.

    A salt crystal can also have a repeating sequence of species. Atoms of a molecule must be bonded (by
    covalent radii) only to one another.
    """
    numbers = atoms.numbers
    if len(set(numbers)) < 2:
        return None
    found = sorted(molecules(atoms), key=lambda one: one[0])
    size = len(found[0])
    species = np.resize(numbers[:size], len(numbers))
    if size < 2 or len(found) < 2 or not np.array_equal(species, numbers) or len(set(species[:size])) == 1:
        return None
    return size if all(np.array_equal(one, one[0] + np.arange(size)) for one in found) else None
