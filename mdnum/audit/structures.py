"""What is asked about: a calculator by its words, and a structure from a file or built for the calculator."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.pairs import FARTHEST, Pair, pairs
from mdnum.audit.subject import CalculatorError, CalculatorSubject, only_trying
from mdnum.audit.thresholds import rough
from mdnum.errors import InputError
from mdnum.references.load import described, place
from mdnum.units import METAL, Units

_WAYS = (
    "Give package.module:Class(argument=value), the path of a Python file that makes a calculator, "
    "or a system such as argon/liquid-864 (`mdnum systems` lists them)"
)
#: Tried in this order, and then every other element: argon where anything goes.
_FIRST = ("Ar", "Cu", "Si", "C", "O", "Al", "Fe", "Na")
_LAST_ELEMENT = 95
_MOST_ATOMS, _FEWEST_ATOMS = 500, 32
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


@dataclass(frozen=True)
class LoadedCalculator:
    """A calculator by name.

    Attributes:
        name: what the person wrote.
        stem: a short word for a folder's name.
        make: makes a calculator object that remembers nothing of another.
        atoms: the structure that comes with it (a system of mdnum has one), or None.
        kT: energy of its temperature where it has one, eV; None otherwise.
        units: of its lengths and energies: those of ASE, or reduced ones for some systems of mdnum.
    """

    name: str
    stem: str
    make: Callable[[], Any]
    atoms: Atoms | None = None
    kT: float | None = None
    units: Units = METAL


def load_calculator(words: str) -> LoadedCalculator:
    """Find what words name, and make it once so that mistakes show here.

    A file is run again for each calculator, so that no two share a buffer.

    Args:
        words: `package.module:Class(argument=value)` with literals as arguments; a Python file in which
            `calculator`, `calc` or `make()` is a calculator, or `file.py:name` or `file.py:Class(a=1)`; or
            the name or path of a system of mdnum.

    Raises:
        InputError: nothing by that name, arguments that are not literals, or making it failed; with what to
            write instead.
    """
    text = words.strip()
    if not text:
        raise InputError("no calculator named", remedy=_WAYS)
    spot = place(text)
    if spot is None:
        return _of_system(text)

    def make() -> Any:
        value = spot.find(("calculator", "calc", "make"), anew=True)
        if (isinstance(value, type) or not _is_calculator(value)) and callable(value):
            try:
                value = value()
            except Exception as error:  # whatever a constructor raises
                remedy = "Give the arguments it needs: Class(argument=value)"
                raise InputError(
                    f"making it failed: {described(error)}", where=text, remedy=remedy
                ) from error
        return value

    made = make()
    if isinstance(made, type) or not _is_calculator(made):
        raise InputError(
            f"that is a {type(made).__name__}, not an ASE calculator (an object with get_potential_energy "
            "and get_forces)",
            where=text,
            remedy=_WAYS,
        )
    return LoadedCalculator(text, Path(spot.home).stem if spot.is_file else spot.name, make)


def _is_calculator(value: Any) -> bool:
    # atoms pass the question on to their calculator
    methods = ("get_potential_energy", "get_forces")
    return all(hasattr(value, one) for one in methods) and not hasattr(value, "get_positions")


def _of_system(text: str) -> LoadedCalculator:
    from mdnum import systems

    try:
        system = systems.load(text, None, world="md")
    except InputError as error:
        if "." in text and "/" not in text and not text.endswith(".toml"):
            module, _, last = text.rpartition(".")
            raise InputError(
                f"{text!r} is no system of mdnum",
                remedy=f"For a class, put a colon before its name: {module}:{last}",
            ) from error
        raise InputError(
            f"{error.message}; nor is it a class or a Python file",
            where=error.where,
            remedy=f"{error.remedy}. {_WAYS}" if error.remedy else _WAYS,
        ) from error

    def make() -> Any:
        from mdnum.references.ase_models import MdnumCalculator

        return MdnumCalculator(system)

    temperature = getattr(system.spec.dynamics, "temperature", None)
    kT = float(temperature) * system.units.k_B if temperature else None
    stem = Path(text).stem.removesuffix(".toml")
    return LoadedCalculator(text, stem, make, system.atoms.copy(), kT, system.units)


def read_structure(words: str | Path) -> Atoms:
    """A structure from any file that ASE reads; `file@5` is its sixth, otherwise the last is taken.

    What follows the @ is what ASE takes there: a number, from the end if negative, or a choice in a database
    (`file.db@id=3`), as long as it means one structure.

    Raises:
        InputError: no such file, ASE cannot read it, no atoms, numbers that are not finite.
    """
    import ase.io

    text = str(words)
    head, separator, index = text.rpartition("@")
    path, which = (Path(head), index) if separator and not Path(text).exists() else (Path(text), "-1")
    if not path.is_file():
        raise InputError(
            "no such structure file", where=str(path), remedy="Correct --structure, or leave it out"
        )
    try:
        found = ase.io.read(path, index=which)
    except Exception as error:  # ASE's readers raise whatever their parsing meets
        raise InputError(
            f"cannot be read as a structure ({described(error)})",
            where=text,
            remedy="Check that `ase.io.read` opens it; extxyz is the safest format",
        ) from error
    chosen = found if isinstance(found, list) else [found]
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
    made = made or _first_crystal(about, others)
    # after water, since a calculator of molecules may take any atoms in threes for them
    made = made or _first_crystal(about, likely, paired=False)
    if made is not None:
        return made
    raise InputError(
        f"the calculator answers neither for atoms of any element nor for water ({why}; saved in {saved})",
        where=loaded.name,
        remedy="Give a structure that it is made for: --structure FILE",
    )


def _first_crystal(
    about: Callable[[Atoms], CalculatorSubject], symbols: Sequence[str], paired: bool = True
) -> Atoms | None:
    """The crystal of the first element that is answered for, two atoms first unless they are not asked."""
    for symbol in symbols:
        subject = about(Atoms(symbol, [(0, 0, 0)]))
        with only_trying(subject):
            found = pairs(subject)[0][:1] if paired else [None]
            made = [_crystal(subject, pair, symbol) for pair in found]
        if made and made[0] is not None:
            return made[0]
    return None


def _labeled(atoms: Atoms, origin: str) -> Atoms:
    copy = atoms.copy()
    copy.info["origin"] = origin
    return copy


def water(edge: int = 4, spacing: float = 3.1) -> Atoms:
    """Rigid water on a cubic grid in random orientations (always the same ones), in the order O, H, H.

    Args:
        edge: molecules along an edge.
        spacing: between them, Å; 3.1 is the density of the liquid.
    """
    from ase.calculators.tip3p import angleHOH, rOH
    from scipy.spatial.transform import Rotation

    half = np.radians(angleHOH) / 2
    flat = rOH * np.array([[0, 0, 0], [np.cos(half), np.sin(half), 0], [np.cos(half), -np.sin(half), 0]])
    turns = Rotation.random(edge**3, rng=np.random.default_rng(0)).as_matrix()
    corners = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    positions = np.concatenate([flat @ turn.T for turn in turns])
    positions += np.repeat((corners + 0.5) * spacing, 3, axis=0)
    return Atoms("OH2" * edge**3, positions, cell=[edge * spacing] * 3, pbc=True)


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
    start = next((scale for scale in _DENSITIES if _answers(subject, _small(cell, scale))), None)
    if start is None:
        return None
    scale, relaxed = _least_energy(subject, cell, least, start)
    for factor, at_least in ((scale, relaxed), (start, False)):
        made = _filled(cell, lattice, factor, at_least, cutoff, symbol)
        if not _answers(subject, made):
            continue
        took = _processor_time(subject, made)
        small = _filled(cell, lattice, factor, at_least, cutoff, symbol, few=True)
        # it is asked hundreds of times; narrower than two cutoffs, which not every calculator takes
        if took <= _SLOW or len(small) >= len(made) or not _answers(subject, small):
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
        subject.energy(atoms)
        subject.forces(atoms)
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


def _answers(subject: CalculatorSubject, atoms: Atoms) -> bool:
    return not isinstance(subject.try_both(atoms), CalculatorError)


def _filled(
    cell: Atoms,
    lattice: str,
    scale: float,
    relaxed: bool,
    cutoff: float | None,
    symbol: str,
    few: bool = False,
) -> Atoms:
    """The crystal with its lattice scaled, repeated to two cutoffs or a few atoms, and displaced a little."""
    cell = cell.copy()
    tabulated = "at its tabulated lattice constant" + ("" if scale == 1.0 else f" times {scale:.4g}")
    at = "at the calculator's own least energy" if relaxed else tabulated
    if cutoff and scale * _nearest_distance(cell) > _BARELY * cutoff:
        # nothing holds it together: a crystal in which nothing is felt would tell nothing
        scale, at = _PRESSED * cutoff / _nearest_distance(cell), "nothing binds it, so pressed together"
    cell.set_cell(np.asarray(cell.cell) * scale, scale_atoms=True)
    wanted = 0.0 if few else 2.05 * cutoff if cutoff else 12.0
    edge = float(np.asarray(cell.cell).diagonal().min())
    repeat = max(int(np.ceil(wanted / edge)), int(np.ceil((_FEWEST_ATOMS / len(cell)) ** (1 / 3))))
    repeat = max(min(repeat, int((_MOST_ATOMS / len(cell)) ** (1 / 3))), 1)
    atoms = cell.repeat(repeat)
    nearest = _nearest_distance(cell)
    atoms.rattle(_RATTLE * nearest, seed=0)
    return _labeled(
        atoms,
        f"{len(atoms)} atoms of {symbol}, {lattice}, nearest distance {nearest:.4g} Å ({at}), "
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


def _nearest_distance(cell: Atoms) -> float:
    """Smallest distance between two atoms of a crystal, images included."""
    distances = cell.repeat(2).get_all_distances(mic=True)
    return float(distances[distances > 1e-6].min())


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
        start = least / _nearest_distance(cell)  # too far apart to feel one another: start at two atoms' own
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
