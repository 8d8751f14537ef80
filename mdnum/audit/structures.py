"""The structure a calculator is asked about: a file's, or one built for the elements it knows."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.load import Loaded
from mdnum.audit.probes import FARTHEST, Pair, pairs
from mdnum.audit.subject import CalculatorError, CalculatorSubject, only_trying
from mdnum.audit.thresholds import rough
from mdnum.errors import InputError

#: Tried in this order, and then every other element: argon where anything goes.
_FIRST = ("Ar", "Cu", "Si", "C", "O", "Al", "Fe", "Na")
_LAST_ELEMENT = 95

_MOST_ATOMS = 500
_FEWEST_ATOMS = 32
_WATER_EDGES = (4, 5, 6, 8)
"""Molecules along an edge: some calculators want a box of two cutoffs."""

_DENSITIES = (1.0, 0.85, 0.72, 0.6, 0.5, 1.2)
"""Factors on a lattice constant at which a crystal is tried: a calculator may fail where nothing is near."""

_BARELY, _PRESSED = 0.9, 0.6
"""A nearest distance above this part of the cutoff is made to be that part of it."""

_SLOW = 0.15
"""Seconds of processor time of a calculation above which the crystal is made smaller."""

_RATTLE = 0.02
"""Standard deviation, of the nearest distance: in a perfect crystal forces are zero and distances tie."""


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
    except Exception as error:
        # ase's readers raise whatever their parsing meets; every one of them means the same to the reader
        detail = " ".join(str(error).split()) or "no more detail"
        raise InputError(
            f"cannot be read as a structure ({type(error).__name__}: {detail})",
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
    return _told(atoms, f"{len(atoms)} atoms, {atoms.get_chemical_formula()}, from {text}")


def default_structure(loaded: Loaded) -> Atoms:
    """A structure for a calculator: its own, or a crystal of an element it takes, or rigid water.

    The crystal is the element's, with the lattice at the calculator's own least energy, repeated until two
    cutoffs fit in (at most 500 atoms), its atoms displaced a little. `info["origin"]` says so in words. A
    calculator that fails on atoms without neighbors is looked for a denser crystal: that it fails is a
    finding, and no reason not to look.

    Raises:
        InputError: the calculator answers for no element and not for water; where it was asked about water,
            that is saved.
    """
    if loaded.atoms is not None:
        return _told(loaded.atoms, f"{len(loaded.atoms)} atoms of {loaded.name}")
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
            return _told(subject.atoms, f"{edge**3} molecules of water, on a grid, turned at random")
    if made is None:
        made = _first_crystal(about, others)
    if made is None:
        # after water, since a calculator of molecules may take any atoms in threes for them
        made = _first_crystal(about, likely, paired=False)
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


def _told(atoms: Atoms, says: str) -> Atoms:
    copy = atoms.copy()
    copy.info["origin"] = says
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
    for factor, least_energy in ((scale, relaxed), (start, False)):
        made = _filled(cell, lattice, factor, least_energy, cutoff, symbol)
        if _answers(subject, made):
            return _affordable(subject, made, (cell, lattice, factor, least_energy, cutoff, symbol))
    return None


def _affordable(subject: CalculatorSubject, made: Atoms, how: tuple[Any, ...]) -> Atoms:
    """A crystal that is asked about hundreds of times: a small one where a calculation takes long."""
    took = _took(subject, made)
    if took <= _SLOW:
        return made
    small = _filled(*how, few=True)
    # narrower than two cutoffs, which not every calculator takes
    if len(small) >= len(made) or not _answers(subject, small):
        return made
    why = f"; of {len(made)} atoms, for two cutoffs, one calculation takes {took:.2g} s of a processor"
    return _told(small, small.info["origin"] + why)


def _took(subject: CalculatorSubject, atoms: Atoms) -> float:
    """Seconds of processor time of energy and forces, after the first; the less of two.

    Programs that a calculator starts and ends count. What other programs do at the time does not, so that
    the same structure is asked about whatever the load.
    """
    took = []
    for _ in range(2):
        atoms = atoms.copy()
        atoms.positions[0, 0] += 1e-4
        began = _processor_time()
        subject.energy(atoms)
        subject.forces(atoms)
        took.append(_processor_time() - began)
    return min(took)


def _processor_time() -> float:
    """Seconds of this process and of those that it has waited for."""
    children = os.times()
    return time.process_time() + children.children_user + children.children_system


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
    try:
        subject.energy(atoms)
        subject.forces(atoms)
    except CalculatorError:
        return False
    return True


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
    at = "at the calculator's own least energy" if relaxed else _tabulated(scale)
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
    return _told(
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
    large = cell.repeat(2)
    distances = large.get_all_distances(mic=True)
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

    scale, factor = start, 1.03
    if least is not None and abs(energy(1.01) - energy(1.0)) < 1e-9:
        scale = least / _nearest_distance(cell)  # too far apart to feel one another: start at two atoms' own
    here = energy(scale)
    start = scale
    for direction in (factor, 1 / factor):
        for _ in range(60):
            there = energy(scale * direction)
            if not there < here:
                break
            scale, here = scale * direction, there
    ended = np.isfinite(here) and 0.2 < scale / start < 5.0
    return (scale, True) if ended and np.isfinite(here) else (start, False)


def _small(cell: Atoms, scale: float) -> Atoms:
    """A few atoms of a crystal whose lattice is scaled."""
    small = cell.repeat(max(int(np.ceil((_FEWEST_ATOMS / len(cell)) ** (1 / 3))), 1))
    small.set_cell(np.asarray(small.cell) * scale, scale_atoms=True)
    return small


def _tabulated(scale: float) -> str:
    return "at its tabulated lattice constant" + ("" if scale == 1.0 else f" times {scale:.4g}")
