"""What is asked about: a structure from a file or built for the calculator, two particles on a line."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Literal

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import CalculatorError, Skipped
from mdnum.audit.curve import Curve
from mdnum.audit.subject import CalculatorSubject, LoadedCalculator
from mdnum.errors import InputError, expect_path
from mdnum.reading import CHECK_STRUCTURE, ase_images, reading

#: Tried in this order, and then every other element: argon where anything goes.
_FIRST = ("Ar", "Cu", "Si", "C", "O", "Al", "Fe", "Na")
_LAST_ELEMENT = 95
#: Calls for building a structure, at most.
BUILDING_CALLS = 400
_MOST_ATOMS, _FEWEST_ATOMS = 500, 32
#: Å between molecules of water, as in the liquid.
_SPACING = 3.1
#: Molecules along an edge: some calculators want a box of two cutoffs.
_WATER_EDGES = (4, 5, 6, 8)
#: Factors on a lattice constant at which a crystal is tried: a calculator may fail where nothing is near.
_DENSITIES = (1.0, 0.85, 0.72, 0.6, 0.5, 1.2)
#: A nearest distance above the first part of the cutoff is made to be the second part of it.
_BARELY, _PRESSED = 0.9, 0.6
#: Seconds of processor time of a calculation above which the crystal is made smaller.
_SLOW = 0.15
#: Standard deviation, of the nearest distance: in a perfect crystal forces are zero and distances tie.
_RATTLE = 0.02


#: What a calculator may want around two atoms, the simplest first: (a cell, periodic).
_SURROUNDINGS = ((False, False), (True, False), (True, True))
#: A scan does not go further apart than this, in the unit of length.
FARTHEST = 30.0
#: Distances are walked from the first.
_NEAREST = 0.3


def read_structure(words: str | Path) -> Atoms:
    """A structure from any file that ASE reads; `file@5` is its sixth, otherwise the last is taken.

    What follows the @ is what ASE takes there: a number, from the end if negative, or a choice in a database
    (`file.db@id=3`), as long as it means one structure.

    Raises:
        InputError: no such file, ASE cannot read it, no atoms, numbers that are not finite.
    """
    expect_path(words, "Give ASE's Atoms or the path of a file that ASE reads")
    text = str(words)
    head, separator, index = text.rpartition("@")
    path, which = (Path(head), index) if separator and not Path(text).exists() else (Path(text), "-1")
    if not path.is_file():
        raise InputError(
            "no such structure file", where=str(path), remedy="Correct --structure, or leave it out"
        )
    with reading(text, by="ASE", remedy=CHECK_STRUCTURE):
        chosen = list(ase_images(path, which))
    if len(chosen) != 1:
        raise InputError(
            f"means {len(chosen)} structures, and an audit is about one structure",
            where=text,
            remedy="Name one by its number: file@0 is the first, file@-1 the last",
        )
    atoms = chosen[0]
    if not isinstance(atoms, Atoms) or len(atoms) == 0:
        raise InputError("holds no atoms", where=text, remedy="Name another file, or another index: file@0")
    bad = ~np.isfinite(atoms.positions).all(axis=1)
    if bad.any() or not np.isfinite(np.asarray(atoms.cell)).all():
        what = f"atom {int(np.argmax(bad))}" if bad.any() else "the cell"
        raise InputError(
            f"{what} has a number that is not finite", where=text, remedy="Correct the structure"
        )
    return _labeled(atoms, f"{len(atoms)} atoms, {atoms.get_chemical_formula()}, from {text}")


def default_structure(loaded: LoadedCalculator) -> Atoms:
    """A structure for a calculator: its own, or a crystal of an element it takes, or rigid water.

    The crystal is the element's, with the lattice at the calculator's own least energy, repeated until two
    cutoffs fit in (at most 500 atoms), its atoms displaced a little. `info["origin"]` describes it. For a
    calculator that fails on atoms without neighbors a denser crystal is built: that it fails is a finding,
    and no reason to stop.

    Raises:
        InputError: the calculator answers for no element and not for water; where it was asked about water,
            that is saved.
    """
    if loaded.atoms is not None:
        return _labeled(loaded.atoms, f"{len(loaded.atoms)} atoms of {loaded.name}")
    calculator = loaded.make()

    def about(atoms: Atoms) -> CalculatorSubject:
        return CalculatorSubject(loaded.name, lambda: calculator, atoms, kT=1.0)

    likely, others = _symbols(calculator)
    made = _first_crystal(about, likely)
    why, saved = "", None
    for edge in _WATER_EDGES if made is None else ():
        subject = about(water(edge))
        subject.saving = edge == _WATER_EDGES[-1]
        try:
            subject.energy(subject.atoms)
        except CalculatorError as error:
            why, saved = error.message, error.structure
        else:
            return _labeled(subject.atoms, f"{edge**3} molecules of water, on a grid, turned at random")
    # after water, since a calculator of molecules may take any atoms in threes for them
    made = made or _first_crystal(about, others) or _first_crystal(about, likely, paired=False)
    if made is None:
        raise InputError(
            "the calculator answers neither for atoms of any element nor for water "
            f"({why}; saved in {saved})",
            where=loaded.name,
            remedy="Give a structure that it is made for: --structure FILE",
        )
    return made


def _first_crystal(
    about: Callable[[Atoms], CalculatorSubject], symbols: Sequence[str], paired: bool = True
) -> Atoms | None:
    """The crystal of the first element that is answered for, two atoms of it first where they are asked."""
    for symbol in symbols:
        subject = about(Atoms(symbol, [(0, 0, 0)]))
        with subject.trying():
            for pair in pairs(subject)[0][:1] if paired else [None]:
                if (made := _crystal(subject, pair, symbol)) is not None:
                    return made
    return None


def _labeled(atoms: Atoms, origin: str) -> Atoms:
    copy = atoms.copy()
    copy.info["origin"] = origin
    return copy


def water(edge: int = 4) -> Atoms:
    """Rigid water on a cubic grid in random orientations (always the same ones), in the order O, H, H."""
    from ase.calculators.tip3p import angleHOH, rOH
    from scipy.spatial.transform import Rotation

    half = np.radians(angleHOH) / 2
    flat = rOH * np.array([[0, 0, 0], [np.cos(half), np.sin(half), 0], [np.cos(half), -np.sin(half), 0]])
    turns = Rotation.random(edge**3, rng=np.random.default_rng(0)).as_matrix()
    corners = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    positions = np.concatenate([flat @ turn.T for turn in turns])
    positions += np.repeat((corners + 0.5) * _SPACING, 3, axis=0)
    return Atoms("OH2" * edge**3, positions, cell=[edge * _SPACING] * 3, pbc=True)


def _symbols(calculator: object) -> tuple[list[str], list[str]]:
    """Elements to try: those the calculator names and the usual ones, and all others."""
    from ase.data import chemical_symbols

    named: list[str] = []
    for attribute in ("elements", "species", "symbols", "atom_types", "parameters"):
        value = getattr(calculator, attribute, None)
        if isinstance(value, dict | list | tuple | set):
            words = [word for key in value for word in (key if isinstance(key, tuple) else (key,))]
            named += [word for word in words if isinstance(word, str) and word in chemical_symbols[1:]]
    likely = list(dict.fromkeys([*named, *_FIRST]))
    return likely, [one for one in chemical_symbols[1:_LAST_ELEMENT] if one not in likely]


def _crystal(subject: CalculatorSubject, pair: Pair | None, symbol: str) -> Atoms | None:
    """The element's crystal, None where the calculator answers for it at no density."""
    cutoff, least = (None, None) if pair is None else _felt(subject, pair)
    cell, lattice = _unit_cell(symbol)
    start = next((scale for scale in _DENSITIES if subject.answers(_small(cell, scale))), None)
    if start is None:
        return None
    scale, relaxed = _least_energy(subject, cell, least, start)
    for how in ((scale, relaxed, cutoff), (start, False, cutoff)):
        made = _filled(cell, f"{symbol}, {lattice}", *how)
        if not subject.answers(made):
            continue
        took = _processor_time(subject, made)
        small = _filled(cell, f"{symbol}, {lattice}", *how, few=True)
        # it is asked hundreds of times; narrower than two cutoffs, which not every calculator takes
        if took <= _SLOW or len(small) >= len(made) or not subject.answers(small):
            return made
        why = f"; of {len(made)} atoms, for two cutoffs, one calculation takes {took:.2g} s of a processor"
        return _labeled(small, small.info["origin"] + why)
    return None


def _processor_time(subject: CalculatorSubject, atoms: Atoms) -> float:
    """Seconds of processor time of energy and forces, after the first; the less of two.

    Programs that a calculator starts and ends count. What other programs do at the time does not, so that
    the same structure is asked about whatever the load.
    """

    def clock() -> float:
        children = os.times()
        return time.process_time() + children.children_user + children.children_system

    took = []
    for _ in range(2):
        atoms = atoms.copy()
        atoms.positions[0, 0] += 1e-4
        began = clock()
        subject.both(atoms)
        took.append(clock() - began)
    return min(took)


def _felt(subject: CalculatorSubject, pair: Pair) -> tuple[float | None, float | None]:
    """As `rough`; of a calculator that fails on atoms without neighbors, the distance at which it does."""
    try:
        return rough(subject, pair)
    except CalculatorError:
        curve = pair.curve(subject)
        for distance in np.arange(3.0, FARTHEST, 0.25):
            try:
                curve(float(distance))
            except CalculatorError:
                return float(distance), None
        return None, None


def _filled(
    cell: Atoms, kind: str, scale: float, relaxed: bool, cutoff: float | None, few: bool = False
) -> Atoms:
    """The crystal with its lattice scaled, repeated to two cutoffs or a few atoms, and displaced a little."""
    cell = cell.copy()
    tabulated = "at its tabulated lattice constant" + ("" if scale == 1.0 else f" times {scale:.4g}")
    at = "at the calculator's own least energy" if relaxed else tabulated
    if cutoff and scale * _least_distance(cell) > _BARELY * cutoff:
        # nothing holds it together: a crystal in which nothing is felt would tell nothing
        scale, at = _PRESSED * cutoff / _least_distance(cell), "nothing binds it, so pressed together"
    cell.set_cell(np.asarray(cell.cell) * scale, scale_atoms=True)
    wanted = 0.0 if few else 2.05 * cutoff if cutoff else 12.0
    edge = float(np.asarray(cell.cell).diagonal().min())
    repeat = max(int(np.ceil(wanted / edge)), int(np.ceil((_FEWEST_ATOMS / len(cell)) ** (1 / 3))))
    repeat = max(min(repeat, int((_MOST_ATOMS / len(cell)) ** (1 / 3))), 1)
    atoms = cell.repeat(repeat)
    nearest = _least_distance(cell)
    atoms.rattle(_RATTLE * nearest, seed=0)
    return _labeled(
        atoms,
        f"{len(atoms)} atoms of {kind}, nearest distance {nearest:.4g} Å ({at}), "
        f"displaced by {_RATTLE * nearest:.2g} Å",
    )


def _unit_cell(symbol: str) -> tuple[Atoms, str]:
    """The element's crystal as a rectangular cell; fcc of its size where it has none of these."""
    from ase.build import bulk
    from ase.data import atomic_numbers, covalent_radii, reference_states

    state = reference_states[atomic_numbers[symbol]]
    if state is not None and state.get("symmetry") in ("fcc", "bcc", "diamond") and state.get("a"):
        return bulk(symbol, cubic=True), state["symmetry"]
    nearest = 2 * float(covalent_radii[atomic_numbers[symbol]])
    return bulk(symbol, "fcc", a=nearest * np.sqrt(2), cubic=True), "fcc"


def _least_distance(cell: Atoms) -> float:
    """Smallest distance between two atoms of a crystal, images included."""
    return nearest_distance(cell.repeat(2))


def _least_energy(
    subject: CalculatorSubject, cell: Atoms, least: float | None, start: float
) -> tuple[float, bool]:
    """(factor on the lattice at which its energy is least, whether there was one), from a start on."""

    def energy(scale: float) -> float:
        try:
            return subject.energy(_small(cell, scale))
        except CalculatorError:
            return np.inf

    if least is not None and abs(energy(1.01) - energy(1.0)) < 1e-9:
        start = least / _least_distance(cell)  # too far apart to feel one another: start at two atoms' own
    scale, here = start, energy(start)
    for direction in (1.03, 1 / 1.03):
        for _ in range(60):
            there = energy(scale * direction)
            if not there < here:
                break
            scale, here = scale * direction, there
    ended = np.isfinite(here) and 0.2 < scale / start < 5.0
    return (scale, True) if ended else (start, False)


def _small(cell: Atoms, scale: float) -> Atoms:
    """A few atoms of a crystal whose lattice is scaled."""
    small = cell.repeat(max(int(np.ceil((_FEWEST_ATOMS / len(cell)) ** (1 / 3))), 1))
    small.set_cell(np.asarray(small.cell) * scale, scale_atoms=True)
    return small


# -- two particles on a line, in which a calculator shows where its pair interaction changes -------


@dataclass(frozen=True)
class Pair:
    """Two particles, single atoms or whole molecules, that can be put at any distance."""

    species: tuple[str, str]  # symbols of the two reference atoms; molecules by the heaviest of their atoms
    first: Atoms  # the particle that stays, its reference atom at the origin
    second: Atoms  # the particle that moves along x, its reference atom at the origin
    box: float  # edge of the cubic cell around them, 0 for none
    periodic: bool  # whether the cell repeats
    name: str  # formulas of the two
    # what such a particle is in the structure, an atom or a molecule
    moves: Literal["atom", "molecule"] = "atom"

    def at(self, distance: float) -> Atoms:
        """The two at a distance (of the reference atoms), which is exact in the last bit."""
        both = self._together.copy()
        both.positions[len(self.first) :, 0] += distance
        return both

    @cached_property
    def _together(self) -> Atoms:
        both = self.first + self.second
        if self.box:
            both.set_cell([self.box] * 3)
        both.pbc = self.periodic
        return both

    def others(self, distance: float) -> Float[np.ndarray, "pairs"]:
        """Distances between the two of all atoms but the reference atoms, at a distance of those."""
        moved = self.second.positions[None] + [distance, 0.0, 0.0]
        return np.linalg.norm(moved - self.first.positions[:, None], axis=2).ravel()[1:]

    def curve(self, subject: CalculatorSubject) -> Curve:
        """Energy against distance, and the force that drives the second away from the first."""

        def at(distance: float) -> tuple[float, float]:
            energy, forces = subject.both(self.at(distance))
            return energy, float(forces[len(self.first) :, 0].sum())

        return Curve(at)


def pairs(subject: CalculatorSubject, most: int = 6) -> tuple[list[Pair], list[Skipped]]:
    """Two of each species of the structure that the calculator answers for, the most frequent first.

    Single atoms where it takes them as near as they come in the structure; where it does not (a bond order
    may divide by the number of neighbors), each with two companions behind it; where it takes no such atoms
    at all (rigid water), molecules of the structure.

    Returns:
        (pairs, what was left out and why).
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


def nearest_distance(atoms: Atoms) -> float:
    """Smallest distance of two atoms of a structure, of the first 500 of many; 0 where there is one atom."""
    if len(atoms) < 2:
        return 0.0
    distances = atoms[: min(len(atoms), 500)].get_all_distances(mic=bool(atoms.pbc.any()))
    return float(distances[~np.eye(len(distances), dtype=bool)].min())


def trio(symbol: str, side: float, way: float) -> Atoms:
    """An atom at the origin with two companions behind it."""
    depth = way * side * np.sqrt(0.75)
    return Atoms([symbol] * 3, [(0, 0, 0), (depth, side / 2, 0), (depth, -side / 2, 0)])


def molecules(atoms: Atoms) -> list[np.ndarray]:
    """Indices of the atoms of each molecule: those that bonds connect, by covalent radii."""
    from ase.neighborlist import natural_cutoffs, neighbor_list
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first, second = neighbor_list("ij", atoms, [1.1 * radius for radius in natural_cutoffs(atoms)])
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(atoms), len(atoms)))
    count, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.searchsorted(label[order], np.arange(1, count)))


def whole(atoms: Atoms, indices: np.ndarray) -> Atoms:
    """One molecule in one piece, its heaviest atom at the origin; no cell."""
    part = _part(atoms, indices)
    lead = int(np.argmax(part.get_masses()))
    offsets = part.get_distances(lead, np.arange(len(part)), mic=bool(atoms.pbc.any()), vector=True)
    return Atoms(part.get_chemical_symbols(), offsets)


def _part(atoms: Atoms, indices: np.ndarray) -> Atoms:
    part = atoms[indices]
    assert isinstance(part, Atoms)
    return part


def _molecules(subject: CalculatorSubject) -> list[Pair]:
    """Two molecules of the structure, where it consists of several; alike if there are two alike."""
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
    """The simplest surroundings in which the calculator gives energy and forces, or why there are none."""
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
    """Distances from where the calculator first answers to the farthest."""
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


def rough(subject: CalculatorSubject, pair: Pair) -> tuple[float | None, float | None]:
    """(where a pair stops interacting, where its energy is least), to within a coarse scan; None if never."""
    curve = pair.curve(subject)
    coarse, far = coarse_scan(subject, curve)
    energies, forces = curve.many(coarse)
    energies = energies - curve(far)[0]
    felt = np.flatnonzero((np.abs(energies) > 1e-12) | (np.abs(forces) > 1e-12))
    cutoff = None if len(felt) == 0 or felt[-1] >= len(coarse) - 2 else float(coarse[felt[-1] + 1])
    lowest = int(np.argmin(energies[coarse > 0.8])) + int((coarse <= 0.8).sum())
    least = float(coarse[lowest]) if energies[lowest] < -1e-9 and lowest > 0 else None
    return cutoff, least


def group(atoms: Atoms) -> int | None:
    """Atoms in a molecule, where the structure is molecules of several species, one after another; else None.

    That species repeat in groups is not enough: so they do in a crystal of salt. Atoms of a group must be
    bonded, by their covalent radii, and to no others.
    """
    numbers = atoms.numbers
    for size in range(2, len(atoms) // 2 + 1):
        if len(atoms) % size == 0 and np.array_equal(numbers[size:], numbers[:-size]):
            if len(set(numbers[:size])) == 1:
                return None
            expected = np.arange(len(atoms)).reshape(-1, size)
            found = sorted(molecules(atoms), key=lambda one: one[0])
            alike = len(found) == len(expected) and all(map(np.array_equal, found, expected))
            return size if alike else None
    return None
