"""Test structures from elements that a calculator supports, if no structure is given."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import CalculatorError, Meter, TimeUp
from mdnum.audit.structures import FARTHEST, Pair, modified, nearest_distance, pairs
from mdnum.audit.subject import CalculatorSubject, LoadedCalculator, largest
from mdnum.deadline import Deadline, interrupting
from mdnum.errors import InputError

#: Elements in the order in which they are tried, followed by all others: argon if the calculator accepts any
#: element; and a second element for each.
_FIRST = {"Ar": "Kr", "Cu": "Ni", "Si": "Ge", "C": "Si", "O": "S", "Al": "Cu", "Fe": "Cr", "Na": "K"}
_LAST_ELEMENT = 95
#: Largest number of calls for building a structure, and in each direction of a search for the lowest energy.
BUILDING_CALLS, _SCALES = 400, 15
_MOST_ATOMS, _FEWEST_ATOMS = 500, 32
_SPACING = 3.1  # Å between molecules of water, as in the liquid
_WATER_EDGES = (4, 5, 6, 8)  # molecules along an edge: some calculators want a box of two cutoffs
#: Factors on the lattice constant of a crystal that are tried, because a calculator may fail if atoms have no
#: neighbors.
_DENSITIES = (1.0, 0.85, 0.72, 0.6, 0.5, 1.2)
_BARELY, _PRESSED = 0.9, 0.6  # a nearest distance above so much of the cutoff is made to be so much of it
_SLOW = 0.15  # seconds of processor time of a calculation above which the crystal is made no larger
#: Standard deviation of random displacements relative to the nearest distance: in a perfect crystal forces
#: are zero and distances are equal.
_RATTLE = 0.02
#: Distances of two atoms that are evaluated, from the largest to the smallest.
_DISTANCES = FARTHEST * 1.12 ** -np.arange(35.0)
#: Attributes that contain elements, those that contain atomic numbers, and those that contain a model.
_NAMES = ("elements", "species", "symbols", "atom_types", "chemical_symbols", "type_map", "parameters")
_NUMBERS = ("atomic_numbers", "z_table", "zs")
_MODELS = ("model", "models", "potential")
_MANY = 3  # a calculator that names more elements than these is meant for many: the usual ones come first
_WORDS = ("lead", "tin")  # names of elements that are words of English as well
_SAME = 1e-9  # of the energy: a second element that changes it by less is none to this calculator


def default_structure(loaded: LoadedCalculator, deadline: Deadline | None = None) -> Atoms:
    """Return a test structure: the calculator's own, a crystal, or rigid water.

    The crystal consists of an element for which the calculator is intended. If the calculator distinguishes a
    second element, half of the atoms are of that element. The lattice constant minimizes the calculator's
    energy of the crystal. The cell is two cutoffs wide, with at most 500 atoms (fewer for a slow calculator).
    The atoms are displaced slightly. `info["origin"]` describes how the structure was built.
    `info["guessed"]` is True if the calculator names no element. If the calculator fails on atoms without
    neighbors, a denser crystal is built.

    Args:
        deadline: time limit for building; at the deadline, or after `BUILDING_CALLS` calls, the best
            structure so far is returned.

    Raises:
        InputError: the calculator supports neither a single element nor water; the failing water structure is
            saved.
    """
    if loaded.atoms is not None:
        return _labeled(loaded.atoms, f"{len(loaded.atoms)} atoms of {loaded.name}")
    builder = _Builder(loaded, Meter(deadline=deadline or Deadline(), most=BUILDING_CALLS))
    try:
        with interrupting(builder.meter.deadline), builder.meter.limited():
            made = builder.built()
    except TimeUp as up:
        best = builder.best if builder.best is not None else _filled(*_unit_cell(*builder.likely[:1]))
        made = _labeled(best, f"{best.info['origin']}; {up.why.replace(' of this check', '')}")
    made.info["guessed"] = not builder.named
    return made


def _labeled(atoms: Atoms, origin: str) -> Atoms:
    copy = atoms.copy()
    copy.info["origin"] = origin
    return copy


class _Builder:
    """Builder of a test structure for a calculator. The best structure so far is kept."""

    def __init__(self, loaded: LoadedCalculator, meter: Meter):
        self.name, self.calculator, self.meter = loaded.name, loaded.make(), meter
        self.best: Atoms | None = None
        self.named = meant_for(self.calculator, loaded.name)
        self.likely = list(dict.fromkeys([*self.named, *_FIRST]))

    def about(self, atoms: Atoms) -> CalculatorSubject:
        """Return an audit subject that consists of the calculator and the given structure."""
        subject = CalculatorSubject(self.name, lambda: self.calculator, atoms, kT=1.0)
        subject.meter = self.meter
        return subject

    def built(self) -> Atoms:
        """Build and return the test structure."""
        from ase.data import chemical_symbols

        others = [one for one in chemical_symbols[1:_LAST_ELEMENT] if one not in self.likely]
        made = self._first(self.likely)
        why, saved = "", None
        for edge in _WATER_EDGES if made is None else ():
            subject = self.about(water(edge))
            subject.saving = edge == _WATER_EDGES[-1]
            try:
                felt = _feels(subject, subject.atoms)
            except CalculatorError as error:
                why, saved = error.message, error.structure
                continue
            wet = _labeled(subject.atoms, f"{edge**3} molecules of water, on a grid, turned at random")
            if felt:
                return wet
            self.best = self.best or wet
            break
        # after water, since a calculator of molecules may take any atoms in threes for them
        made = made or self._first(others) or self._first(self.likely, paired=False)
        if made is None and self.best is not None:
            return self.best  # on which no atom feels another: the forces say so
        if made is None:
            raise InputError(
                f"no energy could be computed for a crystal of any element or for water ({why}; the "
                f"structure of water was saved in {saved})",
                where=self.name,
                remedy="Use --structure FILE to give a structure that the calculator supports",
            )
        return self._mixed(made)

    def _first(self, symbols: Sequence[str], paired: bool = True) -> Atoms | None:
        """Return a crystal of the first usable element. If `paired`, a pair of particles gives the cutoff."""
        for symbol in symbols:
            subject = self.about(Atoms(symbol, [(0, 0, 0)]))
            with subject.trying():
                for pair in pairs(subject)[0][:1] if paired else [None]:
                    if (made := self._crystal(subject, pair, symbol)) is not None:
                        return made
        return None

    def _mixed(self, made: Atoms) -> Atoms:
        """Return the crystal. Add a second element if the calculator distinguishes two elements."""
        from ase.data import atomic_numbers

        self.best, symbol = made, str(made.symbols[0])
        others = [one for one in self.named if one != symbol]
        if len(others) > _MANY:
            size = lambda one: nearest_distance(_unit_cell(one)[0].repeat(2))  # noqa: E731
            others.sort(key=lambda one: abs(np.log(size(one) / size(symbol))))
        subject, pure = self.about(made), None
        for other in [*others[:_MANY], *([_FIRST[symbol]] if symbol in _FIRST else [])]:
            swapped = made.copy()
            swapped.numbers[1::2] = atomic_numbers[other]
            with subject.trying():
                try:
                    mixed = subject.energy(swapped)
                    pure = subject.energy(made) if pure is None else pure
                except CalculatorError:
                    continue
                if abs(mixed - pure) <= _SAME * abs(pure):
                    return made
                if (found := self._crystal(subject, None, symbol, other)) is not None:
                    return found
        return made

    def _crystal(self, subject: CalculatorSubject, pair: Pair | None, *symbols: str) -> Atoms | None:
        """Build a crystal for the calculator. None if the calculator fails at every density."""
        if pair is not None:
            self.cutoff, self.least = _felt(subject, pair)
        elif len(symbols) == 1:
            self.cutoff, self.least = None, None
        cell, kind = _unit_cell(*symbols)
        for start in (scale for scale in _DENSITIES if subject.answers(_small(cell, scale))):
            self.best = self.best or _filled(cell, kind, start)
            scale, relaxed = _least_energy(subject, cell, self.least, start)
            for how in ((scale, relaxed), (start, False))[: 1 + (scale != start)]:
                made = _grown(subject, cell, kind, *how, self.cutoff)
                if made is not None and ((felt := _feels(subject, made)) or len(made) > len(self.best)):
                    self.best = made
                    if felt:
                        return made
        return None


def meant_for(calculator: Any, words: str) -> list[str]:
    """Return the elements in a calculator's arguments, file or documentation, likeliest ones first."""
    from ase.data import atomic_names, atomic_numbers, chemical_symbols

    module = sys.modules.get(type(calculator).__module__)
    found = list(dict.fromkeys([*_symbols(getattr(module, "parameters", None)), *_symbols(calculator)]))
    if len(found) > _MANY:
        found.sort(key=lambda one: (*_FIRST, one).index(one))
    path = Path(words.partition(".py")[0] + ".py")
    text = path.read_text(errors="replace") if path.is_file() else ""
    # arguments and the name of a file; that of a class or a function ("InPlace", "CoModel") is no element
    home, _, call = words.partition(":")
    name = f"{home.rpartition('/')[2] if '/' in home or '.py' in home else ''} {call.partition('(')[2]}"
    spoken = {name.lower(): chemical_symbols[k] for k, name in enumerate(atomic_names) if k}
    said = re.findall(r"[a-z]+", f"{name} {type(calculator).__doc__ or ''} {text}".lower())
    found += [spoken[word] for word in said if word in spoken and word not in _WORDS]
    # symbols of two letters alone: others are as often something else
    written = re.findall(r"(?<![A-Za-z])[A-Z][a-z](?![a-z])", name)
    written += re.findall(r"""["']([A-Z][a-z])["']""", text)
    return list(dict.fromkeys([*found, *(one for one in written if one in atomic_numbers)]))


def _symbols(value: Any, numbers: bool = False, depth: int = 4) -> Iterator[str]:
    """Yield the chemical symbols in a value, its attributes, and its dictionary keys."""
    from ase.data import chemical_symbols

    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, str) and value in chemical_symbols[1:]:
        yield value
    elif isinstance(value, int) and numbers and 0 < value < _LAST_ELEMENT:
        yield chemical_symbols[value]
    elif isinstance(value, dict):
        keys = [one for key in value for one in (key if isinstance(key, tuple) else (key,))]
        if all(one in chemical_symbols[1:] for one in keys if isinstance(one, str)):
            yield from _symbols(keys, numbers)
        yield from _symbols([*value.values()], numbers, depth)
    elif isinstance(value, list | tuple | set):
        for item in sorted(value) if isinstance(value, set) else value:
            yield from _symbols(item, numbers, depth)
    elif depth and not isinstance(value, float):
        for name in (*_NAMES, *_NUMBERS, *_MODELS):
            yield from _symbols(getattr(value, name, None), name in _NUMBERS, depth - 1)


def water(edge: int = 4) -> Atoms:
    """Return rigid water molecules on a cubic grid in fixed random orientations. Order: O, H, H."""
    from ase.calculators.tip3p import angleHOH, rOH
    from scipy.spatial.transform import Rotation

    half = np.radians(angleHOH) / 2
    flat = rOH * np.array([[0, 0, 0], [np.cos(half), np.sin(half), 0], [np.cos(half), -np.sin(half), 0]])
    turns = Rotation.random(edge**3, rng=np.random.default_rng(0)).as_matrix()
    corners = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    positions = np.concatenate([flat @ turn.T for turn in turns])
    positions += np.repeat((corners + 0.5) * _SPACING, 3, axis=0)
    return Atoms("OH2" * edge**3, positions, cell=[edge * _SPACING] * 3, pbc=True)


def _processor_time(subject: CalculatorSubject, atoms: Atoms) -> float:
    """Measure the processor time of one calculation twice. Return the smaller value (s).

    The processor time includes that of the calculator's child processes. Other programs are not included, so
    the load of the machine does not affect the structure.
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
    """Estimate the cutoff of a pair of particles, and the distance of lowest energy. Both may be None.

    If the calculator fails on atoms without neighbors, it begins to fail at the cutoff.
    """
    curve, distances = pair.curve(subject), _DISTANCES.tolist()
    known: dict[float, tuple[float, float]] = {}
    for distance in distances:
        try:
            known[distance] = curve(distance)
        except CalculatorError:
            if known:
                break
    if not known:
        return None, None
    energy_far = known[distances[0]][0] if distances[0] in known else None

    def felt(distance: float) -> bool:
        try:
            energy, force = curve(distance)
        except CalculatorError:
            return False
        return energy_far is None or max(abs(energy - energy_far), abs(force)) > 1e-12

    cutoff, inside = None, next((one for one in known if felt(one)), distances[0])
    if inside != distances[0]:
        low, cutoff = inside, distances[distances.index(inside) - 1]
        for _ in range(4):
            middle = 0.5 * (low + cutoff)
            low, cutoff = (middle, cutoff) if felt(middle) else (low, middle)
    least = min((one for one in known if one > 0.8), key=lambda one: known[one][0])
    bound = energy_far is not None and known[least][0] < energy_far - 1e-9
    return cutoff, least if bound else None


def _feels(subject: CalculatorSubject, atoms: Atoms) -> bool:
    """Return whether the atoms interact: a force is nonzero, or displacements change the energy."""
    (energy, forces), moved = subject.both(atoms), atoms.copy()
    moved.rattle(_RATTLE * nearest_distance(atoms), seed=1)
    other = subject.try_both(moved)
    change = np.inf if isinstance(other, CalculatorError) else abs(other[0] - energy)
    return largest(forces) > _SAME or change > _SAME * max(abs(energy), 1.0)


def _grown(
    subject: CalculatorSubject, cell: Atoms, kind: str, scale: float, relaxed: bool, cutoff: float | None
) -> Atoms | None:
    """Return the largest crystal, up to two cutoffs wide, that is fast enough, or None."""
    at = "at the calculator's own least energy" if relaxed else _tabulated(scale)
    if cutoff and scale * _least_distance(cell) > _BARELY * cutoff:
        # nothing holds it together: a crystal in which nothing is felt would tell nothing
        scale, at = _PRESSED * cutoff / _least_distance(cell), "nothing binds it, so pressed together"
    edge = scale * float(np.asarray(cell.cell).diagonal().min())
    few, most = (int((count / len(cell)) ** (1 / 3) + 0.999) for count in (_FEWEST_ATOMS, _MOST_ATOMS - 64))
    wanted = int(np.ceil((2.05 * cutoff if cutoff else 12.0) / edge))
    made: Atoms | None = None
    for repeat in range(few, max(few, min(wanted, most)) + 1):
        larger = _filled(cell, kind, scale, at, repeat)
        if not subject.answers(larger):
            continue
        # it is asked hundreds of times; narrower than two cutoffs, which not every calculator takes
        took = _processor_time(subject, larger)
        if took > _SLOW and repeat < wanted:
            made = larger if made is None else made
            why = f"; one calculation of {len(larger)} atoms takes {took:.2g} s of a processor"
            return _labeled(made, made.info["origin"] + why)
        made = larger if took <= _SLOW or made is None else made
    return made


def _tabulated(scale: float) -> str:
    return "at its tabulated lattice constant" + ("" if scale == 1.0 else f" times {scale:.4g}")


def _filled(cell: Atoms, kind: str, scale: float = 1.0, at: str | None = None, repeat: int = 2) -> Atoms:
    """Scale and repeat a unit cell. Return the crystal with slightly displaced atoms."""
    cell = modified(cell, cell=cell.cell.array * scale, scaled=True)
    atoms, nearest = cell.repeat(repeat), _least_distance(cell)
    atoms.rattle(_RATTLE * nearest, seed=0)
    return _labeled(
        atoms,
        f"{len(atoms)} atoms of {kind}, nearest distance {nearest:.4g} Å ({at or _tabulated(scale)}), "
        f"displaced by {_RATTLE * nearest:.2g} Å",
    )


def _unit_cell(symbol: str, *others: str) -> tuple[Atoms, str]:
    """Return a rectangular fcc, bcc or diamond unit cell. Elements with other structures become fcc.

    Half of the atoms are of the second element, if given.
    """
    from ase.build import bulk
    from ase.data import atomic_numbers, covalent_radii, reference_states

    state = reference_states[atomic_numbers[symbol]]
    if state is not None and state.get("symmetry") in ("fcc", "bcc", "diamond") and state.get("a"):
        cell, lattice = bulk(symbol, cubic=True), state["symmetry"]
    else:
        nearest = 2 * float(covalent_radii[atomic_numbers[symbol]])
        cell, lattice = bulk(symbol, "fcc", a=nearest * np.sqrt(2), cubic=True), "fcc"
    for other in others:
        cell.numbers[1::2] = atomic_numbers[other]
    return cell, f"{' and '.join((symbol, *others))}, {lattice}"


def _least_distance(cell: Atoms) -> float:
    """Return the smallest distance between two atoms of a crystal, periodic images included."""
    return nearest_distance(cell.repeat(2))


def _least_energy(
    subject: CalculatorSubject, cell: Atoms, least: float | None, start: float
) -> tuple[float, bool]:
    """Return the scaling factor of lowest energy, and whether the energy has a minimum there."""

    def energy(scale: float) -> float:
        try:
            return subject.energy(_small(cell, scale))
        except CalculatorError:
            return np.inf

    if least is not None and abs(energy(1.01) - energy(1.0)) < 1e-9:
        start = least / _least_distance(cell)  # too far apart to feel one another: start at two atoms' own
    scale, here = start, energy(start)
    for direction in (1.03, 1 / 1.03):
        for _ in range(_SCALES):
            there = energy(scale * direction)
            if not there < here:
                break
            scale, here = scale * direction, there
        else:
            return start, False
    return (scale, True) if np.isfinite(here) else (start, False)


def _small(cell: Atoms, scale: float) -> Atoms:
    """Return a small crystal whose lattice is scaled by a factor."""
    small = cell.repeat(max(int(np.ceil((_FEWEST_ATOMS / len(cell)) ** (1 / 3))), 1))
    return modified(small, cell=small.cell.array * scale, scaled=True)
